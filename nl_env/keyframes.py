"""The paper's keyframe rule, and the visibility rule behind its third cause.

A slice is a keyframe when the ego vehicle is faster than 10 m/s, or the nearest surrounding actor is
closer than 8 m, or a new actor enters the view ("Characterizing a Keyframe"). Each cause is kept on
its own, because detectors find them with different success.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from nl_env.types import Camera, EgoState

SPEED_LIMIT = 10.0
"""m/s; faster is a keyframe."""
DISTANCE_LIMIT = 8.0
"""m; closer is a keyframe."""
VIEW_RANGE = 60.0
"""m; an actor farther away covers a few pixels only and does not count as seen."""
VIEW_MEMORY_US = 1_000_000
"""An actor hidden for less than this long is still known when it comes back."""
NEAR_PLANE = 0.5
"""m; centres closer than this to the camera plane are not projected."""
HALF_HEIGHTS_DEEP = 4.0
"""Half-heights between an actor's centre and the nearest surface of its own that may cover it. Four reach
from the centre to the end of a car (0.75 m) and of a lorry (1.8 m)."""


@dataclass(frozen=True)
class Keyframe:
    """The label of one slice and its three causes."""

    speed: bool
    distance: bool
    new: bool

    @property
    def label(self) -> bool:
        """True if any cause holds."""
        return self.speed or self.distance or self.new


def label_keyframe(state: EgoState) -> Keyframe:
    """Apply the paper's rule to one ego state."""
    return Keyframe(
        speed=bool(state.speed > SPEED_LIMIT),
        distance=bool(state.shortest_distance < DISTANCE_LIMIT),
        new=state.new_actors > 0,
    )


def visible(
    centres: NDArray[np.float64],
    pose: NDArray[np.float64],
    depth: NDArray[np.float32],
    camera: Camera,
) -> NDArray[np.bool_]:
    """Which actors the sensors see.

    An actor is visible when its centre projects into the image within ``VIEW_RANGE`` and nothing
    nearer than the actor itself lies on that pixel.

    Args:
        centres: ``(n, 4)`` float64; world x, y, z of each body's centre and its half-height, m.
        pose: ``(4, 4)`` camera to world.
        depth: ``(H, W)`` float32 true depth, 0 = no return.
        camera: intrinsics of ``depth``.

    Returns:
        ``(n,)`` bool.
    """
    seen = np.zeros(len(centres), dtype=np.bool_)
    _mark_visible(
        (centres[:, :3] - pose[:3, 3]) @ pose[:3, :3],
        centres[:, 3],
        depth,
        (camera.fx, camera.fy, camera.cx, camera.cy),
        seen,
    )
    return seen


@njit(cache=True, error_model="numpy")
def _mark_visible(points, half_heights, depth, intrinsics, seen):  # type: ignore[no-untyped-def]
    """:func:`visible` of ``(n, 3)`` points in the camera's frame."""
    fx, fy, cx, cy = intrinsics
    height, width = depth.shape
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        if not NEAR_PLANE < z < VIEW_RANGE:
            continue
        column, row = np.rint(fx * x / z + cx), np.rint(fy * y / z + cy)
        if 0 <= column < width and 0 <= row < height:
            surface = depth[int(row), int(column)]
            seen[k] = surface == 0 or surface >= z - HALF_HEIGHTS_DEEP * half_heights[k]


class NewActorDetector:
    """Counts the actors that enter the view, slice by slice.

    An actor is new when it is visible now and has not been visible during the last
    ``VIEW_MEMORY_US``. Those visible in the first slice of a sequence are not new.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self._last_seen: NDArray[np.int64] | None = None

    def reset(self) -> None:
        """Forget every actor; the next update starts a sequence."""
        self._last_seen = None

    def update(
        self,
        centres: NDArray[np.float64],
        pose: NDArray[np.float64],
        depth: NDArray[np.float32],
        t_us: int,
    ) -> int:
        """Number of new actors at ``t_us``; arguments as for :func:`visible`, the same actors every time."""
        seen = visible(centres, pose, depth, self.camera)
        if self._last_seen is None:
            self._last_seen = np.full(len(centres), t_us - 2 * VIEW_MEMORY_US, dtype=np.int64)
            new = 0
        else:
            new = int(np.count_nonzero(seen & (t_us - self._last_seen > VIEW_MEMORY_US)))
        self._last_seen[seen] = t_us
        return new
