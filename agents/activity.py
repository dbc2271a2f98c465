"""Policies that see event activity in numbers, ``obs_mode="statistics"``: reading it, and send-on-delta."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.base import Actions, Memory, Policy
from nl_env.config import choice
from nl_env.observations import STATE_FIELDS
from nl_env.statistics import ACTIVITY_FIELDS, MEASURES, SLICE_STATISTICS, TYPICAL, WINDOWS

STATISTICS_FIELDS = len(STATE_FIELDS) + ACTIVITY_FIELDS
"""Numbers in an observation without the trigger cost."""
SINCE_LIDAR = STATE_FIELDS.index("since_lidar")
SINCE_DEPTH = STATE_FIELDS.index("since_depth")
LAST_ACTION = STATE_FIELDS.index("last_action")
_REGIONS = SLICE_STATISTICS // len(MEASURES)


class StatisticsPolicy(Policy):
    """Sees ``(n, STATISTICS_FIELDS)`` float32, and one number more where the observation shows the cost.

    Attributes:
        memoryless: decisions depend on the observation alone, and are to hold where a LiDAR frame arrives.
    """

    obs_mode = "statistics"
    memoryless = False

    def read(self, observation: Any) -> tuple[NDArray[Any], bool]:
        """Observations of mode ``"statistics"``, ``(n, fields)``, and whether it was a batch.

        Raises:
            ValueError: any other observation, or one without the cost that the policy must be told.
        """
        seen = np.asarray(observation)
        sizes = [STATISTICS_FIELDS + 1]
        if self.trigger_cost is None:
            sizes.insert(0, STATISTICS_FIELDS)
        if seen.dtype != np.float32 or seen.ndim not in (1, 2) or seen.shape[-1] not in sizes:
            raise ValueError(
                f"observation: found shape {seen.shape} dtype {seen.dtype}, expected (n,) or (batch, n) of "
                f'float32, obs_mode "statistics", with n = {" or ".join(map(str, sizes))}'
                + (", the trigger cost included" if self.trigger_cost is not None else "")
            )
        return (seen, True) if seen.ndim == 2 else (seen[None], False)


def activity(seen: NDArray[np.float32], window: str, measure: str) -> NDArray[np.float32]:
    """``(n,)`` mean over the regions of ``measure``, summed over ``window``, as it was before compression.

    Args:
        seen: ``(n, fields)`` observations of mode ``"statistics"``.
        window: one of :data:`nl_env.statistics.WINDOWS`.
        measure: one of :data:`nl_env.statistics.MEASURES`.
    """
    first = len(STATE_FIELDS) + WINDOWS.index(window) * SLICE_STATISTICS + MEASURES.index(measure) * _REGIONS
    compressed = seen[:, first : first + _REGIONS]
    return np.mean(TYPICAL * compressed / (1 - compressed), axis=1)


class Accumulated(StatisticsPolicy):
    """Send-on-delta: trigger when the events since the held depth frame was made exceed ``threshold``.

    Args:
        threshold: of the activity accumulated over slices, averaged over the image.
        measure: ``"magnitude"``, absolute event sums per pixel, or ``"active"``, shares of active pixels.
        weighted: compare the geometric mean of that sum and of this slice's activity instead: what was missed
            so far, and how fast it grows.
    """

    memoryless = True

    def __init__(self, threshold: float, measure: str = "magnitude", weighted: bool = False) -> None:
        if not (math.isfinite(threshold) and threshold >= 0):
            raise ValueError(f"threshold: found {threshold!r}, expected a finite number of at least 0")
        choice("measure", measure, MEASURES)
        self.threshold = threshold
        self.measure = measure
        self.weighted = weighted

    def decide(self, seen: NDArray[np.float32], memory: Memory) -> Actions:
        level = activity(seen, "since_depth", self.measure)
        if self.weighted:
            level = np.sqrt(level * activity(seen, "slice", self.measure))
        return ((level > self.threshold) & (seen[:, SINCE_LIDAR] > 0)).astype(np.int64)
