"""Trigger policies. Used from a checkout; the installed package is ``nl_env`` alone."""

from agents.base import Policy, PrivilegedPolicy
from agents.oracle import OptimalOracle
from agents.rules import (
    Always,
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
    "EventRate",
    "EventRateHysteresis",
    "GreedyDepthChange",
    "KeyframeRule",
    "Never",
    "OptimalOracle",
    "Periodic",
    "Policy",
    "PrivilegedPolicy",
    "RandomTrigger",
]
