"""The optimal oracle: the least total error that any schedule of triggers can reach, exactly.

Within a LiDAR interval the error of slice k depends only on the slice whose depth is held, so the best
cost of an interval with j triggers is a shortest path over its slices. Intervals are independent, so the
best cost of a sequence with n triggers is a knapsack over intervals. Nothing here assumes that more
triggers help, or help less and less.

Tables follow ``nl_env.traces.SequenceTrace``: ``errors[k, a]`` is the error at slice k of the depth frame
produced at slice k - a, and slices 0, P, 2P, ... bring LiDAR frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agents.base import Memory, PrivilegedPolicy, Trace, Truth
from nl_env.types import SLICE_US

Errors = NDArray[np.float64]


@dataclass(frozen=True)
class IntervalPlans:
    """Best schedules of all LiDAR intervals with the same number of free slices m.

    Attributes:
        starts: ``(n,)`` slices of the LiDAR frames.
        costs: ``(n, m + 1)`` least total error with exactly j triggers.
        previous: ``(n, m + 1, m + 2)``; ``previous[i, j, e]`` is the held frame's offset before the j-th
            trigger, or the end of the interval, at offset e.
    """

    starts: NDArray[np.int64]
    costs: Errors
    previous: NDArray[np.int64]

    def triggers(self, interval: int, count: int) -> list[int]:
        """Slices of the best ``count`` triggers in one interval."""
        offset = self.previous.shape[2] - 1
        offsets = []
        for remaining in range(count, 0, -1):
            offset = int(self.previous[interval, remaining, offset])
            offsets.append(offset)
        return [int(self.starts[interval]) + o for o in reversed(offsets)]


def oracle_curve(errors: Errors, period: int) -> tuple[NDArray[np.int64], Errors]:
    """Least total error over slices 1..K for every number of triggers.

    Args:
        errors: ``(K+1, P)`` float64 table, ``P >= period``.
        period: slices between LiDAR frames.

    Returns:
        ``(triggers, totals)``, both ``(N + 1,)`` for 0..N triggers, N being the slices without a LiDAR frame.

    Raises:
        ValueError: wrong shape or period, or NaN where the table must have a number.
    """
    costs = [row for plans in _plan(errors, period) for row in plans.costs]
    totals = _knapsack(costs)[0]
    return np.arange(len(totals)), totals + _lidar_error(errors, period)


def optimal_schedule(errors: Errors, period: int, triggers: int) -> NDArray[np.bool_]:
    """``(K+1,)`` bool schedule of exactly ``triggers`` triggers with the least total error.

    Arguments and errors as :func:`oracle_curve`; ``triggers`` outside 0..N raises ``ValueError``.
    """
    plans = _plan(errors, period)
    places = [(plan, i) for plan in plans for i in range(len(plan.starts))]
    totals, choices = _knapsack([plan.costs[i] for plan, i in places])
    if not 0 <= triggers < len(totals):
        raise ValueError(f"triggers: found {triggers!r}, expected 0 to {len(totals) - 1}")
    schedule = np.zeros(len(errors), dtype=bool)
    remaining = triggers
    for (plan, i), choice in zip(reversed(places), reversed(choices), strict=True):
        count = int(choice[remaining])
        schedule[plan.triggers(i, count)] = True
        remaining -= count
    return schedule


def priced_schedule(errors: Errors, period: int, price: float) -> NDArray[np.bool_]:
    """``(K+1,)`` bool schedule with the least ``total error + price * triggers``.

    Of equally good schedules an interval takes the one with fewer triggers. Errors as :func:`oracle_curve`.
    """
    schedule = np.zeros(len(errors), dtype=bool)
    for plans in _plan(errors, period):
        counts = np.argmin(plans.costs + price * np.arange(plans.costs.shape[1]), axis=1)
        for i, count in enumerate(counts):
            schedule[plans.triggers(i, int(count))] = True
    return schedule


class OptimalOracle(PrivilegedPolicy):
    """Follow the schedule of least total error: the floor under every policy at the same rate.

    Give exactly one of the two arguments.

    Args:
        rate_hz: effective frame rate to reach, LiDAR frames included; rounded to whole triggers and limited
            to what the sequence allows.
        price: error a trigger must save to be worth it, in the metric's unit, summed over slices.
        error: name of the metric.
    """

    def __init__(
        self, *, rate_hz: float | None = None, price: float | None = None, error: str = "log_mae"
    ) -> None:
        super().__init__()
        if (rate_hz is None) == (price is None):
            raise ValueError(f"found rate_hz={rate_hz!r} and price={price!r}, expected exactly one of them")
        self.rate_hz = rate_hz
        self.price = price
        self.error = error
        self._schedule: NDArray[np.bool_] | None = None

    def bind(self, env: object) -> None:
        """Refused: the optimum needs the whole sequence in advance; use ``begin(trace)``."""
        raise TypeError("OptimalOracle needs the whole sequence in advance: call begin(trace), not bind(env)")

    def begin(self, trace: Trace) -> None:
        """Compute the schedule of ``trace``; the next prediction is for its slice 1."""
        super().begin(trace)
        errors = trace.errors[self.error]
        period = _lidar_period(trace.lidar)
        if self.price is not None:
            self._schedule = priced_schedule(errors, period, self.price)
            return
        assert self.rate_hz is not None
        slices = len(trace.lidar) - 1
        lidar_frames = int(np.count_nonzero(trace.lidar[1:]))
        wanted = round(self.rate_hz * slices * SLICE_US / 1e6) - lidar_frames
        triggers = min(max(wanted, 0), slices - lidar_frames)
        self._schedule = optimal_schedule(errors, period, triggers)

    def choose(self, truth: Truth, memory: Memory) -> bool:
        assert self._schedule is not None
        return bool(self._schedule[memory[0]])


def _lidar_period(lidar: NDArray[np.bool_]) -> int:
    """Slices between LiDAR frames; a sequence shorter than two frames is one interval."""
    frames = np.flatnonzero(lidar)
    return int(frames[1] - frames[0]) if len(frames) > 1 else len(lidar)


def _plan(errors: Errors, period: int) -> list[IntervalPlans]:
    """Plans of all whole intervals, then of the last one if the sequence ends inside it."""
    if errors.ndim != 2 or period < 1 or errors.shape[1] < min(period, len(errors)):
        raise ValueError(
            f"errors: found shape {errors.shape} for period {period}, expected (K+1, P) with P >= period >= 1"
        )
    starts = np.arange(0, len(errors), period)
    whole = starts + period <= len(errors)
    groups = [_plan_intervals(errors, starts[whole], period - 1)]
    if not whole.all():
        groups.append(_plan_intervals(errors, starts[~whole], len(errors) - 1 - int(starts[-1])))
    return groups


def _plan_intervals(errors: Errors, starts: NDArray[np.int64], free: int) -> IntervalPlans:
    """Shortest paths over the offsets 1..free of the intervals at ``starts``."""
    end = free + 1
    # holding[i, h, e]: error of holding the frame made at offset h over the offsets h..e-1. The LiDAR
    # slice itself, offset 0, is the same in every schedule and left out.
    holding = np.full((len(starts), end, end + 1), np.inf)
    for made in range(end):
        first = max(made, 1)
        offsets = np.arange(first, end)
        errors_held = errors[starts[:, None] + offsets, offsets - made]
        if np.isnan(errors_held).any():
            raise ValueError(
                "errors: found NaN inside a LiDAR interval, expected a number for every held frame"
            )
        holding[:, made, first] = 0.0
        holding[:, made, first + 1 :] = np.cumsum(errors_held, axis=1)
        if made:
            holding[:, made, made] = np.inf

    costs = np.full((len(starts), end, end + 1), np.inf)
    previous = np.zeros((len(starts), end, end + 1), dtype=np.int64)
    costs[:, 0] = holding[:, 0]
    for count in range(1, end):
        through = costs[:, count - 1, :end, None] + holding
        through[:, 0] = np.inf
        previous[:, count] = np.argmin(through, axis=1)
        costs[:, count] = np.min(through, axis=1)
    return IntervalPlans(starts, costs[:, :, end], previous)


def _knapsack(costs: list[Errors]) -> tuple[Errors, list[NDArray[np.int64]]]:
    """Least sum over intervals for every total count, and each interval's own count in that optimum."""
    totals = np.zeros(1)
    choices = []
    for interval in costs:
        options = np.full((len(interval), len(totals) + len(interval) - 1), np.inf)
        for count, cost in enumerate(interval):
            options[count, count : count + len(totals)] = totals + cost
        choices.append(np.argmin(options, axis=0))
        totals = np.min(options, axis=0)
    return totals, choices


def _lidar_error(errors: Errors, period: int) -> float:
    """Error at the LiDAR slices after t = 0, which no schedule can change."""
    return float(errors[period::period, 0].sum())
