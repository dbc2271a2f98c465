"""Policies by name, and the sweeps that draw each family's curve.

A name is ``family``, ``family:parameter``, or for learned policies ``family@weights:parameter`` with a path
to weights other than the shipped ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import nl_env
from agents.activity import Accumulated
from agents.base import Policy
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
from nl_env.config import choice

WEIGHTS = Path(nl_env.__file__).parent / "weights"
"""Where the shipped weights of learned policies are."""

HYSTERESIS_RATIO = 0.7
"""The lower threshold of ``event-rate-hysteresis`` as a share of the upper one."""

FREE_SLICES = 4
"""Slices between two LiDAR frames at 10 Hz, the digits of ``schedule``."""

_ACTIVE_SHARES = (0.02, 0.05, 0.08, 0.11, 0.14, 0.17, 0.2, 0.23, 0.26, 0.3)
_PROBABILITIES = (0.05, 0.15, 0.3, 0.45, 0.6, 0.75, 0.85, 0.92, 0.97)
_ACCUMULATED = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.7, 0.85, 1.0, 1.2, 1.5)
_WEIGHTED = (0.03, 0.06, 0.1, 0.14, 0.18, 0.22, 0.26, 0.3, 0.35, 0.4, 0.45, 0.5, 0.58, 0.67, 0.8)
_METRES = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.7, 0.85, 1.0, 1.3)
_COSTS = (0.01, 0.02, 0.035, 0.05, 0.07, 0.1, 0.14, 0.19, 0.26, 0.35, 0.47, 0.63, 0.85, 1.15, 1.5, 2.0)
"""Trigger costs, in units of reward."""
_SAVINGS = (0.0003, 0.0006, 0.001, 0.0015, 0.002, 0.003, 0.004, 0.005, 0.007, 0.01, 0.014, 0.02, 0.03, 0.04)
"""Errors that a trigger saves at its slice, log_mae."""


@dataclass(frozen=True)
class Family:
    """Policies of one kind.

    Attributes:
        make: ``(parameter, seed) -> policy`` for what is not learned; the seed is the sequence's. The
            parameter is nan where there is none.
        load: ``(weights, parameter) -> policy`` for what is learned; parameter None is the policy's own.
        weights: file of the shipped weights in :data:`WEIGHTS`.
        parameter: what the number after the colon means; empty when there is none.
        default: the number used without a colon; None leaves it to the policy.
        sweep: the numbers that draw the family's error-against-rate curve.
        adaptive: whether triggers depend on the scene.
        show: how names write the number.
    """

    make: Callable[[float, int], Policy] | None = None
    load: Callable[[Path, float | None], Policy] | None = None
    weights: str = ""
    parameter: str = ""
    default: float | None = 0.0
    sweep: tuple[float, ...] = ()
    adaptive: bool = True
    show: Callable[[float], str] = "{:g}".format

    @property
    def available(self) -> bool:
        """Whether it can be made by its name alone: learned policies need their weights."""
        return self.make is not None or (WEIGHTS / self.weights).is_file()


class PolicyName(NamedTuple):
    """A name in its parts; weights are empty for the shipped ones."""

    family: str
    parameter: float | None
    weights: str = ""

    def __str__(self) -> str:
        weights = f"@{self.weights}" if self.weights else ""
        number = "" if self.parameter is None else f":{FAMILIES[self.family].show(self.parameter)}"
        return f"{self.family}{weights}{number}"


def _keyframe_cnn(weights: Path, threshold: float | None) -> Policy:
    """Learned policies load PyTorch; that waits until one is asked for."""
    from agents.keyframe_cnn import KeyframeCNN

    return KeyframeCNN.load(weights, threshold)


def _trigger_value(weights: Path, parameter: float | None) -> Policy:
    from agents.value_policy import TriggerValue

    return TriggerValue.load(weights, parameter)


def _trigger_network(weights: Path, trigger_cost: float | None) -> Policy:
    from agents.rl import load_trigger

    return load_trigger(weights, trigger_cost)


def _keyframes(weights: str) -> Family:
    return Family(
        load=_keyframe_cnn,
        weights=weights,
        parameter="probability of a keyframe above; without it, as calibrated",
        default=None,
        sweep=_PROBABILITIES,
    )


def _told_cost(load: Callable[[Path, float | None], Policy], weights: str, default: float | None) -> Family:
    return Family(
        load=load,
        weights=weights,
        parameter="cost of a trigger, in units of reward",
        default=default,
        sweep=_COSTS,
    )


FAMILIES: dict[str, Family] = {
    "never": Family(lambda _, seed: Never(), adaptive=False),
    "always": Family(lambda _, seed: Always(), adaptive=False),
    "periodic": Family(
        lambda n, seed: Periodic(_whole("periodic", n)),
        parameter="every n-th slice",
        default=2,
        sweep=(1, 2, 3, 4, 6, 8),
        adaptive=False,
    ),
    "evenly": Family(
        lambda rate_hz, seed: Evenly(rate_hz),
        parameter="effective rate with a LiDAR at 10 Hz, Hz",
        default=40,
        sweep=(10, 15, 20, 25, 30, 35, 40, 45, 50),
        adaptive=False,
    ),
    "schedule": Family(
        lambda pattern, seed: FixedSchedule(_pattern(pattern)),
        parameter="a digit for each slice between two LiDAR frames, 1 where it triggers",
        default=100,
        sweep=tuple(float(f"{n:b}") for n in range(1, 2**FREE_SLICES - 1)),
        adaptive=False,
        show=lambda pattern: _pattern(pattern),
    ),
    "random": Family(
        RandomTrigger, parameter="probability", default=0.5, sweep=(0.1, 0.3, 0.5, 0.7, 0.9), adaptive=False
    ),
    "event-rate": Family(
        lambda threshold, seed: EventRate(threshold),
        parameter="share of active pixels above",
        default=0.15,
        sweep=_ACTIVE_SHARES,
    ),
    "event-rate-hysteresis": Family(
        lambda high, seed: EventRateHysteresis(HYSTERESIS_RATIO * high, high),
        parameter="share of active pixels that starts triggering",
        default=0.18,
        sweep=_ACTIVE_SHARES,
    ),
    "accumulated": Family(
        lambda threshold, seed: Accumulated(threshold),
        parameter="events per pixel since the held frame was made, above",
        default=0.5,
        sweep=_ACCUMULATED,
    ),
    "accumulated-weighted": Family(
        lambda threshold, seed: Accumulated(threshold, weighted=True),
        parameter="geometric mean of that and of this slice's events per pixel, above",
        default=0.35,
        sweep=_WEIGHTED,
    ),
    "speed-age": Family(
        lambda metres, seed: SpeedAge(metres),
        parameter="way since the held frame was made above, m",
        default=0.4,
        sweep=_METRES,
    ),
    "keyframe-cnn": _keyframes("keyframe-cnn.safetensors"),
    "keyframe-cnn-temporal": _keyframes("keyframe-cnn-temporal.safetensors"),
    "value-reduction": Family(
        load=_trigger_value,
        weights="value-reduction.safetensors",
        parameter="log_mae that a trigger saves at its slice, above",
        default=0.005,
        sweep=_SAVINGS,
    ),
    "value-advantage": _told_cost(_trigger_value, "value-advantage.safetensors", 0.1),
    "value-clone": _told_cost(_trigger_value, "value-clone.safetensors", 0.1),
    "value-planned": _told_cost(_trigger_value, "value-planned.safetensors", 0.1),
    "value-pictures": _told_cost(_trigger_network, "value-pictures.safetensors", None),
    "rl": _told_cost(_trigger_network, "rl.safetensors", None),
    "rl-pictures": _told_cost(_trigger_network, "rl-pictures.safetensors", None),
    "keyframe-rule": Family(lambda _, seed: KeyframeRule()),
    "greedy": Family(
        lambda threshold, seed: GreedyDepthChange(threshold),
        parameter="log_mae of holding above",
        default=0.03,
        sweep=(0.002, 0.005, 0.01, 0.015, 0.02, 0.03, 0.04, 0.06, 0.08, 0.12),
    ),
    "oracle": Family(
        lambda rate_hz, seed: OptimalOracle(rate_hz=rate_hz), parameter="effective rate, Hz", default=30
    ),
}


def parse_policy(name: str) -> PolicyName:
    """Take a name apart; the number is the family's default when it is left out.

    Raises:
        ValueError: unknown family (the message lists the valid ones), a number that is none or not taken, or
            weights for a family that has none.
    """
    head, colon, number = name.rpartition(":")
    if not colon:
        head, number = name, ""
    family, at, weights = head.partition("@")
    choice("policy", family, tuple(FAMILIES))
    known = FAMILIES[family]
    if at and (known.load is None or not weights):
        raise ValueError(f"policy: found {name!r}, expected a path to weights after @, of a learned policy")
    if not known.parameter:
        if colon:
            raise ValueError(f"policy: found {name!r}, expected {family!r}: it has no parameter")
        return PolicyName(family, None, weights)
    if not colon:
        return PolicyName(family, known.default, weights)
    try:
        return PolicyName(family, float(number), weights)
    except ValueError:
        raise ValueError(f"policy: found {name!r}, expected {family}:NUMBER ({known.parameter})") from None


def make_policy(name: str, seed: int) -> Policy:
    """Build a policy by name; ``seed`` feeds the random ones.

    Raises:
        ValueError: as :func:`parse_policy`, or the policy refuses its parameter or its weights.
        FileNotFoundError: no such weights.
    """
    family, parameter, weights = parse_policy(name)
    known = FAMILIES[family]
    if known.load is not None:
        return known.load(Path(weights) if weights else WEIGHTS / known.weights, parameter)
    assert known.make is not None
    return known.make(math.nan if parameter is None else parameter, seed)


def _whole(family: str, number: float) -> int:
    if number != int(number):
        raise ValueError(f"policy {family}: found {number!r}, expected a whole number")
    return int(number)


def _pattern(number: float) -> str:
    """The digits of a schedule, with the leading zeros that a number does not keep."""
    return f"{_whole('schedule', number):0{FREE_SLICES}d}"
