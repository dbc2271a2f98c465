"""Trigger policies. Used from a checkout; the installed package is ``nl_env`` alone."""

from typing import Any

from agents.base import Policy, PrivilegedPolicy
from agents.oracle import OptimalOracle
from agents.rules import (
    Always,
    Evenly,
    EventRate,
    EventRateHysteresis,
    GreedyDepthChange,
    KeyframeRule,
    Never,
    Periodic,
    RandomTrigger,
)

__all__ = [
    "Always",
    "Evenly",
    "EventRate",
    "EventRateHysteresis",
    "GreedyDepthChange",
    "KeyframeCNN",
    "KeyframeRule",
    "Never",
    "OptimalOracle",
    "Periodic",
    "Policy",
    "PrivilegedPolicy",
    "RandomTrigger",
]


def __getattr__(name: str) -> Any:
    """``KeyframeCNN`` loads PyTorch, which the rules do without."""
    if name == "KeyframeCNN":
        from agents.keyframe_cnn import KeyframeCNN

        return KeyframeCNN
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
