"""Which depth frame the consumer holds, how old it is, and how many frames were made.

Pure bookkeeping without images: the environment keeps the frames, the evaluation replays tables of
errors, and both ask this ledger which frame counts.
"""

from __future__ import annotations

from nl_env.types import SLICE_US

LIDAR = "lidar"
EXTRAPOLATED = "extrapolated"


class DepthLedger:
    """Held depth of one sequence. It starts at slice 0 with the LiDAR frame of ``t = 0``.

    Attributes:
        lidar_period: slices between LiDAR frames.
        index: the last slice acted on.
        held_index: slice at which the held depth frame was produced.
        held_source: ``"lidar"`` or ``"extrapolated"``.
        lidar_index: slice of the last LiDAR frame.
        lidar_frames: LiDAR frames at slices 1..index.
        triggers: extrapolated frames at slices 1..index.
        last_action: 1 if the last action asked for a trigger, even where a LiDAR frame made it moot.
    """

    def __init__(self, lidar_period: int) -> None:
        self.lidar_period = lidar_period
        self.index = 0
        self.held_index = 0
        self.held_source = LIDAR
        self.lidar_index = 0
        self.lidar_frames = 0
        self.triggers = 0
        self.last_action = 0

    def act(self, index: int, lidar: bool, action: int) -> bool:
        """Account for slice ``index`` and say whether it triggers an extrapolation.

        A LiDAR frame always becomes the held frame; the action then has no effect.

        Raises:
            ValueError: ``index`` does not follow the last one.
        """
        if index != self.index + 1:
            raise ValueError(f"index: found {index}, expected {self.index + 1}: slices are acted on in order")
        self.index = index
        self.last_action = int(action)
        triggered = bool(action) and not lidar
        if lidar:
            self.held_source = LIDAR
            self.lidar_index = index
            self.lidar_frames += 1
        elif triggered:
            self.held_source = EXTRAPOLATED
            self.triggers += 1
        if lidar or triggered:
            self.held_index = index
        return triggered

    @property
    def age(self) -> int:
        """Slices since the held frame was produced."""
        return self.index - self.held_index

    @property
    def effective_rate(self) -> float:
        """Depth frames per second over slices 1..index, Hz; 0 before the first slice."""
        frames = self.lidar_frames + self.triggers
        return frames * 1e6 / (self.index * SLICE_US) if self.index else 0.0

    def staleness(self, index: int, lidar: bool) -> tuple[float, float]:
        """What an agent about to act on slice ``index`` knows: time since the last LiDAR and depth frame.

        Both are shares of the LiDAR period, in [0, 1], and 0 where a LiDAR frame arrives.
        """
        if lidar:
            return 0.0, 0.0
        return (index - self.lidar_index) / self.lidar_period, (index - self.held_index) / self.lidar_period
