"""Policies by name, ``family`` or ``family:parameter``, and the sweeps that draw each family's curve."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from agents.base import Policy
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
from nl_env.config import choice

HYSTERESIS_RATIO = 0.7
"""The lower threshold of ``event-rate-hysteresis`` as a share of the upper one."""

_ACTIVE_SHARES = (0.02, 0.05, 0.08, 0.11, 0.14, 0.17, 0.2, 0.23, 0.26, 0.3)
_PROBABILITIES = (0.05, 0.15, 0.3, 0.45, 0.6, 0.75, 0.85, 0.92, 0.97)


@dataclass(frozen=True)
class Family:
    """Policies of one kind.

    Attributes:
        make: ``(parameter, seed) -> policy``; the seed is the sequence's. The parameter is nan where there
            is none.
        parameter: what the number after the colon means; empty when there is none.
        default: the number used without a colon; None leaves it to the policy.
        sweep: the numbers that draw the family's error-against-rate curve.
        adaptive: whether triggers depend on the scene.
    """

    make: Callable[[float, int], Policy]
    parameter: str = ""
    default: float | None = 0.0
    sweep: tuple[float, ...] = ()
    adaptive: bool = True


FAMILIES: dict[str, Family] = {
    "never": Family(lambda _, seed: Never(), adaptive=False),
    "always": Family(lambda _, seed: Always(), adaptive=False),
    "periodic": Family(
        lambda n, seed: Periodic(_whole("periodic", n)),
        "every n-th slice",
        2,
        (1, 2, 3, 4, 6, 8),
        adaptive=False,
    ),
    "evenly": Family(
        lambda rate_hz, seed: Evenly(rate_hz),
        "effective rate with a LiDAR at 10 Hz, Hz",
        40,
        (10, 20, 30, 40, 50),
        adaptive=False,
    ),
    "random": Family(RandomTrigger, "probability", 0.5, (0.1, 0.3, 0.5, 0.7, 0.9), adaptive=False),
    "event-rate": Family(
        lambda threshold, seed: EventRate(threshold), "share of active pixels above", 0.15, _ACTIVE_SHARES
    ),
    "event-rate-hysteresis": Family(
        lambda high, seed: EventRateHysteresis(HYSTERESIS_RATIO * high, high),
        "share of active pixels that starts triggering",
        0.18,
        _ACTIVE_SHARES,
    ),
    "keyframe-cnn": Family(
        lambda threshold, seed: _keyframe_cnn("keyframe-cnn.safetensors", threshold),
        "probability of a keyframe above; without it, as calibrated",
        None,
        _PROBABILITIES,
    ),
    "keyframe-cnn-temporal": Family(
        lambda threshold, seed: _keyframe_cnn("keyframe-cnn-temporal.safetensors", threshold),
        "probability of a keyframe above; without it, as calibrated",
        None,
        _PROBABILITIES,
    ),
    "keyframe-rule": Family(lambda _, seed: KeyframeRule()),
    "greedy": Family(
        lambda threshold, seed: GreedyDepthChange(threshold),
        "log_mae of holding above",
        0.03,
        (0.002, 0.005, 0.01, 0.015, 0.02, 0.03, 0.04, 0.06, 0.08, 0.12),
    ),
    "oracle": Family(lambda rate_hz, seed: OptimalOracle(rate_hz=rate_hz), "effective rate, Hz", 30),
}


def parse_policy(name: str) -> tuple[str, float | None]:
    """Split ``"family"`` or ``"family:number"``; the number is the family's default when it is left out.

    Raises:
        ValueError: unknown family (the message lists the valid ones), or a number that is none or not taken.
    """
    family, colon, number = name.partition(":")
    choice("policy", family, tuple(FAMILIES))
    if not FAMILIES[family].parameter:
        if colon:
            raise ValueError(f"policy: found {name!r}, expected {family!r}: it has no parameter")
        return family, None
    if not colon:
        return family, FAMILIES[family].default
    try:
        return family, float(number)
    except ValueError:
        raise ValueError(
            f"policy: found {name!r}, expected {family}:NUMBER ({FAMILIES[family].parameter})"
        ) from None


def policy_name(family: str, parameter: float | None) -> str:
    """The name that :func:`parse_policy` splits into these."""
    return family if parameter is None else f"{family}:{parameter:g}"


def make_policy(name: str, seed: int) -> Policy:
    """Build a policy by name; ``seed`` feeds the random ones. Errors as :func:`parse_policy`."""
    family, parameter = parse_policy(name)
    return FAMILIES[family].make(math.nan if parameter is None else parameter, seed)


def _keyframe_cnn(weights: str, threshold: float) -> Policy:
    """A learned detector of ``nl_env/weights``; importing PyTorch waits until one is asked for."""
    from agents.keyframe_cnn import WEIGHTS, KeyframeCNN

    return KeyframeCNN.load(WEIGHTS / weights, None if math.isnan(threshold) else threshold)


def _whole(family: str, number: float) -> int:
    if number != int(number):
        raise ValueError(f"policy {family}: found {number!r}, expected a whole number")
    return int(number)
