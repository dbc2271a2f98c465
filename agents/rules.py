"""Rules without learning: constant, periodic, even, random, event rates, and two privileged ones."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agents.base import Actions, Memory, Policy, PrivilegedPolicy, Truth
from nl_env.types import SLICE_US

EVENT_MEASURES = ("active", "count")


class Never(Policy):
    """Hold always: the LiDAR alone, 10 Hz."""

    def decide(self, frames: NDArray[np.int16], memory: Memory) -> Actions:
        return np.zeros(len(frames), dtype=np.int64)


class Always(Policy):
    """Trigger always: 50 Hz."""

    def decide(self, frames: NDArray[np.int16], memory: Memory) -> Actions:
        return np.ones(len(frames), dtype=np.int64)


class Periodic(Policy):
    """Trigger at slice k when ``k % n == phase``; k counts from 1 at the first observation.

    Triggers that meet a LiDAR frame have no effect: at 10 Hz ``Periodic(5, phase=0)`` adds nothing.
    """

    def __init__(self, n: int, phase: int = 0) -> None:
        if n < 1:
            raise ValueError(f"n: found {n!r}, expected at least 1")
        if not 0 <= phase < n:
            raise ValueError(f"phase: found {phase!r}, expected 0 to {n - 1}")
        self.n = n
        self.phase = phase

    def initial_memory(self, count: int) -> Memory:
        return np.zeros((count, 1), dtype=np.int64)

    def decide(self, frames: NDArray[np.int16], memory: Memory) -> Actions:
        memory[:, 0] += 1
        return (memory[:, 0] % self.n == self.phase).astype(np.int64)


class Evenly(Policy):
    """Spread triggers evenly over the slices without a LiDAR frame, so that depth arrives at ``rate_hz``.

    Args:
        rate_hz: effective frame rate, Hz; from the LiDAR's own to one frame per slice.
        lidar_period: slices between LiDAR frames (5 at 10 Hz).
    """

    def __init__(self, rate_hz: float, lidar_period: int = 5) -> None:
        every_slice = 1e6 / SLICE_US
        lidar_hz = every_slice / lidar_period
        if not lidar_hz <= rate_hz <= every_slice:
            raise ValueError(f"rate_hz: found {rate_hz!r}, expected {lidar_hz:g} to {every_slice:g}")
        self.lidar_period = lidar_period
        self.share = (rate_hz - lidar_hz) / (every_slice - lidar_hz)

    def initial_memory(self, count: int) -> Memory:
        return np.zeros((count, 1), dtype=np.int64)

    def decide(self, frames: NDArray[np.int16], memory: Memory) -> Actions:
        memory[:, 0] += 1
        interval, offset = np.divmod(memory[:, 0], self.lidar_period)
        free = interval * (self.lidar_period - 1) + offset  # slices without a LiDAR frame, this one included
        due, before = (np.floor(n * self.share + 1e-9) for n in (free, free - 1))
        return ((offset > 0) & (due > before)).astype(np.int64)


class FixedSchedule(Policy):
    """Trigger at the same slices of every LiDAR interval.

    Args:
        pattern: one digit for each slice between two LiDAR frames, 1 where it triggers; ``"0100"`` is one
            trigger, 40 ms after each LiDAR frame.
    """

    def __init__(self, pattern: str) -> None:
        if not pattern or set(pattern) - {"0", "1"}:
            raise ValueError(f"pattern: found {pattern!r}, expected digits 0 and 1, one for each slice")
        self.pattern = pattern
        self._actions = np.array([0, *map(int, pattern)], dtype=np.int64)

    def initial_memory(self, count: int) -> Memory:
        return np.zeros((count, 1), dtype=np.int64)

    def decide(self, frames: NDArray[np.int16], memory: Memory) -> Actions:
        memory[:, 0] += 1
        return self._actions[memory[:, 0] % len(self._actions)]


class RandomTrigger(Policy):
    """Trigger with probability ``p``, independently at every slice.

    The draw is a function of the seed, the environment's place in the batch and the slice alone: every
    episode with the same seed triggers at the same slices.
    """

    def __init__(self, p: float, seed: int = 0) -> None:
        if not 0.0 <= p <= 1.0:
            raise ValueError(f"p: found {p!r}, expected a probability in [0, 1]")
        self.p = p
        self.seed = seed

    def initial_memory(self, count: int) -> Memory:
        return np.zeros((count, 1), dtype=np.int64)

    def decide(self, frames: NDArray[np.int16], memory: Memory) -> Actions:
        memory[:, 0] += 1
        draws = [
            np.random.Generator(np.random.Philox(key=self.seed, counter=(place, int(k), 0, 0))).random()
            for place, k in enumerate(memory[:, 0])
        ]
        return (np.array(draws) < self.p).astype(np.int64)


def event_rate(frames: NDArray[np.int16], measure: str) -> NDArray[np.float64]:
    """``(n,)`` event activity of event frames ``(n, H, W)``.

    ``"active"`` is the share of pixels whose signed sum is not zero, ``"count"`` the mean absolute sum per
    pixel (events of both signs at one pixel cancel, so it is a lower bound of events per pixel).
    """
    pixels = frames[0].size
    if measure == "active":
        return np.count_nonzero(frames, axis=(1, 2)) / pixels
    return np.abs(frames).sum(axis=(1, 2), dtype=np.int64) / pixels


class EventRate(Policy):
    """Trigger when the event activity of the slice is above ``threshold``; see :func:`event_rate`."""

    def __init__(self, threshold: float, measure: str = "active") -> None:
        _check_threshold("threshold", threshold)
        _check_measure(measure)
        self.threshold = threshold
        self.measure = measure

    def decide(self, frames: NDArray[np.int16], memory: Memory) -> Actions:
        return (event_rate(frames, self.measure) > self.threshold).astype(np.int64)


class EventRateHysteresis(Policy):
    """Start triggering when the event activity exceeds ``high``, stop when it falls to ``low`` or below."""

    def __init__(self, low: float, high: float, measure: str = "active") -> None:
        _check_threshold("low", low)
        _check_threshold("high", high)
        _check_measure(measure)
        if low > high:
            raise ValueError(f"low: found {low!r}, expected at most high ({high!r})")
        self.low = low
        self.high = high
        self.measure = measure

    def initial_memory(self, count: int) -> Memory:
        return np.zeros((count, 1), dtype=np.int64)

    def decide(self, frames: NDArray[np.int16], memory: Memory) -> Actions:
        rate = event_rate(frames, self.measure)
        memory[:, 0] = np.where(memory[:, 0] == 1, rate > self.low, rate > self.high)
        return memory[:, 0].copy()


class KeyframeRule(PrivilegedPolicy):
    """Trigger where the paper's labelling rule says keyframe: what its detector learns to imitate."""

    def choose(self, truth: Truth, memory: Memory) -> bool:
        return truth.keyframe(int(memory[0]))


class SpeedAge(PrivilegedPolicy):
    """Trigger when the vehicle has come further than ``metres`` since the held depth frame was made.

    The way is the speed of the moment times the age. Odometry gives it, but no observation does.
    """

    def __init__(self, metres: float) -> None:
        super().__init__()
        _check_threshold("metres", metres)
        self.metres = metres

    def initial_memory(self, count: int) -> Memory:
        """Columns: slice acted on last, slice at which the held frame was made."""
        return np.zeros((count, 2), dtype=np.int64)

    def choose(self, truth: Truth, memory: Memory) -> bool:
        index, held = memory.tolist()
        lidar = truth.lidar(index)
        trigger = not lidar and truth.ego_speed(index) * (index - held) * SLICE_US / 1e6 > self.metres
        if lidar or trigger:
            memory[1] = index
        return trigger


class GreedyDepthChange(PrivilegedPolicy):
    """Trigger when holding on would cost a ``log_mae`` above ``threshold``.

    It knows the true depth of the moment but not the future, and not how good the extrapolation will be.
    """

    def __init__(self, threshold: float) -> None:
        super().__init__()
        _check_threshold("threshold", threshold)
        self.threshold = threshold

    def initial_memory(self, count: int) -> Memory:
        """Columns: slice acted on last, slice at which the held frame was made."""
        return np.zeros((count, 2), dtype=np.int64)

    def choose(self, truth: Truth, memory: Memory) -> bool:
        index, held = memory.tolist()
        if truth.lidar(index):
            memory[1] = index
            return False
        trigger = truth.holding_error(index, index - held) > self.threshold
        if trigger:
            memory[1] = index
        return trigger


def _check_threshold(name: str, value: float) -> None:
    if not (math.isfinite(value) and value >= 0):
        raise ValueError(f"{name}: found {value!r}, expected a finite number of at least 0")


def _check_measure(measure: str) -> None:
    if measure not in EVENT_MEASURES:
        raise ValueError(f"measure: found {measure!r}, expected one of {', '.join(EVENT_MEASURES)}")
