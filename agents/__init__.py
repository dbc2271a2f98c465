"""Trigger policies. Used from a checkout; the installed package is ``nl_env`` alone."""

from typing import Any

from agents.activity import Accumulated, StatisticsPolicy
from agents.base import Policy, PrivilegedPolicy
from agents.oracle import OptimalOracle
from agents.rules import (
    Always,
    Evenly,
    EventRate,
    EventRateHysteresis,
    FixedSchedule,
    GreedyDepthChange,
    KeyframeRule,
    Never,
    Periodic,
    RandomTrigger,
    SpeedAge,
)

__all__ = [
    "Accumulated",
    "Always",
    "Evenly",
    "EventRate",
    "EventRateHysteresis",
    "FixedSchedule",
    "GreedyDepthChange",
    "KeyframeCNN",
    "KeyframeRule",
    "Never",
    "OptimalOracle",
    "Periodic",
    "Policy",
    "PrivilegedPolicy",
    "RandomTrigger",
    "SpeedAge",
    "StatisticsPolicy",
    "TriggerValue",
]


def __getattr__(name: str) -> Any:
    """Learned policies load PyTorch, which the rules do without."""
    if name == "KeyframeCNN":
        from agents.keyframe_cnn import KeyframeCNN

        return KeyframeCNN
    if name == "TriggerValue":
        from agents.value_policy import TriggerValue

        return TriggerValue
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
