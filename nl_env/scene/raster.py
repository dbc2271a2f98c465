"""Rasterisation: from the draw list (see ``listing``) to a depth and an index buffer.

Depth is kept as ``w = 1 / z``: on a plane ``w``, ``s w`` and ``t w`` are affine in the pixel, so a span of a
parallelogram needs no division and its ends follow from four straight lines. Only ``w`` and an index are
written here, eight pixels at a time (see ``lanes``); ``shading`` colours what stays visible.

Kernels take plain arrays and unsigned indices: slices and fields of tuples cost reference counting, and
signed indices a wrap-around test, in loops that run millions of times a second.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from nl_env.lanes import (
    EXACT,
    LANES,
    first_of,
    fused,
    gather,
    load,
    quotient,
    ramp,
    row_of,
    splat,
    store,
    to_float,
    to_int,
    where,
)
from nl_env.scene.textures import SIZE

f4 = np.float32
i4 = np.int32
u4 = np.uint32
u8 = np.uint64
ZERO, ONE = f4(0), f4(1)
GROUND, SKY_ID, CUTOUT, OUTSIDE = i4(0), i4(-1), i4(-2), i4(2**31 - 1)
"""Index buffer: the ground, the sky, draw-list row ``r`` as ``r + 1``, a cut-out texel as
``CUTOUT - (r << 8 | texel)``, and the spare columns, which end every run."""
NEAR = 0.15
"""Nearest visible depth, m."""
FAST: dict[str, Any] = {"fastmath": True, "error_model": "numpy", "cache": True, "boundscheck": False}
INLINE: dict[str, Any] = {**FAST, "forceinline": True}

# Columns of a packed quad (see quads.Quads.packed).
ORIGIN, U, V, NORMAL = 0, 3, 6, 9
ALBEDO, TEXTURE_ID, REPEAT, SHIFT, DENSITY_PER_M, HAS_HOLES, TWO_SIDED = 12, 13, 14, 16, 18, 19, 20
PACKED = 21

# Columns of the draw list, one row per visible quad: planes of w, s w and t w over the pixel ...
W0, WX, WY, A0, AX, AY, B0, BX, BY = range(9)
# ... the four edges: x is at least LOW + LOW_SLOPE y and at most HIGH + HIGH_SLOPE y, one of them far off ...
LOW, LOW_SLOPE, HIGH, HIGH_SLOPE = 9, 13, 17, 21
TOP, BOTTOM, LEFT, RIGHT = 25, 26, 27, 28
# ... and the material.
GREY, CONTRAST, TEXTURE, REPEAT_U, REPEAT_V, SHIFT_U, SHIFT_V, DENSITY, HOLES = range(29, 38)
COLUMNS = 38
UNBOUNDED = 1e30
"""Beyond every pixel."""


@njit(**INLINE)
def _four(table, r, column):
    """A value of each edge of draw-list row ``r``."""
    return table[r, column], table[r, column + 1], table[r, column + 2], table[r, column + 3]


@njit(**INLINE)
def _edges(table, r):
    """The bounds of draw-list row ``r`` as values, so that they stay in registers while rows are filled."""
    lows, highs = _four(table, r, LOW), _four(table, r, HIGH)
    low_slopes, high_slopes = _four(table, r, LOW_SLOPE), _four(table, r, HIGH_SLOPE)
    return table[r, LEFT], table[r, RIGHT], lows, low_slopes, highs, high_slopes


@njit(**INLINE)
def _span(edges, y):
    """First and last pixel of a quad on image row ``y``."""
    low, high, (l0, l1, l2, l3), (a0, a1, a2, a3), (h0, h1, h2, h3), (b0, b1, b2, b3) = edges
    low = max(low, max(max(l0 + a0 * y, l1 + a1 * y), max(l2 + a2 * y, l3 + a3 * y)))
    return low, min(high, min(min(h0 + b0 * y, h1 + b1 * y), min(h2 + b2 * y, h3 + b3 * y)))


@njit(**FAST)
def rasterise(first, last, used, table, cutouts, inverse_depth, index):
    """Draw the listed quads on image rows ``first`` to ``last - 1``."""
    for r in range(used):
        row = u8(r)
        y0 = max(first, int(table[row, TOP]))
        y1 = min(last - 1, int(table[row, BOTTOM]))
        if y1 < y0:
            continue
        if table[row, HOLES] == 0.0:
            _fill_opaque(table, row, y0, y1, inverse_depth, index)
        else:
            _fill_cutout(table, row, y0, y1, cutouts, inverse_depth, index)


@njit(**INLINE)
def _fill_opaque(table, r, first, last, inverse_depth, index):
    """Depth-test an opaque quad on image rows ``first`` to ``last`` and write its index."""
    label = i4(i4(r) + i4(1))
    edges = _edges(table, r)
    w0, wx, wy = table[r, W0], table[r, WX], table[r, WY]
    step = f4(wx)
    beyond = float(inverse_depth.shape[1])
    for row in range(first, last + 1):
        low, high = _span(edges, float(row))
        # Neighbouring faces share edges: a hair of overlap leaves no crack between them. The ends of an
        # empty span can be astronomically far: cut before they become integers.
        x0 = math.ceil(min(low, beyond) - 1e-4)
        n = math.floor(max(high, -1.0) + 1e-4) + 1 - x0
        if n > 0:
            start = f4(w0 + wy * row + wx * x0)
            _draw_opaque(x0, n, start, step, label, row_of(inverse_depth, row), row_of(index, row))


@njit(**EXACT)
def _draw_opaque(x0, n, start, step, label, inverse_depth, index):
    """Pixels ``x0`` to ``x0 + n - 1`` of one image row, with ``w = start + step i``."""
    for i in range(0, n, LANES):
        w = along(i, start, step)
        nearest = load(inverse_depth, x0 + i)
        closer = (w > nearest) & first_of(n - i)
        _keep_nearest(x0 + i, w, splat(label), closer, nearest, inverse_depth, index)


@njit(**EXACT)
def along(i, start, step):
    """``start + step (i + k)`` for the lanes ``k``."""
    return fused(splat(step), to_float(ramp() + splat(i)), splat(start))


@njit(**EXACT)
def _keep_nearest(x, w, label, closer, nearest, inverse_depth, index):
    """Write ``w`` and ``label`` from pixel ``x`` on where they are ``closer``."""
    store(inverse_depth, x, where(closer, w, nearest))
    store(index, x, where(closer, label, load(index, x)))


@njit(**INLINE)
def _fill_cutout(table, r, first, last, cutouts, inverse_depth, index):
    """Depth-test a quad with holes and write its row number and texel."""
    base = i4(CUTOUT - (i4(r) << i4(8)))
    texture = i4(i4(table[r, TEXTURE]) * i4(SIZE * SIZE))
    scale_u, scale_v = table[r, REPEAT_U] * SIZE, table[r, REPEAT_V] * SIZE
    shift_u, shift_v = f4(table[r, SHIFT_U] * SIZE), f4(table[r, SHIFT_V] * SIZE)
    edges = _edges(table, r)
    w0, wx, wy = table[r, W0], table[r, WX], table[r, WY]
    a0, ax, ay = table[r, A0] * scale_u, table[r, AX] * scale_u, table[r, AY] * scale_u
    b0, bx, by = table[r, B0] * scale_v, table[r, BX] * scale_v, table[r, BY] * scale_v
    beyond = float(inverse_depth.shape[1])
    for row in range(first, last + 1):
        low, high = _span(edges, float(row))
        x0 = math.ceil(min(low, beyond))
        n = math.floor(max(high, -1.0)) + 1 - x0
        if n > 0:
            start = f4(w0 + wy * row + wx * x0)
            start_a = f4(a0 + ay * row + ax * x0)
            start_b = f4(b0 + by * row + bx * x0)
            _draw_cutout(
                x0, n, start, f4(wx), start_a, f4(ax), shift_u, start_b, f4(bx), shift_v, texture, base,
                row_of(cutouts, 0), row_of(inverse_depth, row), row_of(index, row),
            )  # fmt: skip


@njit(**EXACT)
def _draw_cutout(x0, n, start, step, start_a, step_a, shift_a, start_b, step_b, shift_b,
                 texture, base, cutouts, inverse_depth, index):  # fmt: skip
    """Pixels ``x0`` to ``x0 + n - 1`` of one image row: ``w``, ``s w`` and ``t w`` are ``start + step i``.

    Depth is ``1 / w`` by :func:`lanes.quotient` for whole groups of pixels and exact for the rest. Images
    depend on it in their last bits.
    """
    one = splat(ONE)
    whole = n // LANES * LANES
    for i in range(0, whole, LANES):
        w = along(i, start, step)
        u = fused(along(i, start_a, step_a), quotient(one, w), splat(shift_a))
        v = fused(along(i, start_b, step_b), quotient(one, w), splat(shift_b))
        _draw_texels(x0 + i, LANES, w, u, v, texture, base, cutouts, inverse_depth, index)
    if whole < n:
        w = along(whole, start, step)
        u = fused(along(whole, start_a, step_a), one / w, splat(shift_a))
        v = fused(along(whole, start_b, step_b), one / w, splat(shift_b))
        _draw_texels(x0 + whole, n - whole, w, u, v, texture, base, cutouts, inverse_depth, index)


@njit(**EXACT)
def _draw_texels(x, left, w, u, v, texture, base, cutouts, inverse_depth, index):
    """Depth-test eight texels, ``u`` and ``v`` in texels, that are not holes."""
    inside = splat(SIZE - 1)
    at = splat(texture) + (((to_int(v) & inside) << splat(8)) | (to_int(u) & inside))
    nearest = load(inverse_depth, x)
    closer = (w > nearest) & first_of(left)
    texel = gather(cutouts, at, closer)
    _keep_nearest(x, w, splat(base) - texel, texel > splat(0), nearest, inverse_depth, index)


@njit(**FAST)
def clear(inverse_depth, index, first, last, width, w0, wx, wy):
    """Start image rows ``first`` to ``last - 1`` with the ground plane and the sky above it."""
    step = f4(wx)
    for row in range(first, last):
        y = u8(row)
        start = f4(w0 + wy * row)
        for x in range(width):
            w = start + step * f4(i4(x))
            above = w <= f4(2e-4)
            inverse_depth[y, x] = ZERO if above else w
            index[y, x] = SKY_ID if above else GROUND


@njit(**FAST)
def write_depth(inverse_depth, depth, far):
    """z-depth in metres, 0 beyond ``far``."""
    limit = f4(1.0 / far)
    for y in range(depth.shape[0]):
        for x in range(depth.shape[1]):
            w = inverse_depth[y, x]
            z = ONE / max(w, limit)
            depth[y, x] = z if w > limit else ZERO
