"""The loops of :mod:`nl_env.depth.motion`: one level of the projective ICP on inverse depth, compiled."""

from __future__ import annotations

import numpy as np
from numba import njit

FINEST_WIDTH = 160
"""The finest pyramid level is the first one no wider than this; each coarser one halves it."""

_SKY = 0.005
"""Inverse depth (1/m) added to the scale of relative residuals: below it, differences count less."""

_ROW, _FIELDS = FINEST_WIDTH, 8
"""Pixels of a row at most, and numbers that are kept of each while a row is compared."""


@njit(cache=True, error_model="numpy")
def halved(image):  # type: ignore[no-untyped-def]
    """Means of 2x2 pixels, ``(H // 2, W // 2)`` float32; an odd last row or column is left out."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    half = np.empty((height, width), np.float32)
    for y in range(height):
        upper, lower, target = image[2 * y], image[2 * y + 1], half[y]
        for x in range(width):
            total = upper[2 * x] + lower[2 * x] + upper[2 * x + 1] + lower[2 * x + 1]
            target[x] = np.float32(0.25) * total
    return half


@njit(cache=True, error_model="numpy", nogil=True)
def align(source, target, intrinsics, scale, stride, motion, iterations, converged, damping):  # type: ignore[no-untyped-def]
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
def costs_ahead(source, target, intrinsics, scale, stride, motion, places, costs):  # type: ignore[no-untyped-def]
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
