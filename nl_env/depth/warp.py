"""Forward warp: the depth frame an earlier one becomes after the camera has moved.

Every pixel is a small piece of a plane whose slope comes from its neighbours. Inverse depth is affine
in the image on a plane, so the piece moves as a homography: a target pixel belongs to a source pixel
when its centre, taken back through that piece, falls inside the source pixel's square. Pieces of one
surface therefore tile it without cracks and without growing over its edges, whatever the motion, and
the depth is that of the plane at the target's own centre. The nearest piece wins (z-buffer).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from nl_env.types import Camera

NEAR = 0.3
"""Surfaces nearer than this after the motion are dropped, m."""

_EMPTY = np.float32(-1)
_REACH = 0.55
_ZERO = np.float32(0)
_CHUNK = 64
"""Pixels of a row that are moved together before they are drawn."""


def splat(
    depth: NDArray[np.float32], camera: Camera, motion: NDArray[np.float64], max_depth: float
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Move every pixel of a depth frame into the camera's new pose (forward z-buffer splat).

    A pixel without a return is infinitely far: it moves with the rotation alone and loses against
    every surface.

    Args:
        depth: ``(H, W)`` float32 m, 0 or anything from ``max_depth`` on = no return.
        camera: intrinsics of both frames.
        motion: ``(4, 4)``, takes points from the old camera's frame to the new one's.
        max_depth: sensor range, m; what moves beyond it is no return any more.

    Returns:
        The warped frame ``(H, W)`` float32, 0 = no return, and the hit mask ``(H, W)`` bool: pixels
        that some source pixel, of a surface or of the sky, landed on. Elsewhere the frame is 0.

    Raises:
        ValueError: ``depth`` does not have the camera's shape or ``motion`` is no finite 4x4 matrix.
    """
    buffer = z_buffer(depth, camera, motion, max_depth)
    with np.errstate(divide="ignore"):
        warped = np.where(buffer > 1 / max_depth, 1 / buffer, _ZERO)
    return warped, buffer >= 0


def z_buffer(
    depth: NDArray[np.float32], camera: Camera, motion: NDArray[np.float64], max_depth: float
) -> NDArray[np.float32]:
    """What :func:`splat` makes its frame of: ``(H, W)`` float32 inverse depth after the motion, 1/m.

    It is 0 where only the sky landed, -1 where nothing did; surfaces beyond the range are still there.
    Arguments and errors are those of :func:`splat`.
    """
    depth = np.ascontiguousarray(depth, np.float32)
    if depth.shape != camera.shape:
        raise ValueError(f"depth: found shape {depth.shape}, expected the camera's, {camera.shape}")
    motion = np.ascontiguousarray(motion, np.float64)
    if motion.shape != (4, 4) or not np.isfinite(motion).all():
        raise ValueError(f"motion: found {motion!r}, expected a finite (4, 4) matrix")
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    return _splat(depth, np.float32(max_depth), intrinsics, motion)


def warp(
    depth: NDArray[np.float32], camera: Camera, motion: NDArray[np.float64], max_depth: float
) -> NDArray[np.float32]:
    """:func:`splat`, with holes (disocclusions and what enters the view) kept from ``depth`` itself."""
    warped, hit = splat(depth, camera, motion, max_depth)
    return np.where(hit, warped, depth)


def inverse_depth(depth: NDArray[np.float32], max_depth: float) -> NDArray[np.float32]:
    """``1 / depth`` in 1/m, float32; 0 where there is no return."""
    valid = (depth > 0) & (depth < max_depth)
    return np.divide(np.float32(1), depth, out=np.zeros_like(depth), where=valid)


@njit(cache=True, error_model="numpy", inline="always")
def _slope(before, here, after):  # type: ignore[no-untyped-def]
    """Change of inverse depth per pixel from one neighbour to the other, on the surface of ``here``.

    On one surface both one-sided differences agree; at an edge the smaller one is the surface's own
    and the other crosses the edge. Opposite signs are no slope at all (an isolated leaf, a crease).
    The image border and the sky (0) have no say, unless there is nothing else; the sky has no slope.
    """
    left = here - before
    right = after - here
    slope = left if abs(left) < abs(right) else right
    slope = _ZERO if left * right <= 0 else slope
    slope = left if after == 0 else slope
    slope = right if before == 0 else slope
    return _ZERO if (here == 0) | ((before == 0) & (after == 0)) else slope


@njit(cache=True, error_model="numpy")
def _padded_inverse(depth, max_depth):  # type: ignore[no-untyped-def]
    """:func:`inverse_depth` with a margin of one pixel of sky."""
    height, width = depth.shape
    inverse = np.zeros((height + 2, width + 2), np.float32)
    for y in range(height):
        source, target = depth[y], inverse[y + 1, 1:-1]
        for x in range(width):
            valid = (source[x] > 0) & (source[x] < max_depth)
            target[x] = np.float32(1) / source[x] if valid else _ZERO
    return inverse


@njit(cache=True, error_model="numpy")
def _land(above, row, below, rays, count, ray_y, size, intrinsics, motion, way, pieces):  # type: ignore[no-untyped-def]
    """The pieces of ``count`` pixels of a row after the motion, a field of ``_CHUNK`` numbers each.

    The fields are the piece's plane (three numbers), and the first and last column and the first and last
    row of the pixels it may cover. Without branches and in one array, so that it runs on vectors.

    Args:
        above, row, below: three rows of padded inverse depth, from the pixel before the first one.
        rays, ray_y: directions of the pixels' columns and of their row.
        size: last column and row of the image.
        way: the camera's way in the old frame.
    """
    fx, fy, cx, cy = intrinsics
    r00, r01, r02, tx = motion[0]
    r10, r11, r12, ty = motion[1]
    r20, r21, r22, tz = motion[2]
    sx, sy, sz = way
    last_x, last_y = size
    wide, high = fx / fy, fy / fx
    for k in range(count):
        ray_x = rays[k]
        w = row[k + 1]
        # The plane n . X = 1 through this pixel, whose inverse depth is n . (ray_x, ray_y, 1).
        nx = fx * _slope(row[k], w, row[k + 2])
        ny = fy * _slope(above[k + 1], w, below[k + 1])
        nz = w - nx * ray_x - ny * ray_y
        # The pixel's centre, then its plane, in the new frame.
        px = r00 * ray_x + r01 * ray_y + r02 + w * tx
        py = r10 * ray_x + r11 * ray_y + r12 + w * ty
        pz = r20 * ray_x + r21 * ray_y + r22 + w * tz
        scale = 1.0 / (1.0 + nx * sx + ny * sy + nz * sz)
        pieces[k] = scale * (r00 * nx + r01 * ny + r02 * nz)
        pieces[k + _CHUNK] = scale * (r10 * nx + r11 * ny + r12 * nz)
        pieces[k + 2 * _CHUNK] = scale * (r20 * nx + r21 * ny + r22 * nz)
        # Where it lands in the image, and how far the pixel's square reaches around it: the
        # derivative of the homography at the centre, with a margin for its curvature.
        nearness = 1.0 / pz
        u = px * nearness
        v = py * nearness
        u_x = (r00 + nx * tx - u * (r20 + nx * tz)) * nearness
        u_y = (r01 + ny * tx - u * (r21 + ny * tz)) * nearness
        v_x = (r10 + nx * ty - v * (r20 + nx * tz)) * nearness
        v_y = (r11 + ny * ty - v * (r21 + ny * tz)) * nearness
        reach_u = _REACH * (abs(u_x) + abs(u_y) * wide)
        reach_v = _REACH * (abs(v_x) * high + abs(v_y))
        u = u * fx + cx
        v = v * fy + cy
        seen = (pz > NEAR * w) & (scale > 0)
        pieces[k + 3 * _CHUNK] = np.ceil(max(u - reach_u, 0.0)) if seen else 1.0
        pieces[k + 4 * _CHUNK] = np.floor(max(min(u + reach_u, last_x), -1.0)) if seen else 0.0
        pieces[k + 5 * _CHUNK] = np.ceil(max(v - reach_v, 0.0)) if seen else 1.0
        pieces[k + 6 * _CHUNK] = np.floor(max(min(v + reach_v, last_y), -1.0)) if seen else 0.0


@njit(cache=True, error_model="numpy", nogil=True)
def _splat(depth, max_depth, intrinsics, motion):  # type: ignore[no-untyped-def]
    """Z-buffer of inverse depth after the motion: 0 where only sky landed, -1 where nothing did."""
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics
    rays_x = (np.arange(width) - cx) / fx
    rays_y = (np.arange(height) - cy) / fy
    r00, r01, r02, tx = motion[0]
    r10, r11, r12, ty = motion[1]
    r20, r21, r22, tz = motion[2]
    # The camera's way in the old frame: a new ray p with inverse depth w meets R^T (p - w t).
    sx = r00 * tx + r10 * ty + r20 * tz
    sy = r01 * tx + r11 * ty + r21 * tz
    sz = r02 * tx + r12 * ty + r22 * tz
    way, size = (sx, sy, sz), (width - 1.0, height - 1.0)
    inverse = _padded_inverse(depth, max_depth)
    buffer = np.full((height, width), _EMPTY)
    pieces = np.empty(7 * _CHUNK)
    for y in range(height):
        ray_y = rays_y[y]
        for first in range(0, width, _CHUNK):
            count = min(_CHUNK, width - first)
            above, row, below = inverse[y, first:], inverse[y + 1, first:], inverse[y + 2, first:]
            _land(above, row, below, rays_x[first:], count, ray_y, size, intrinsics, motion, way, pieces)
            for k in range(count):
                ray_x = rays_x[first + k]
                surface = row[k + 1] > 0
                mx, my, mz = pieces[k], pieces[k + _CHUNK], pieces[k + 2 * _CHUNK]
                left, right = int(pieces[k + 3 * _CHUNK]), int(pieces[k + 4 * _CHUNK])
                for j in range(int(pieces[k + 5 * _CHUNK]), int(pieces[k + 6 * _CHUNK]) + 1):
                    q_y = rays_y[j]
                    for i in range(left, right + 1):
                        q_x = rays_x[i]
                        moved = mx * q_x + my * q_y + mz
                        if moved <= buffer[j, i] or (surface and moved <= 0):
                            continue
                        # Back in the old frame the centre must lie in the source pixel's square.
                        back_x = r00 * q_x + r10 * q_y + r20 - moved * sx
                        back_y = r01 * q_x + r11 * q_y + r21 - moved * sy
                        back_z = r02 * q_x + r12 * q_y + r22 - moved * sz
                        reach = 0.5 * abs(back_z)
                        if (
                            abs(back_x - ray_x * back_z) * fx <= reach
                            and abs(back_y - ray_y * back_z) * fy <= reach
                        ):
                            buffer[j, i] = moved
    return buffer
