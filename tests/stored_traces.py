"""Short recordings with stored traces beside them, for tests that replay tables."""

from short_recordings import record

from nl_env.config import SPLITS
from scripts import precompute

DURATION = 0.3
SLICES = 15
SEEDS = SPLITS["train"][7:9]


def store(data, *more, extrapolator="warp"):
    """Run ``scripts/precompute.py`` on ``data`` in this process; returns its exit status."""
    command = ["--data", str(data), "--extrapolator", extrapolator, "--workers", "0", *more]
    return precompute.main(command)


def record_and_store(folder):
    """Two short recordings in ``folder / "data"`` and their traces with ``"warp"`` beside them."""
    data = record(folder / "data", SEEDS, DURATION)
    assert store(data) == 0
    return data
