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

from nl_env.depth.threads import together
from nl_env.depth.warp import z_buffer
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

_WARPED, _PRIOR, _PREVIOUS = map(
    CHANNELS.index, ("warped log depth", "prior log depth", "previous against warped")
)
"""The channels that hold metres first, and then logarithms, which NumPy takes many at a time."""

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


def features(
    scene: Scene,
    motion: NDArray[np.float64],
    *,
    compensated: bool = False,
    threads: int = 1,
    out: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """The stack for the motion ``(4, 4)`` from the prior's camera to the present one.

    With ``compensated`` the events of every bin lie where the motion has carried their surface since the
    middle of the bin: with the right motion all bins show the same edges at the same places, and how
    they differ is how the motion is wrong.

    Holes of the warped frame show the prior's own value, as :func:`nl_env.depth.warp.warp` does.

    Args:
        scene, motion, compensated: see above.
        threads: with two or more, what comes from the prior and what comes from the frame before and the
            events are made at once; the result is the same.
        out: where to put the stack, ``(len(CHANNELS), H, W)`` float32 of consecutive values.

    Returns:
        ``(len(CHANNELS), H, W)`` float32.

    Raises:
        ValueError: a frame, the voxel grid or ``out`` does not have the camera's shape, a gap that is not
            positive, or a motion that is no finite 4x4 matrix.
    """
    shape = scene.camera.shape
    if scene.voxel.shape != (BINS, *shape):
        raise ValueError(f"voxel: found shape {scene.voxel.shape}, expected {(BINS, *shape)}")
    if not scene.gap > 0:
        raise ValueError(f"gap: found {scene.gap!r} s, expected a positive time")
    expected = len(CHANNELS), *shape
    stack = np.empty(expected, np.float32) if out is None else out
    if stack.shape != expected or stack.dtype != np.float32 or not stack.flags.c_contiguous:
        raise ValueError(f"out: found {stack.dtype} {stack.shape}, expected consecutive float32 {expected}")

    def add_past() -> None:
        _add_previous(scene, motion, stack)
        if not compensated:
            stack[EVENTS] = scene.voxel
            _compress(stack[EVENTS])

    together((lambda: _add_prior(scene, motion, stack), add_past), threads)
    _compare(stack)
    if compensated:
        _carry_events(np.ascontiguousarray(scene.voxel, np.float32), stack[_FLOW], stack[EVENTS])
        _compress(stack[EVENTS])
    return stack


def _add_prior(scene: Scene, motion: NDArray[np.float64], stack: NDArray[np.float32]) -> None:
    """The channels of the prior, as it was and warped, and what its motion says."""
    warped = z_buffer(scene.prior, scene.camera, motion, scene.max_depth)
    camera = scene.camera
    _fill_prior(np.ascontiguousarray(scene.prior), warped, np.float32(scene.max_depth), stack)
    np.log(stack[_WARPED], out=stack[_WARPED])
    np.log(stack[_PRIOR], out=stack[_PRIOR])
    _fill_codes(stack)
    _fill_flow(
        np.array([camera.fx, camera.fy, camera.cx, camera.cy]), np.linalg.inv(motion), stack[3], stack[_FLOW]
    )
    np.arcsinh(stack[_FLOW], out=stack[_FLOW])
    stack[_FLOW.stop :] = math.log2(scene.gap / GAP_UNIT) / 2


def _add_previous(scene: Scene, motion: NDArray[np.float64], stack: NDArray[np.float32]) -> None:
    """The previous frame warped: its logarithms, and where it is hit."""
    if scene.previous is None:
        older = np.full(scene.camera.shape, np.float32(-1))
    else:
        older = z_buffer(scene.previous, scene.camera, motion @ scene.last_motion, scene.max_depth)
    _fill_previous(older, np.float32(scene.max_depth), stack)
    np.log(stack[_PREVIOUS], out=stack[_PREVIOUS])


def hide_events(stack: NDArray[np.float32]) -> NDArray[np.float32]:
    """``stack`` as an event camera without events would have it; changed in place."""
    stack[EVENTS] = 0
    return stack


# The loops below go over few arrays each and have no branches: they run on vectors then.


@njit(cache=True, error_model="numpy", nogil=True)
def _fill_prior(prior, warped, max_depth, stack):  # type: ignore[no-untyped-def]
    """Channels of the prior and of its z-buffer ``warped``, metres instead of logarithms."""
    height, width = prior.shape
    farthest = np.float32(1) / max_depth
    for y in range(height):
        _fill_metres(prior[y], max_depth, stack[4, y], stack[5, y])
        found, own, depth, hit = warped[y], prior[y], stack[0, y], stack[2, y]
        for x in range(width):
            moved = np.float32(1) / found[x] if found[x] > farthest else np.float32(0)
            depth[x] = moved if found[x] >= 0 else own[x]
            hit[x] = np.float32(1 if found[x] >= 0 else 0)
        _fill_metres(depth, max_depth, depth, stack[1, y])
        metres, has_return, inverse = stack[0, y], stack[1, y], stack[3, y]
        for x in range(width):
            inverse[x] = np.float32(1) / metres[x] if has_return[x] > 0 else np.float32(0)


@njit(cache=True, error_model="numpy", nogil=True)
def _fill_previous(older, max_depth, stack):  # type: ignore[no-untyped-def]
    """Channels of the z-buffer ``older`` of the previous frame, metres instead of logarithms."""
    height, width = older.shape
    farthest = np.float32(1) / max_depth
    for y in range(height):
        found, depth, hit = older[y], stack[6, y], stack[7, y]
        for x in range(width):
            depth[x] = np.float32(1) / found[x] if found[x] > farthest else np.float32(0)
        _fill_metres(depth, max_depth, depth, hit)
        for x in range(width):
            hit[x] = np.float32(1 if found[x] >= 0 else 0)


@njit(cache=True, error_model="numpy", inline="always")
def _fill_metres(depth, max_depth, metres, has_return):  # type: ignore[no-untyped-def]
    """Depths that have a logarithm, no return being the range, and whether there is a return."""
    for x in range(depth.size):
        valid = (depth[x] > 0) & (depth[x] < max_depth)
        has_return[x] = np.float32(1 if valid else 0)
        metres[x] = max(depth[x], np.float32(NEAREST)) if valid else max_depth


@njit(cache=True, error_model="numpy", nogil=True)
def _fill_codes(stack):  # type: ignore[no-untyped-def]
    """Logarithms of the prior's depths to codes."""
    for y in range(stack.shape[1]):
        warped, prior = stack[0, y], stack[4, y]
        for x in range(warped.size):
            prior[x] = _code(prior[x])
        for x in range(warped.size):
            warped[x] = _code(warped[x])


@njit(cache=True, error_model="numpy", nogil=True)
def _compare(stack):  # type: ignore[no-untyped-def]
    """Logarithms of the previous frame's depths to what they differ by from the prior's where it is hit."""
    for y in range(stack.shape[1]):
        warped, older, hit = stack[0, y], stack[6, y], stack[7, y]
        for x in range(warped.size):
            older[x] = _code(older[x]) - warped[x] if hit[x] > 0 else np.float32(0)


@njit(cache=True, error_model="numpy", inline="always")
def _code(logarithm):  # type: ignore[no-untyped-def]
    return (logarithm - np.float32(LOG_CENTRE)) * np.float32(1 / LOG_SCALE)


@njit(cache=True, error_model="numpy", nogil=True)
def _fill_flow(intrinsics, back, inverse, flow):  # type: ignore[no-untyped-def]
    """Where every pixel was in the prior: how far its surface moved, in pixels; then scale ``inverse``.

    ``back`` takes points of the present camera to the prior's.
    """
    fx, fy, cx, cy = intrinsics
    _, height, width = flow.shape
    rays_x = (np.arange(width) - cx) / fx
    x0, x1, x2, x3 = back[0]
    y0, y1, y2, y3 = back[1]
    z0, z1, z2, z3 = back[2]
    for y in range(height):
        ray_y = (y - cy) / fy
        near, flow_x, flow_y = inverse[y], flow[0, y], flow[1, y]
        for x in range(width):
            ray_x, w = rays_x[x], near[x]
            px = x0 * ray_x + x1 * ray_y + x2 + w * x3
            py = y0 * ray_x + y1 * ray_y + y2 + w * y3
            pz = z0 * ray_x + z1 * ray_y + z2 + w * z3
            away = 1.0 / max(pz, 0.1)
            flow_x[x] = (ray_x - px * away) * fx
            flow_y[x] = (ray_y - py * away) * fy
            near[x] = w * np.float32(INVERSE_SCALE)


@njit(cache=True, error_model="numpy")
def _carry_events(voxel, flow, out):  # type: ignore[no-untyped-def]
    """Counts of each bin moved by the flow (asinh px) since its middle, bilinear."""
    bins, height, width = voxel.shape
    for k in range(bins):
        back = 1 - (k + 0.5) / bins
        for y in range(height):
            for x in range(width):
                column = x - back * math.sinh(flow[0, y, x])
                row = y - back * math.sinh(flow[1, y, x])
                out[k, y, x] = _bilinear(voxel[k], column, row)


def _compress(counts: NDArray[np.float32]) -> None:
    """``sign(n) log(1 + |n|)``, in place; bin by bin, which the caches hold."""
    sizes = np.empty_like(counts[0])
    for grid in counts:
        np.log1p(np.abs(grid, out=sizes), out=sizes)
        np.copysign(sizes, grid, out=grid)


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
