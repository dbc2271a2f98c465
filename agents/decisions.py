"""Every decision of recorded drives, enumerated: what supervised policies are trained on.

Between two LiDAR frames a policy at offset k (slices since the LiDAR frame) holds a frame made at some offset
h < k, so an interval of P slices has P (P - 1) / 2 states. What a policy sees in each, and the error of every
frame it could hold, follow from a stored trace: no schedule has to be played, and targets can look at the
whole interval.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nl_env.evaluation import DECIDING_METRIC
from nl_env.observations import state_vector, statistics_observation
from nl_env.statistics import GRID, MEASURES, WINDOWS, ActivityMemory, compress
from nl_env.traces import SequenceTrace


def states(period: int) -> list[tuple[int, int]]:
    """``(k, h)`` of every state of an interval: offset now, offset of the held frame."""
    return [(k, h) for k in range(1, period) for h in range(k)]


@dataclass(frozen=True)
class Decisions:
    """Decision states of n LiDAR intervals of P slices.

    Attributes:
        observations: ``(n, P (P - 1) / 2, fields)`` float32, in the order of :func:`states`: mode
            ``"statistics"`` without the trigger cost. The last action is that of the offset before; at
            the LiDAR frame's slice it is 0.
        errors: ``(n, P, P)`` float64: ``errors[i, k, h]`` is the error at offset k of the frame made at
            offset h <= k; nan elsewhere.
        sequence: ``(n,)`` int64, seed of the sequence.
    """

    observations: NDArray[np.float32]
    errors: NDArray[np.float64]
    sequence: NDArray[np.int64]

    @property
    def period(self) -> int:
        """Slices between LiDAR frames."""
        return self.errors.shape[1]

    def mirrored(self) -> Decisions:
        """The same drives in a mirror: left and right regions change places."""
        state = self.observations.shape[-1] - len(WINDOWS) * len(MEASURES) * GRID[0] * GRID[1]
        activity = self.observations[..., state:]
        regions = activity.reshape(*activity.shape[:-1], len(WINDOWS), len(MEASURES), *GRID)
        observations = self.observations.copy()
        observations[..., state:] = regions[..., ::-1].reshape(activity.shape)
        return Decisions(observations, self.errors, self.sequence)


def collect(traces: Iterable[SequenceTrace]) -> Decisions:
    """The decisions of all whole LiDAR intervals of ``traces``.

    Raises:
        ValueError: no whole interval, or traces of different LiDAR periods.
    """
    parts = [_of_trace(trace) for trace in traces]
    periods = sorted({part.period for part in parts})
    if len(periods) != 1 or not sum(len(part.errors) for part in parts):
        raise ValueError(
            f"traces: found LiDAR periods {periods}, expected one, and at least one whole interval"
        )
    return Decisions(*(np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])))


def _of_trace(trace: SequenceTrace) -> Decisions:
    period = trace.lidar_period
    count = (trace.slices + 1) // period
    starts = np.arange(count) * period
    errors = np.full((count, period, period), np.nan)
    for k in range(period):
        for h in range(k + 1):
            errors[:, k, h] = trace.errors[DECIDING_METRIC][starts + k, k - h]
    sums = _window_sums(trace.statistics[: count * period], period)
    pixels = trace.images[0].size
    observations = [
        statistics_observation(
            state_vector(
                np.full(count, k / period),
                np.full(count, (k - h) / period),
                trace.event_count[starts + k],
                pixels,
                np.full(count, int(0 < h == k - 1)),
            ),
            compress(sums[k, h]).reshape(count, -1),
        )
        for k, h in states(period)
    ]
    return Decisions(np.stack(observations, axis=1), errors, np.full(count, trace.seed, np.int64))


def _window_sums(statistics: NDArray[np.float32], period: int) -> dict[tuple[int, int], NDArray[np.float32]]:
    """For every state the ``(n, windows, statistics)`` sums that an environment's memory holds in it.

    One memory per offset h at which the interval's only trigger so far can have been; all intervals at once.
    """
    slices = statistics.reshape(-1, period, statistics.shape[-1]).copy()
    slices[0, 0] = 0.0  # nobody acts at t = 0, and nothing is seen of it
    before = np.roll(slices, 1, axis=0)
    before[0] = 0.0
    sums = {}
    for h in range(period - 1):
        memory = ActivityMemory((len(slices),))
        for k in range(1, period):
            memory.see(before[:, k], False)
        memory.see(slices[:, 0], True)
        for k in range(1, period):
            memory.see(slices[:, k], False)
            if k > h:
                sums[k, h] = memory.windows.copy()
            memory.act(k == h)
    return sums
