"""Fixtures that several test files share; nothing in them is ever written."""

import pytest


@pytest.fixture(scope="session")
def stored(tmp_path_factory):
    """Two short recordings and, beside them, their stored traces with ``"warp"``."""
    from stored_traces import record_and_store

    return record_and_store(tmp_path_factory.mktemp("traces"))
