"""Forward warp: the depth frame an earlier one becomes after the camera has moved.

Every pixel is a small piece of a plane whose slope comes from its neighbours. Inverse depth is affine
in the image on a plane, so the piece moves as a homography: a target pixel belongs to a source pixel
when its centre, taken back through that piece, falls inside the source pixel's square. Pieces of one
surface therefore tile it without cracks and without growing over its edges, whatever the motion, and
the depth is that of the plane at the target's own centre. The nearest piece wins (z-buffer).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from nl_env.types import Camera

NEAR = 0.3
"""Surfaces nearer than this after the motion are dropped, m."""

_EMPTY = np.float32(-1)
_REACH = 0.55
_ZERO = np.float32(0)


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
    depth = np.ascontiguousarray(depth, np.float32)
    if depth.shape != camera.shape:
        raise ValueError(f"depth: found shape {depth.shape}, expected the camera's, {camera.shape}")
    motion = np.ascontiguousarray(motion, np.float64)
    if motion.shape != (4, 4) or not np.isfinite(motion).all():
        raise ValueError(f"motion: found {motion!r}, expected a finite (4, 4) matrix")
    inverse = inverse_depth(depth, max_depth)
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    buffer = _splat(inverse, intrinsics, motion[:3, :3].copy(), motion[:3, 3].copy())
    with np.errstate(divide="ignore"):
        warped = np.where(buffer > 1 / max_depth, 1 / buffer, _ZERO)
    return warped, buffer >= 0


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


@njit(cache=True, error_model="numpy")
def _slope(row, x):  # type: ignore[no-untyped-def]
    """Change of inverse depth per pixel along ``row``, on the surface pixel ``x`` lies on.

    On one surface both one-sided differences agree; at an edge the smaller one is the surface's own
    and the other crosses the edge. Opposite signs are no slope at all (an isolated leaf, a crease).
    The image border and the sky have no say, unless there is nothing else.
    """
    here = row[x]
    before = row[x - 1] if x > 0 else _ZERO
    after = row[x + 1] if x < row.size - 1 else _ZERO
    if before == 0 and after == 0:
        return _ZERO
    left = here - before
    right = after - here
    if before == 0:
        return right
    if after == 0:
        return left
    if left * right <= 0:
        return _ZERO
    return left if abs(left) < abs(right) else right


@njit(cache=True, error_model="numpy")
def _splat(inverse, intrinsics, rotation, translation):  # type: ignore[no-untyped-def]
    """Z-buffer of inverse depth after the motion: 0 where only sky landed, -1 where nothing did."""
    height, width = inverse.shape
    fx, fy, cx, cy = intrinsics
    r00, r01, r02 = rotation[0]
    r10, r11, r12 = rotation[1]
    r20, r21, r22 = rotation[2]
    tx, ty, tz = translation
    # The camera's way in the old frame: a new ray p with inverse depth w meets R^T (p - w t).
    sx = r00 * tx + r10 * ty + r20 * tz
    sy = r01 * tx + r11 * ty + r21 * tz
    sz = r02 * tx + r12 * ty + r22 * tz
    buffer = np.full((height, width), _EMPTY)
    for y in range(height):
        ray_y = (y - cy) / fy
        for x in range(width):
            ray_x = (x - cx) / fx
            w = inverse[y, x]
            nx = ny = nz = 0.0
            if w > 0:
                # The plane n . X = 1 through this pixel, whose inverse depth is n . (ray_x, ray_y, 1).
                nx = fx * _slope(inverse[y], x)
                ny = fy * _slope(inverse[:, x], y)
                nz = w - nx * ray_x - ny * ray_y
            # The pixel's centre, then its plane, in the new frame.
            px = r00 * ray_x + r01 * ray_y + r02 + w * tx
            py = r10 * ray_x + r11 * ray_y + r12 + w * ty
            pz = r20 * ray_x + r21 * ray_y + r22 + w * tz
            if pz <= NEAR * w:
                continue
            scale = 1.0 / (1.0 + nx * sx + ny * sy + nz * sz)
            if scale <= 0:
                continue
            mx = scale * (r00 * nx + r01 * ny + r02 * nz)
            my = scale * (r10 * nx + r11 * ny + r12 * nz)
            mz = scale * (r20 * nx + r21 * ny + r22 * nz)
            # Where it lands in the image, and how far the pixel's square reaches around it: the
            # derivative of the homography at the centre, with a margin for its curvature.
            u = px / pz
            v = py / pz
            u_x = (r00 + nx * tx - u * (r20 + nx * tz)) / pz
            u_y = (r01 + ny * tx - u * (r21 + ny * tz)) / pz
            v_x = (r10 + nx * ty - v * (r20 + nx * tz)) / pz
            v_y = (r11 + ny * ty - v * (r21 + ny * tz)) / pz
            reach_u = _REACH * (abs(u_x) + abs(u_y) * fx / fy)
            reach_v = _REACH * (abs(v_x) * fy / fx + abs(v_y))
            u = u * fx + cx
            v = v * fy + cy
            left = math.ceil(max(u - reach_u, 0.0))
            right = math.floor(min(u + reach_u, width - 1.0))
            for j in range(math.ceil(max(v - reach_v, 0.0)), math.floor(min(v + reach_v, height - 1.0)) + 1):
                q_y = (j - cy) / fy
                for i in range(left, right + 1):
                    q_x = (i - cx) / fx
                    moved = mx * q_x + my * q_y + mz
                    if moved < buffer[j, i] or (w > 0 and moved <= 0):
                        continue
                    back_z = r02 * q_x + r12 * q_y + r22 - moved * sz
                    back_x = (r00 * q_x + r10 * q_y + r20 - moved * sx) / back_z
                    back_y = (r01 * q_x + r11 * q_y + r21 - moved * sy) / back_z
                    if abs(back_x - ray_x) * fx <= 0.5 and abs(back_y - ray_y) * fy <= 0.5:
                        buffer[j, i] = moved
    return buffer
