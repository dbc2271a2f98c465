""":class:`nl_env.ledger.DepthLedger` for many environments at once, as arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.types import SLICE_US


class BatchedLedger:
    """Which depth frame is held in each of ``n`` environments, and how many frames were made.

    Attributes:
        lidar_period: slices between LiDAR frames.
        index: ``(n,)`` int64, the last slice acted on.
        held_index: ``(n,)`` int64, slice at which the held depth frame was produced.
        extrapolated: ``(n,)`` bool, the held frame is an extrapolated one.
        lidar_index: ``(n,)`` int64, slice of the last LiDAR frame.
        lidar_frames, triggers: ``(n,)`` int64, frames at slices 1..index.
        last_action: ``(n,)`` int64.
    """

    def __init__(self, n: int, lidar_period: int) -> None:
        self.lidar_period = lidar_period
        self.index, self.held_index, self.lidar_index = (np.zeros(n, np.int64) for _ in range(3))
        self.lidar_frames, self.triggers, self.last_action = (np.zeros(n, np.int64) for _ in range(3))
        self.extrapolated = np.zeros(n, np.bool_)

    def reset(self, where: NDArray[np.bool_]) -> None:
        """Start a sequence in the environments of ``where``, ``(n,)``."""
        for counts in (self.index, self.held_index, self.lidar_index, self.lidar_frames, self.triggers):
            counts[where] = 0
        self.last_action[where] = 0
        self.extrapolated[where] = False

    def act(
        self, where: NDArray[np.bool_], lidar: NDArray[np.bool_], actions: NDArray[np.int64]
    ) -> NDArray[np.bool_]:
        """Account for the next slice of the environments of ``where`` and say which extrapolate.

        Args:
            where: ``(n,)``, the environments that act.
            lidar: ``(n,)``, whether a LiDAR frame arrives at that slice; it makes the action moot.
            actions: ``(n,)``, 0 or 1.
        """
        arrives, triggered = where & lidar, where & ~lidar & (actions == 1)
        self.index += where
        np.copyto(self.last_action, actions, where=where)
        np.copyto(self.lidar_index, self.index, where=arrives)
        np.copyto(self.held_index, self.index, where=arrives | triggered)
        self.extrapolated = (self.extrapolated & ~arrives) | triggered
        self.lidar_frames += arrives
        self.triggers += triggered
        return triggered

    @property
    def age(self) -> NDArray[np.int64]:
        """``(n,)`` slices since the held frame was produced."""
        return self.index - self.held_index

    @property
    def effective_rate(self) -> NDArray[np.float64]:
        """``(n,)`` depth frames per second over slices 1..index, Hz; 0 before the first slice."""
        frames = self.lidar_frames + self.triggers
        return np.where(self.index > 0, frames * 1e6 / (np.maximum(self.index, 1) * SLICE_US), 0.0)

    def staleness(self, index: NDArray[np.int64], lidar: NDArray[np.bool_]) -> tuple[Any, Any]:
        """Time since the last LiDAR and depth frame at slices ``index``, ``(n,)`` shares of the period."""
        since_lidar = np.where(lidar, 0.0, (index - self.lidar_index) / self.lidar_period)
        since_depth = np.where(lidar, 0.0, (index - self.held_index) / self.lidar_period)
        return since_lidar, since_depth
