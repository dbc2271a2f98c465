"""What an extrapolator may look at: the last LiDAR frames and the events since."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.types import Camera, DepthExtrapolator, ExtrapolationInput, Sample


class WindowBins(Sequence[NDArray[np.int16]]):
    """The bins of some samples, taken from each when they are looked at, which may cost reading them.

    Args:
        samples: oldest first.
    """

    def __init__(self, samples: Sequence[Sample]) -> None:
        self._samples = tuple(samples)

    def __len__(self) -> int:
        return len(self._samples)

    def __getitem__(self, place: Any) -> Any:
        if isinstance(place, slice):
            return tuple(sample.bins for sample in self._samples[place])
        return self._samples[place].bins


class SensorHistory:
    """Gathers samples in order and hands an extrapolator its :class:`nl_env.types.ExtrapolationInput`.

    Keeps references, not copies: samples are never written after they are delivered.
    """

    def __init__(self, camera: Camera, max_depth: float, extrapolator: DepthExtrapolator) -> None:
        self._camera = camera
        self._max_depth = max_depth
        self._odometry = extrapolator.odometry
        self._lidar_samples: deque[Sample] = deque(maxlen=extrapolator.history)
        self._since: list[Sample] = []

    def add(self, sample: Sample) -> None:
        """Take in the next sample; a LiDAR frame restarts the event window."""
        if sample.lidar is None:
            self._since.append(sample)
        else:
            self._lidar_samples.append(sample)
            self._since = []

    def inputs(self, sample: Sample) -> ExtrapolationInput:
        """Inputs for a depth frame at ``sample.t``; ``sample`` is the last one added."""
        lidar_samples = tuple(self._lidar_samples)
        poses = tuple(s.state.pose for s in (*lidar_samples, sample)) if self._odometry else ()
        return ExtrapolationInput(
            t=sample.t,
            camera=self._camera,
            max_depth=self._max_depth,
            lidar_frames=tuple(s.lidar for s in lidar_samples if s.lidar is not None),
            lidar_times=tuple(s.t for s in lidar_samples),
            bins=WindowBins(self._since),
            poses=poses,
        )

    @property
    def prior(self) -> NDArray[np.float32]:
        """``(H, W)`` float32, the last LiDAR frame; raises ``IndexError`` before the first."""
        lidar = self._lidar_samples[-1].lidar
        assert lidar is not None
        return lidar
