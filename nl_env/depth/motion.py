"""Ego motion between two depth frames: a small projective ICP on inverse depth.

Every pixel of the old frame is moved, projected into the new one, and compared with the surface found
there. The residual is the difference of inverse depth along the ray; linearised with the new frame's
inverse-depth slope it is the point-to-plane distance of projective ICP, and it stays finite for the
sky, whose outline is good evidence outdoors. Coarse to fine, from several starts, with bounded
weights against moving objects, edges and disocclusions.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from nl_env.depth.threads import together, usable_threads
from nl_env.depth.warp import inverse_depth
from nl_env.types import Camera

FINEST_WIDTH = 160
"""The finest pyramid level is the first one no wider than this; each coarser one halves it."""

STRIDE = 2
"""The finest level compares every second pixel of every second row."""

SCALES = (0.005, 0.01, 0.02, 0.05)
"""Relative residual from which a pixel is an outlier, finest level first. Blurred edges bias the
estimate towards longer motions, so the finest levels trust clean surfaces only."""

ITERATIONS = 15
"""Gauss-Newton steps a level at most."""

CONVERGED = 3e-4
"""A level ends when the largest component of its step (m, rad) is below this."""

STARTS = (0.0, 1.0, 2.0, 3.0)
"""Metres forward from the guess that the coarsest level is tried from; the best one is refined.
Small motions are found from any of them, fast driving (30 m/s at 10 Hz) needs the far ones."""

AHEAD_STEP, AHEAD_MOST = 0.25, 3.25
"""Metres forward from the guess that are compared once more at the finest level. Blurred by the coarser
ones, a road between rows of distant trees looks best when nothing moves at all: fast drives would be
taken for standing still."""

_SKY = 0.005
"""Inverse depth (1/m) added to the scale of relative residuals: below it, differences count less."""

_ROW, _FIELDS = FINEST_WIDTH, 8
"""Pixels of a row at most, and numbers that are kept of each while a row is compared."""

_DAMPING = np.array([1e-6, 1e-6, 1e-6, 1e-4, 1e-4, 1e-4])
"""Added to the mean normal equations: what the frames do not determine stays at the start."""


def se3_exp(twist: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rigid motion ``(4, 4)`` of a twist ``(6,)``: translation part (m), then rotation vector (rad)."""
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(twist[3:]).as_matrix()
    motion[:3, 3] = _mean_rotation(twist[3:]) @ twist[:3]
    return motion


def se3_log(motion: NDArray[np.float64]) -> NDArray[np.float64]:
    """The twist ``(6,)`` of a rigid motion ``(4, 4)``; the inverse of :func:`se3_exp`."""
    rotation = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    return np.concatenate([np.linalg.solve(_mean_rotation(rotation), motion[:3, 3]), rotation])


def continued(motion: NDArray[np.float64], fraction: float) -> NDArray[np.float64]:
    """Constant velocity: the motion over ``fraction`` times the duration of ``motion`` (4x4)."""
    return se3_exp(fraction * se3_log(motion))


def estimate_motion(
    old: NDArray[np.float32],
    new: NDArray[np.float32],
    camera: Camera,
    max_depth: float,
    guess: NDArray[np.float64] | None = None,
    *,
    threads: int | None = None,
) -> NDArray[np.float64]:
    """Rigid motion that takes points from the old frame's camera to the new frame's.

    Directions the frames do not determine (the way along a featureless road; everything, when a
    frame has no return) stay at ``guess``.

    Args:
        old, new: ``(H, W)`` float32 m, 0 = no return.
        camera: intrinsics of both.
        max_depth: sensor range, m.
        guess: ``(4, 4)`` start, for instance the previous motion; default standing still.
        threads: at most, see :func:`nl_env.depth.threads.usable_threads`; the result is the same.

    Returns:
        ``(4, 4)`` float64.

    Raises:
        ValueError: a frame does not have the camera's shape or ``guess`` is not ``(4, 4)``.
    """
    for name, frame in (("old", old), ("new", new)):
        if frame.shape != camera.shape:
            raise ValueError(f"{name}: found shape {frame.shape}, expected the camera's, {camera.shape}")
    start = np.eye(4) if guess is None else np.ascontiguousarray(guess, np.float64)
    if start.shape != (4, 4):
        raise ValueError(f"guess: found shape {start.shape}, expected (4, 4)")

    threads = usable_threads(camera.shape, threads)
    sources = _pyramid(inverse_depth(np.ascontiguousarray(old, np.float32), max_depth))
    targets = _pyramid(inverse_depth(np.ascontiguousarray(new, np.float32), max_depth))
    levels = [
        (source, target, _intrinsics(camera, source.shape[0]), scale, STRIDE if source is sources[0] else 1)
        for source, target, scale in zip(sources, targets, SCALES, strict=False)
    ]
    *finer, coarsest = levels
    starts = [_ahead(start, metres) for metres in STARTS]
    aligned = [(math.inf, start)] * len(starts)

    def align(first: int) -> None:
        for k in range(first, len(starts), threads):
            aligned[k] = _align(*coarsest, starts[k], ITERATIONS, CONVERGED, _DAMPING)

    together([partial(align, first) for first in range(threads)], threads)
    cost, motion = min(aligned, key=lambda trial: trial[0])
    for level in reversed(finer):
        cost, motion = _align(*level, motion, ITERATIONS, CONVERGED, _DAMPING)
    finest = levels[0]
    places = start[2, 3] - np.arange(0.0, AHEAD_MOST + AHEAD_STEP / 2, AHEAD_STEP)
    costs = np.empty(len(places))

    def compare(first: int) -> None:
        _costs_ahead(*finest, motion, places[first::threads], costs[first::threads])

    together([partial(compare, first) for first in range(threads)], threads)
    other = motion.copy()
    other[2, 3] = places[np.argmin(np.nan_to_num(costs, nan=np.inf))]
    other_cost, other = _align(*finest, other, ITERATIONS, CONVERGED, _DAMPING)
    return other if other_cost < cost else motion


class IntervalMotion:
    """:func:`estimate_motion` between two LiDAR frames, kept until other frames come."""

    def __init__(self) -> None:
        self._frames: tuple[NDArray[np.float32], ...] = ()
        self._motion, self._twist = np.eye(4), np.zeros(6)

    def __call__(
        self,
        previous: NDArray[np.float32],
        last: NDArray[np.float32],
        camera: Camera,
        max_depth: float,
        threads: int | None = None,
    ) -> NDArray[np.float64]:
        """Motion ``(4, 4)`` from ``previous`` to ``last``, which are told apart by identity."""
        if not (self._frames and self._frames[0] is previous and self._frames[1] is last):
            self._motion = estimate_motion(previous, last, camera, max_depth, threads=threads)
            self._twist = se3_log(self._motion)
            self._frames = (previous, last)
        return self._motion

    def continued(self, fraction: float) -> NDArray[np.float64]:
        """:func:`continued` for the motion that was asked for last."""
        return se3_exp(fraction * self._twist)


def _ahead(motion: NDArray[np.float64], metres: float) -> NDArray[np.float64]:
    """``motion``, and then this many metres along the optical axis."""
    ahead = motion.copy()
    ahead[2, 3] -= metres
    return ahead


def _mean_rotation(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """The mean rotation matrix on the way to a rotation vector: ``t = V v`` in the SE(3) exponential."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-4:
        return np.eye(3) + cross / 2 + cross @ cross / 6
    cosine = (1 - math.cos(angle)) / angle**2
    sine = (angle - math.sin(angle)) / angle**3
    return np.eye(3) + cosine * cross + sine * cross @ cross


def _intrinsics(camera: Camera, rows: int) -> NDArray[np.float64]:
    """``fx, fy, cx, cy`` of the camera at the pyramid level with this many rows."""
    factor = 2.0 ** round(math.log2(camera.height / rows))
    return np.array(
        [
            camera.fx / factor,
            camera.fy / factor,
            (camera.cx + 0.5) / factor - 0.5,
            (camera.cy + 0.5) / factor - 0.5,
        ]
    )


def _pyramid(image: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """Box-averaged halvings, finest first; a plane's inverse depth stays exact when averaged."""
    while image.shape[1] > FINEST_WIDTH:
        image = _halved(image)
    levels = [image]
    while len(levels) < len(SCALES) and min(levels[-1].shape) >= 16:
        levels.append(_halved(levels[-1]))
    return levels


@njit(cache=True, error_model="numpy")
def _halved(image):  # type: ignore[no-untyped-def]
    height, width = image.shape[0] // 2, image.shape[1] // 2
    half = np.empty((height, width), np.float32)
    for y in range(height):
        upper, lower, target = image[2 * y], image[2 * y + 1], half[y]
        for x in range(width):
            total = upper[2 * x] + lower[2 * x] + upper[2 * x + 1] + lower[2 * x + 1]
            target[x] = np.float32(0.25) * total
    return half


@njit(cache=True, error_model="numpy", nogil=True)
def _align(source, target, intrinsics, scale, stride, motion, iterations, converged, damping):  # type: ignore[no-untyped-def]
    """Gauss-Newton at one level; the best cost seen and its motion."""
    best_cost, best = np.inf, motion
    for _ in range(iterations):
        cost, normal, gradient = _normal_equations(source, target, intrinsics, scale, stride, motion)
        if cost < best_cost:
            best_cost, best = cost, motion
        for k in range(6):
            normal[k, k] += damping[k]
        step = _solved(normal, gradient)
        longest = 0.0
        for k in range(6):
            longest = max(longest, abs(step[k]))
        if longest < converged:
            break
        motion = _stepped(motion, step)
    return best_cost, best


@njit(cache=True, error_model="numpy", nogil=True)
def _costs_ahead(source, target, intrinsics, scale, stride, motion, places, costs):  # type: ignore[no-untyped-def]
    """What ``motion`` costs with each of ``places`` (m along the optical axis)."""
    trial = motion.copy()
    for k in range(places.size):
        trial[2, 3] = places[k]
        costs[k] = _cost(source, target, intrinsics, scale, stride, trial)


@njit(cache=True, error_model="numpy")
def _solved(normal, gradient):  # type: ignore[no-untyped-def]
    """``normal^-1 gradient`` for a positive definite matrix, by elimination in place."""
    size = gradient.size
    for k in range(size):
        for row in range(k + 1, size):
            factor = normal[row, k] / normal[k, k]
            for column in range(k, size):
                normal[row, column] -= factor * normal[k, column]
            gradient[row] -= factor * gradient[k]
    for k in range(size - 1, -1, -1):
        for column in range(k + 1, size):
            gradient[k] -= normal[k, column] * gradient[column]
        gradient[k] /= normal[k, k]
    return gradient


@njit(cache=True, error_model="numpy")
def _stepped(motion, step):  # type: ignore[no-untyped-def]
    """``motion``, then a small translation and rotation (the unit quaternion along ``(1, step / 2)``)."""
    x, y, z = 0.5 * step[3], 0.5 * step[4], 0.5 * step[5]
    s = 2.0 / (1.0 + x * x + y * y + z * z)
    moved = motion.copy()
    for k in range(4):
        a, b, c = motion[0, k], motion[1, k], motion[2, k]
        moved[0, k] += s * (-(y * y + z * z) * a + (x * y - z) * b + (x * z + y) * c)
        moved[1, k] += s * ((x * y + z) * a - (x * x + z * z) * b + (y * z - x) * c)
        moved[2, k] += s * ((x * z - y) * a + (y * z + x) * b - (x * x + y * y) * c)
    for k in range(3):
        moved[k, 3] += step[k]
    return moved


# A row of pixels is compared in steps, each a loop that runs on vectors: no branches, and one array of
# ``_ROW`` numbers a field between the steps. Only the look-up goes pixel by pixel, and so do the sums,
# whose order is fixed.


@njit(cache=True, error_model="numpy")
def _cost(source, target, intrinsics, scale, stride, motion):  # type: ignore[no-untyped-def]
    """The cost of :func:`_normal_equations` alone."""
    fields = np.empty(_FIELDS * _ROW)
    found = np.empty(4 * _ROW, np.float32)
    chosen, rays_x, rays_y = _chosen(source, intrinsics, stride)
    cost, seen = 0.0, 0
    for row in range(rays_y.size):
        _look_up(chosen[row], target, rays_x, rays_y[row], intrinsics, motion, fields, found)
        _weigh(rays_x.size, intrinsics, scale, fields, found)
        cost, seen = _sum_costs(rays_x.size, fields, cost, seen)
    return cost / seen if _enough(seen, stride, source) else 1.0


@njit(cache=True, error_model="numpy")
def _normal_equations(source, target, intrinsics, scale, stride, motion):  # type: ignore[no-untyped-def]
    """Robust cost, ``J^T W J`` and ``-J^T W r`` of one level, for a small motion applied on the left.

    All three are means over the pixels that stay in view. The cost is Geman-McClure's, in [0, 1];
    it is 1 (and the step 0) when less than a quarter of the image stays in view.
    """
    fields = np.empty(_FIELDS * _ROW)
    found = np.empty(4 * _ROW, np.float32)
    chosen, rays_x, rays_y = _chosen(source, intrinsics, stride)
    normal, gradient = np.zeros((6, 6)), np.zeros(6)
    cost, seen = 0.0, 0
    for row in range(rays_y.size):
        _look_up(chosen[row], target, rays_x, rays_y[row], intrinsics, motion, fields, found)
        _weigh(rays_x.size, intrinsics, scale, fields, found)
        cost, seen = _sum_costs(rays_x.size, fields, cost, seen)
        _derive(rays_x.size, fields)
        _sum_equations(rays_x.size, fields, normal, gradient)
    if not _enough(seen, stride, source):
        return 1.0, np.zeros((6, 6)), np.zeros(6)
    for k in range(6):
        for m in range(k):
            normal[m, k] = normal[k, m]
    per_pixel = 1.0 / seen
    return cost / seen, normal * per_pixel, gradient * per_pixel


@njit(cache=True, error_model="numpy")
def _chosen(source, intrinsics, stride):  # type: ignore[no-untyped-def]
    """Every ``stride``-th pixel of every ``stride``-th row, and the directions of columns and rows."""
    fx, fy, cx, cy = intrinsics
    height, width = source.shape
    rays_x = (np.arange(0, width, stride) - cx) * (1.0 / fx)
    rays_y = (np.arange(0, height, stride) - cy) * (1.0 / fy)
    return source[::stride, ::stride].copy(), rays_x, rays_y


@njit(cache=True, error_model="numpy", inline="always")
def _enough(seen, stride, source):  # type: ignore[no-untyped-def]
    return seen * stride**2 >= source.size / 4


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _look_up(row, target, rays_x, ray_y, intrinsics, motion, fields, found):  # type: ignore[no-untyped-def]
    """Move the pixels of a row, and fetch the four pixels of ``target`` around where each lands.

    Fields: where it lands (two numbers, as a direction), its inverse depth then, how far it lands behind
    the first of the four (two numbers), and that one's index, -1 out of view.
    """
    fx, fy, cx, cy = intrinsics
    r00, r01, r02, tx = motion[0]
    r10, r11, r12, ty = motion[1]
    r20, r21, r22, tz = motion[2]
    row_x, row_y, row_z = r01 * ray_y + r02, r11 * ray_y + r12, r21 * ray_y + r22
    height, width = target.shape
    columns, last_x, last_y = np.float64(width), width - 1.0, height - 1.0
    for k in range(row.size):
        # The moved point, times its old inverse depth: finite for the sky.
        ray_x, w = rays_x[k], row[k]
        px = r00 * ray_x + (w * tx + row_x)
        py = r10 * ray_x + (w * ty + row_y)
        pz = r20 * ray_x + (w * tz + row_z)
        nearness = 1.0 / pz
        u, v = px * nearness, py * nearness
        x, y = u * fx + cx, v * fy + cy
        seen = (pz >= 0.1) & (x >= 0) & (x < last_x) & (y >= 0) & (y < last_y)
        x = x if seen else 0.0
        y = y if seen else 0.0
        left, top = np.floor(x), np.floor(y)
        fields[k] = u
        fields[k + _ROW] = v
        fields[k + 2 * _ROW] = w / pz
        fields[k + 3 * _ROW] = x - left
        fields[k + 4 * _ROW] = y - top
        fields[k + 5 * _ROW] = top * columns + left if seen else -1.0
    pixels, below = target.reshape(-1), np.uint64(width)
    for k in range(row.size):
        first = np.uint64(max(fields[k + 5 * _ROW], 0.0))
        found[k] = pixels[first]
        found[k + _ROW] = pixels[first + np.uint64(1)]
        found[k + 2 * _ROW] = pixels[first + below]
        found[k + 3 * _ROW] = pixels[first + below + np.uint64(1)]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _weigh(count, intrinsics, scale, fields, found):  # type: ignore[no-untyped-def]
    """Compare the pixels that :func:`_look_up` moved with what it found there.

    Fields: as there, but instead of the last three the slopes of the inverse depth along the directions,
    and the residual's weight before it is squared, -1 out of view; then the residual and its scale.
    """
    fx, fy, _, _ = intrinsics
    per_scale = 1.0 / scale
    for k in range(count):
        a, b, seen = fields[k + 3 * _ROW], fields[k + 4 * _ROW], fields[k + 5 * _ROW] >= 0
        # Inverse depth found there, and its slope, bilinear.
        here = found[k]
        top = found[k + _ROW] - here
        left = found[k + 2 * _ROW] - here
        twist = np.float64(found[k + 3 * _ROW] - (top + found[k + 2 * _ROW]))
        down = a * twist + left
        there = b * down + (a * top + here)
        moved = fields[k + 2 * _ROW]
        size = 1.0 / (moved + _SKY + there)
        residual = size * (there - moved)
        relative = residual * per_scale
        inlier = 1.0 / (relative * relative + 1.0)
        fields[k + 3 * _ROW] = (b * twist + top) * fx
        fields[k + 4 * _ROW] = down * fy
        fields[k + 5 * _ROW] = inlier if seen else -1.0
        fields[k + 6 * _ROW] = residual
        fields[k + 7 * _ROW] = size


@njit(cache=True, error_model="numpy")
def _sum_costs(count, fields, cost, seen):  # type: ignore[no-untyped-def]
    """``cost`` with those of a row that :func:`_weigh` weighed, and how many pixels were in view by then."""
    for k in range(count):
        inlier = fields[k + 5 * _ROW]
        if inlier >= 0:
            cost = (cost + 1.0) - inlier
            seen += 1
    return cost, seen


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _derive(count, fields):  # type: ignore[no-untyped-def]
    """How the residuals change with a small motion.

    Fields: the six derivatives, the weight, -1 out of view, and its product with the residual.
    """
    for k in range(count):
        v, u, moved = fields[k + _ROW], fields[k], fields[k + 2 * _ROW]
        inlier, residual, size = fields[k + 5 * _ROW], fields[k + 6 * _ROW], fields[k + 7 * _ROW]
        weight = inlier * inlier
        # How found - moved changes when the point shifts by (dx, dy, dz) times its depth. The last digits
        # hang on the order of these lines, and recorded frames on the last digits.
        dy = fields[k + 4 * _ROW] * size
        dx = fields[k + 3 * _ROW] * size
        dz = moved * size - (dx * u + dy * v)
        fields[k] = dx * moved
        fields[k + _ROW] = dy * moved
        fields[k + 2 * _ROW] = dz * moved
        fields[k + 3 * _ROW] = dz * v - dy
        fields[k + 4 * _ROW] = dx - dz * u
        fields[k + 5 * _ROW] = dy * u - dx * v
        fields[k + 6 * _ROW] = weight if inlier >= 0 else -1.0
        fields[k + 7 * _ROW] = weight * residual


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _sum_equations(count, fields, normal, gradient):  # type: ignore[no-untyped-def]
    """Add a row that :func:`_derive` derived, pixel by pixel; the upper triangle is left out."""
    for pixel in range(count):
        weight, pull = fields[pixel + 6 * _ROW], fields[pixel + 7 * _ROW]
        if weight < 0:
            continue
        # The first entry is rounded in another order than the others: recorded frames depend on it.
        first = fields[pixel]
        gradient[0] -= pull * first
        normal[0, 0] += weight * (first * first)
        for k in range(1, 6):
            derivative = fields[pixel + k * _ROW]
            weighted = weight * derivative
            gradient[k] -= pull * derivative
            for m in range(k + 1):
                normal[k, m] += weighted * fields[pixel + m * _ROW]
