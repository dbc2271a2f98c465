"""What our networks look at: the last LiDAR frames moved to now, and the events since, as one stack.

Geometry does what it can before any learning: the last LiDAR frame and the one before are both splatted
into the present by the motion believed so far. Both networks read the same stack, once with the motion
continued from the last LiDAR interval (:mod:`nl_env.depth.motion_network`), once with the corrected one
(:mod:`nl_env.depth.refine`). All values are of order one and do not depend on the image size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from nl_env.depth.warp import splat
from nl_env.types import BINS, Camera

CHANNELS = (
    "warped log depth", "warped return", "warped hit", "warped inverse depth",
    "prior log depth", "prior return",
    "previous against warped", "previous hit",
    *(f"events {k}" for k in range(BINS)),
    "flow x", "flow y", "gap",
)  # fmt: skip
"""Names of the channels, in order."""

EVENTS = slice(CHANNELS.index("events 0"), CHANNELS.index("events 0") + BINS)
"""The channels of the voxel grid."""

_FLOW = slice(CHANNELS.index("flow x"), CHANNELS.index("flow y") + 1)

NEAREST = 1.0
"""Depths below are read as this one, m (as in the full-image metrics outdoors)."""

LOG_CENTRE, LOG_SCALE = 3.0, 1.5
"""Log depths enter as ``(ln d - LOG_CENTRE) / LOG_SCALE``; no return is the range."""

INVERSE_SCALE = 10.0
"""Inverse depths (1/m) enter multiplied by this."""

GAP_UNIT = 0.1
"""Gaps enter as ``log2(gap / GAP_UNIT) / 2``, s; event counts as ``sign(n) log(1 + |n|)``."""

COARSE_WIDTH = 160
"""Motion is estimated on images about this wide."""


@dataclass(frozen=True)
class Scene:
    """What is known at the moment of a trigger.

    Attributes:
        camera: intrinsics.
        max_depth: sensor range, m.
        prior: last LiDAR frame, ``(H, W)`` float32 m, 0 = no return.
        previous: the one before, or None at the start of a sequence.
        last_motion: ``(4, 4)``, takes points from the camera of ``previous`` to that of ``prior``.
        voxel: ``(5, H, W)`` float32 or int8, events since ``prior`` (Eq. 2), whole numbers.
        gap: time since ``prior``, s.
    """

    camera: Camera
    max_depth: float
    prior: NDArray[np.float32]
    previous: NDArray[np.float32] | None
    last_motion: NDArray[np.float64]
    voxel: NDArray[np.float32] | NDArray[np.int8]
    gap: float

    def coarse(self) -> Scene:
        """The same at about ``COARSE_WIDTH``: every n-th pixel of the depths, block means of the events."""
        step = _coarse_step(self.camera)
        if step == 1:
            return self
        camera, first = coarse_camera(self.camera), step // 2
        height, width = camera.shape
        chosen = np.s_[first : height * step : step, first : width * step : step]
        blocks = self.voxel[:, : height * step, : width * step].reshape(BINS, height, step, width, step)
        return Scene(
            camera,
            self.max_depth,
            np.ascontiguousarray(self.prior[chosen]),
            None if self.previous is None else np.ascontiguousarray(self.previous[chosen]),
            self.last_motion,
            blocks.mean((2, 4), dtype=np.float32),
            self.gap,
        )


def coarse_camera(camera: Camera) -> Camera:
    """The camera of :meth:`Scene.coarse`."""
    step = _coarse_step(camera)
    height, width = (side // step // 8 * 8 for side in camera.shape)
    first = step // 2
    return Camera(
        height,
        width,
        camera.fx / step,
        camera.fy / step,
        (camera.cx - first) / step,
        (camera.cy - first) / step,
    )


def _coarse_step(camera: Camera) -> int:
    return 2 ** max(round(math.log2(camera.width / COARSE_WIDTH)), 0)


def features(scene: Scene, motion: NDArray[np.float64], *, compensated: bool = False) -> NDArray[np.float32]:
    """The stack for the motion ``(4, 4)`` from the prior's camera to the present one.

    With ``compensated`` the events of every bin lie where the motion has carried their surface since the
    middle of the bin: with the right motion all bins show the same edges at the same places, and how
    they differ is how the motion is wrong.

    Holes of the warped frame show the prior's own value, as :func:`nl_env.depth.warp.warp` does.

    Returns:
        ``(len(CHANNELS), H, W)`` float32.

    Raises:
        ValueError: a frame or the voxel grid does not have the camera's shape, a gap that is not
            positive, or a motion that is no finite 4x4 matrix.
    """
    shape = scene.camera.shape
    if scene.voxel.shape != (BINS, *shape):
        raise ValueError(f"voxel: found shape {scene.voxel.shape}, expected {(BINS, *shape)}")
    if not scene.gap > 0:
        raise ValueError(f"gap: found {scene.gap!r} s, expected a positive time")
    warped, hit = splat(scene.prior, scene.camera, motion, scene.max_depth)
    if scene.previous is None:
        older, older_hit = warped, np.zeros(shape, np.bool_)
    else:
        older, older_hit = splat(scene.previous, scene.camera, motion @ scene.last_motion, scene.max_depth)
    stack = np.empty((len(CHANNELS), *shape), np.float32)
    camera = scene.camera
    _fill(
        (np.ascontiguousarray(scene.prior), warped, hit, older, older_hit),
        np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
        np.linalg.inv(motion),
        np.float32(scene.max_depth),
        np.float32(math.log2(scene.gap / GAP_UNIT) / 2),
        stack,
    )
    _fill_events(
        np.ascontiguousarray(scene.voxel, np.float32),
        stack[_FLOW],
        1.0 if compensated else 0.0,
        stack[EVENTS],
    )
    return stack


def hide_events(stack: NDArray[np.float32]) -> NDArray[np.float32]:
    """``stack`` as an event camera without events would have it; changed in place."""
    stack[EVENTS] = 0
    return stack


@njit(cache=True, error_model="numpy", inline="always")
def _coded(depth, max_depth):  # type: ignore[no-untyped-def]
    """Log depth code and whether there is a return."""
    valid = (depth > np.float32(0)) & (depth < max_depth)
    metres = max(depth, np.float32(NEAREST)) if valid else max_depth
    code = (np.log(np.float32(metres)) - np.float32(LOG_CENTRE)) * np.float32(1 / LOG_SCALE)
    return code, np.float32(1 if valid else 0)


@njit(cache=True, error_model="numpy")
def _fill(frames, intrinsics, back, max_depth, gap, stack):  # type: ignore[no-untyped-def]
    """Write every channel but the events; ``back`` takes points of the present camera to the prior's."""
    prior, warped, hit, older, older_hit = frames
    height, width = prior.shape
    fx, fy, cx, cy = intrinsics
    for y in range(height):
        ray_y = (y - cy) / fy
        for x in range(width):
            ray_x = (x - cx) / fx
            prior_code, prior_return = _coded(prior[y, x], max_depth)
            code, has_return = prior_code, prior_return
            depth = prior[y, x]
            if hit[y, x]:
                depth = warped[y, x]
                code, has_return = _coded(depth, max_depth)
            inverse = np.float32(1) / max(depth, np.float32(NEAREST)) if has_return > 0 else np.float32(0)
            stack[0, y, x] = code
            stack[1, y, x] = has_return
            stack[2, y, x] = hit[y, x]
            stack[3, y, x] = inverse * np.float32(INVERSE_SCALE)
            stack[4, y, x] = prior_code
            stack[5, y, x] = prior_return
            if older_hit[y, x]:
                stack[6, y, x] = _coded(older[y, x], max_depth)[0] - code
                stack[7, y, x] = 1
            else:
                stack[6, y, x] = 0
                stack[7, y, x] = 0
            # Where this pixel was in the prior: how far its surface moved, in pixels.
            px = back[0, 0] * ray_x + back[0, 1] * ray_y + back[0, 2] + inverse * back[0, 3]
            py = back[1, 0] * ray_x + back[1, 1] * ray_y + back[1, 2] + inverse * back[1, 3]
            pz = back[2, 0] * ray_x + back[2, 1] * ray_y + back[2, 2] + inverse * back[2, 3]
            pz = max(pz, 0.1)
            stack[8 + BINS, y, x] = np.arcsinh((ray_x - px / pz) * fx)
            stack[9 + BINS, y, x] = np.arcsinh((ray_y - py / pz) * fy)
            stack[10 + BINS, y, x] = gap


@njit(cache=True, error_model="numpy")
def _fill_events(voxel, flow, share, out):  # type: ignore[no-untyped-def]
    """Compressed counts; each bin moved by ``share`` of the flow (asinh px) since its middle, bilinear."""
    bins, height, width = voxel.shape
    for k in range(bins):
        back = share * (1 - (k + 0.5) / bins)
        for y in range(height):
            for x in range(width):
                if back == 0:
                    count = voxel[k, y, x]
                else:
                    column = x - back * math.sinh(flow[0, y, x])
                    row = y - back * math.sinh(flow[1, y, x])
                    count = _bilinear(voxel[k], column, row)
                if count == 0:
                    out[k, y, x] = 0
                else:
                    size = np.log1p(abs(count))
                    out[k, y, x] = size if count > 0 else -size


@njit(cache=True, error_model="numpy", inline="always")
def _bilinear(image, column, row):  # type: ignore[no-untyped-def]
    """Value between pixels; 0 outside of the image."""
    height, width = image.shape
    if not (0 <= column <= width - 1 and 0 <= row <= height - 1):
        return np.float32(0)
    i, j = min(int(column), width - 2), min(int(row), height - 2)
    a, b = np.float32(column - i), np.float32(row - j)
    top = image[j, i] + a * (image[j, i + 1] - image[j, i])
    bottom = image[j + 1, i] + a * (image[j + 1, i + 1] - image[j + 1, i])
    return top + b * (bottom - top)
