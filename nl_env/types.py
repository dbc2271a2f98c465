"""Shared vocabulary: event dtype, camera, samples, and the protocols every layer speaks.

Units and conventions: time is ``int64`` microseconds and windows are half-open ``[t0, t1)``;
images are row-major ``(H, W)``, x right, y down; depth is ``float32`` metres along the optical
axis with ``0.0`` meaning *no return*; poses are 4x4 camera-to-world matrices, camera axes x right,
y down, z forward, world axes x, y horizontal and z up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

EVENT_DTYPE = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "i1")])
"""One event: time (us), column, row, polarity in {-1, +1}. Arrays are sorted by ``t``."""

TICK_US = 5_000
"""Rendering period: intensity and depth exist at 200 Hz."""

SLICE_US = 20_000
"""Decision period: one event frame, one action."""

TICKS_PER_SLICE = SLICE_US // TICK_US

BINS = 5
"""Temporal bins of a voxel grid (B in Eq. 2), and of one slice (4 ms each)."""

RESOLUTIONS: dict[str, tuple[int, int]] = {
    "full": (480, 640),
    "half": (240, 320),
    "quarter": (120, 160),
}
"""Named image sizes ``(H, W)``."""


@dataclass(frozen=True)
class Camera:
    """Pinhole camera; pixel centres lie at integer coordinates.

    Attributes:
        height, width: image size in pixels.
        fx, fy: focal lengths in pixels.
        cx, cy: principal point in pixels.
    """

    height: int
    width: int
    fx: float
    fy: float
    cx: float
    cy: float

    @classmethod
    def from_fov(cls, height: int, width: int, fov_deg: float) -> Camera:
        """Camera with square pixels, centred principal point and horizontal field of view ``fov_deg``."""
        focal = width / 2 / math.tan(math.radians(fov_deg) / 2)
        return cls(height, width, focal, focal, (width - 1) / 2, (height - 1) / 2)

    @property
    def shape(self) -> tuple[int, int]:
        """``(H, W)``."""
        return self.height, self.width


@dataclass(frozen=True)
class EgoState:
    """What the simulator knows about the vehicle at one instant.

    Attributes:
        pose: ``(4, 4)`` float64, camera to world.
        twist: ``(6,)`` float64, camera-frame linear velocity (m/s) then angular velocity (rad/s).
        speed: ego speed, m/s.
        shortest_distance: to the nearest surface of a surrounding actor, m (``inf`` when there is none).
        new_actors: actors that entered the view during the slice.
    """

    pose: NDArray[np.float64]
    twist: NDArray[np.float64]
    speed: float
    shortest_distance: float
    new_actors: int


@dataclass(frozen=True)
class Sample:
    """Everything the sensors deliver at the end of one 20 ms slice.

    Attributes:
        index: slice number k; ``t == k * SLICE_US``. Sample 0 has no events and a LiDAR frame.
        t: time, us.
        bins: ``(5, H, W)`` int16, signed event sums in the five 4 ms bins of ``[t - SLICE_US, t)``.
        event_frame: ``(H, W)`` int16, the sum of ``bins`` (Eq. 1).
        event_count: number of events in the slice.
        depth: ``(H, W)`` float32, the true depth at ``t`` as a dense LiDAR quantises it.
        lidar: ``(H, W)`` float32, the LiDAR frame measured at ``t``, or None between LiDAR frames.
        state: ego state at ``t``.
    """

    index: int
    t: int
    bins: NDArray[np.int16]
    event_frame: NDArray[np.int16]
    event_count: int
    depth: NDArray[np.float32]
    lidar: NDArray[np.float32] | None
    state: EgoState

    @property
    def has_lidar(self) -> bool:
        """Whether a LiDAR frame arrives."""
        return self.lidar is not None

    @property
    def active_fraction(self) -> float:
        """Share of pixels whose event frame is not zero."""
        return float(np.count_nonzero(self.event_frame)) / self.event_frame.size


class SensorStream(Protocol):
    """A sequence of samples, one per 20 ms, from a simulator or a recording.

    Attributes:
        camera: intrinsics of both pixel-aligned sensors.
        slices: index of the last sample; the sequence lasts ``slices * SLICE_US``.
        lidar_period: slices between LiDAR frames (5 at 10 Hz).
        max_depth: sensor range, m.
    """

    camera: Camera
    slices: int
    lidar_period: int
    max_depth: float

    def reset(self, seed: int) -> Sample:
        """Start the sequence of ``seed``; return sample 0 (a LiDAR frame at ``t = 0``, no events)."""
        ...

    def advance(self) -> Sample:
        """Return the next sample; raises ``RuntimeError`` before ``reset`` or past the last sample."""
        ...

    def intensity(self) -> NDArray[np.float32]:
        """``(H, W)`` float32 in [0, 1]: what a frame camera would see now (for display only)."""
        ...

    def describe(self) -> dict[str, Any]:
        """Scenario, style, weather and seed of the running sequence, JSON-ready."""
        ...

    def close(self) -> None:
        """Release everything; may be called twice."""
        ...


@dataclass(frozen=True)
class ExtrapolationInput:
    """What a depth extrapolator may look at when it is triggered at time ``t``.

    Attributes:
        t: time of the wanted depth frame, us.
        camera: intrinsics.
        max_depth: sensor range, m.
        lidar_frames: the last LiDAR frames, oldest first, each ``(H, W)`` float32, 0 = no return.
        lidar_times: their times, us.
        bins: one ``(5, H, W)`` int16 array per slice since the last LiDAR frame, oldest first
            (``representations.voxel_from_bins`` turns them into the voxel grid of Eq. 2).
        poses: camera-to-world poses at ``lidar_times`` and at ``t``, only when the extrapolator
            declares ``odometry = True``.
    """

    t: int
    camera: Camera
    max_depth: float
    lidar_frames: Sequence[NDArray[np.float32]]
    lidar_times: Sequence[int]
    bins: Sequence[NDArray[np.int16]]
    poses: Sequence[NDArray[np.float64]] = field(default=())


@dataclass(frozen=True)
class Extrapolation:
    """A produced depth frame.

    Attributes:
        depth: ``(H, W)`` float32 metres, 0 = no return.
        depth_if_return: optional ``(H, W)`` float32, depth where a return would be; the paper's
            metrics, which ignore pixels without a true return, may use it.
    """

    depth: NDArray[np.float32]
    depth_if_return: NDArray[np.float32] | None = None


@runtime_checkable
class DepthExtrapolator(Protocol):
    """Predicts the depth frame at ``t`` from LiDAR frames and the events since.

    Attributes:
        history: how many LiDAR frames it wants at most (early in a sequence it gets fewer, at least 1).
        odometry: whether it wants true camera poses.
    """

    history: int
    odometry: bool

    def reset(self) -> None:
        """Forget the previous sequence."""
        ...

    def __call__(self, inputs: ExtrapolationInput) -> Extrapolation: ...


@runtime_checkable
class BatchExtrapolator(DepthExtrapolator, Protocol):
    """A :class:`DepthExtrapolator` that can make several frames of a sequence at once."""

    def batch(self, inputs: Sequence[ExtrapolationInput]) -> list[Extrapolation]:
        """What single calls give, up to rounding; all of it may be of one or of several LiDAR intervals."""
        ...


class TriggerPolicy(Protocol):
    """Decides at every slice whether to trigger; the signature is Stable-Baselines3's ``predict``."""

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:
        """Return ``(action, state)``; action 1 triggers, 0 holds."""
        ...
