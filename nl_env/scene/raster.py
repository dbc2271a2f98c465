"""Rasterisation: from packed parallelograms to a depth and an index buffer.

Depth is kept as ``w = 1 / z``: on a plane ``w``, ``s w`` and ``t w`` are affine in the pixel, so a span of a
parallelogram needs no division and its ends follow from four straight lines. Only ``w`` and an index are
written here; ``shading`` colours what stays visible.

Kernels take plain arrays and unsigned indices: slices and fields of tuples cost reference counting, and
signed indices a wrap-around test, in loops that run millions of times a second.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from nl_env.scene.textures import SIZE, UNIT

f4 = np.float32
i4 = np.int32
u4 = np.uint32
u8 = np.uint64
ZERO, ONE = f4(0), f4(1)
GROUND, SKY_ID, CUTOUT = i4(0), i4(-1), i4(-2)
"""Index buffer: the ground, the sky, draw-list row ``r`` as ``r + 1``, and a cut-out texel as
``CUTOUT - (r << 8 | texel)``."""
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
# ... the four edges as x = EDGE + SLOPE y, and whether the inside is to the right ...
EDGE, SLOPE, SIDE = 9, 13, 17
TOP, BOTTOM, LEFT, RIGHT = 21, 22, 23, 24
# ... and the material.
GREY, CONTRAST, TEXTURE, REPEAT_U, REPEAT_V, SHIFT_U, SHIFT_V, DENSITY, HOLES = range(25, 34)
COLUMNS = 34


@njit(**FAST)
def cull_objects(centre, radius, rotation, eye, lens, width, height, far, visible):
    """Indices of the objects whose bounding sphere meets the view frustum; returns how many."""
    fx, fy, cx, cy = lens
    count = 0
    lx, rx, ty, by = cx + 1.0, width - cx, cy + 1.0, height - cy
    ln, rn = 1.0 / math.sqrt(fx * fx + lx * lx), 1.0 / math.sqrt(fx * fx + rx * rx)
    tn, bn = 1.0 / math.sqrt(fy * fy + ty * ty), 1.0 / math.sqrt(fy * fy + by * by)
    smallest = 0.35 / fx
    for m in range(radius.shape[0]):
        x, y, z = centre[0, m] - eye[0], centre[1, m] - eye[1], centre[2, m] - eye[2]
        r = radius[m]
        zc = rotation[0, 2] * x + rotation[1, 2] * y + rotation[2, 2] * z
        if zc < -r or zc > far + r or r < smallest * zc:
            continue
        xc = rotation[0, 0] * x + rotation[1, 0] * y + rotation[2, 0] * z
        yc = rotation[0, 1] * x + rotation[1, 1] * y + rotation[2, 1] * z
        if (fx * xc + lx * zc) * ln < -r or (rx * zc - fx * xc) * rn < -r:
            continue
        if (fy * yc + ty * zc) * tn < -r or (by * zc - fy * yc) * bn < -r:
            continue
        visible[count] = m
        count += 1
    return count


@njit(**FAST)
def list_quads(packed, visible, count, first, size, rotation, eye, lens, width, height, far, table, used):
    """Append the visible quads of ``count`` objects to the draw list; returns its length."""
    for j in range(count):
        m = visible[j]
        for q in range(first[m], first[m] + size[m]):
            if project(packed, u8(q), rotation, eye, lens, width, height, far, table, u8(used)):
                used += 1
    return used


@njit(**INLINE)
def project(packed, q, rotation, eye, lens, width, height, far, table, r):
    """Write draw-list row ``r`` for quad ``q``; returns False when it cannot be seen."""
    fx, fy, cx, cy = lens
    ex, ey, ez = packed[q, 0] - eye[0], packed[q, 1] - eye[1], packed[q, 2] - eye[2]
    facing = packed[q, NORMAL] * ex + packed[q, NORMAL + 1] * ey + packed[q, NORMAL + 2] * ez
    if facing >= 0.0 and packed[q, TWO_SIDED] == ZERO:
        return False
    ux, uy, uz = packed[q, U], packed[q, U + 1], packed[q, U + 2]
    vx, vy, vz = packed[q, V], packed[q, V + 1], packed[q, V + 2]
    o2 = rotation[0, 2] * ex + rotation[1, 2] * ey + rotation[2, 2] * ez
    u2 = rotation[0, 2] * ux + rotation[1, 2] * uy + rotation[2, 2] * uz
    v2 = rotation[0, 2] * vx + rotation[1, 2] * vy + rotation[2, 2] * vz
    z1, z2, z3 = o2 + u2, o2 + v2, o2 + u2 + v2
    z_min = min(min(o2, z1), min(z2, z3))
    if max(max(o2, z1), max(z2, z3)) < NEAR or z_min > far:
        return False
    o0 = rotation[0, 0] * ex + rotation[1, 0] * ey + rotation[2, 0] * ez
    o1 = rotation[0, 1] * ex + rotation[1, 1] * ey + rotation[2, 1] * ez
    u0 = rotation[0, 0] * ux + rotation[1, 0] * uy + rotation[2, 0] * uz
    u1 = rotation[0, 1] * ux + rotation[1, 1] * uy + rotation[2, 1] * uz
    v0 = rotation[0, 0] * vx + rotation[1, 0] * vy + rotation[2, 0] * vz
    v1 = rotation[0, 1] * vx + rotation[1, 1] * vy + rotation[2, 1] * vz
    # The corners behind the camera have no image: there the edges alone bound the spans.
    top, bottom, left, right = 0.0, height - 1.0, 0.0, width - 1.0
    if z_min >= NEAR:
        p0, p1, p2, p3 = 1.0 / o2, 1.0 / z1, 1.0 / z2, 1.0 / z3
        y0, y1, y2, y3 = o1 * p0, (o1 + u1) * p1, (o1 + v1) * p2, (o1 + u1 + v1) * p3
        x0, x1, x2, x3 = o0 * p0, (o0 + u0) * p1, (o0 + v0) * p2, (o0 + u0 + v0) * p3
        top = math.ceil(max(fy * min(min(y0, y1), min(y2, y3)) + cy, top))
        bottom = math.floor(min(fy * max(max(y0, y1), max(y2, y3)) + cy, bottom))
        left = math.ceil(max(fx * min(min(x0, x1), min(x2, x3)) + cx, left))
        right = math.floor(min(fx * max(max(x0, x1), max(x2, x3)) + cx, right))
        if top > bottom or left > right:
            return False
    # Cramer's rule for O + s U + t V = z d: w = 1 / z, s w and t w are linear in the ray d.
    a0, a1, a2 = v1 * o2 - v2 * o1, v2 * o0 - v0 * o2, v0 * o1 - v1 * o0
    b0, b1, b2 = o1 * u2 - o2 * u1, o2 * u0 - o0 * u2, o0 * u1 - o1 * u0
    c0, c1, c2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
    det = u0 * a0 + u1 * a1 + u2 * a2
    if abs(det) < 1e-9:
        return False
    s = 1.0 / det
    sx, sy = s / fx, s / fy
    a0, b0, c0 = a0 * sx, b0 * sx, c0 * sx
    a1, b1, c1 = a1 * sy, b1 * sy, c1 * sy
    a2 = a2 * s - a0 * cx - a1 * cy
    b2 = b2 * s - b0 * cx - b1 * cy
    c2 = c2 * s - c0 * cx - c1 * cy
    table[r, W0], table[r, WX], table[r, WY] = c2, c0, c1
    table[r, A0], table[r, AX], table[r, AY] = a2, a0, a1
    table[r, B0], table[r, BX], table[r, BY] = b2, b0, b1
    _edge(table, r, u8(0), a2, a0, a1)
    _edge(table, r, u8(1), c2 - a2, c0 - a0, c1 - a1)
    _edge(table, r, u8(2), b2, b0, b1)
    _edge(table, r, u8(3), c2 - b2, c0 - b0, c1 - b1)
    table[r, TOP], table[r, BOTTOM], table[r, LEFT], table[r, RIGHT] = top, bottom, left, right
    table[r, TEXTURE] = packed[q, TEXTURE_ID]
    table[r, HOLES] = packed[q, HAS_HOLES]
    table[r, REPEAT_U], table[r, REPEAT_V] = packed[q, REPEAT], packed[q, REPEAT + 1]
    table[r, SHIFT_U], table[r, SHIFT_V] = packed[q, SHIFT], packed[q, SHIFT + 1]
    density = SIZE * packed[q, DENSITY_PER_M]
    table[r, DENSITY] = density
    albedo = packed[q, ALBEDO]
    contrast = 0.0
    if packed[q, HAS_HOLES] != ZERO:
        # Beyond one texel per pixel the grain averages out; the holes stay, as a point-sampled depth needs.
        texels = density * 0.5 * (o2 + z3) / fx
        contrast = albedo / UNIT * min(1.0, 1.0 / max(texels, 1e-6))
    table[r, CONTRAST] = contrast
    table[r, GREY] = albedo - contrast * UNIT
    return True


@njit(**INLINE)
def _edge(table, r, e, p0, px, py):
    """Store the half-plane ``p0 + px x + py y >= 0`` as a bound on x."""
    px = 1e-20 if abs(px) < 1e-20 else px
    inverse = -1.0 / px
    table[r, u8(EDGE) + e] = p0 * inverse
    table[r, u8(SLOPE) + e] = py * inverse
    table[r, u8(SIDE) + e] = px


@njit(**INLINE)
def _edges(table, r):
    """The bounds of draw-list row ``r`` as values, so that they stay in registers while rows are filled."""
    return (
        table[r, LEFT], table[r, RIGHT],
        table[r, EDGE], table[r, SLOPE], table[r, SIDE],
        table[r, EDGE + 1], table[r, SLOPE + 1], table[r, SIDE + 1],
        table[r, EDGE + 2], table[r, SLOPE + 2], table[r, SIDE + 2],
        table[r, EDGE + 3], table[r, SLOPE + 3], table[r, SIDE + 3],
    )  # fmt: skip


@njit(**INLINE)
def _narrow(low, high, edge, slope, side, y):
    """Cut the span at one edge."""
    x = edge + slope * y
    inside_right = side > 0.0
    return max(low, x if inside_right else low), min(high, high if inside_right else x)


@njit(**INLINE)
def _span(edges, y):
    """First and last pixel of a quad on image row ``y``."""
    low, high, e0, s0, d0, e1, s1, d1, e2, s2, d2, e3, s3, d3 = edges
    low, high = _narrow(low, high, e0, s0, d0, y)
    low, high = _narrow(low, high, e1, s1, d1, y)
    low, high = _narrow(low, high, e2, s2, d2, y)
    return _narrow(low, high, e3, s3, d3, y)


@njit(**FAST)
def rasterise(first, last, used, table, cutouts, inverse_depth, index, texel_at, texel):
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
            _fill_cutout(table, row, y0, y1, cutouts, inverse_depth, index, texel_at, texel)


@njit(**INLINE)
def _fill_opaque(table, r, first, last, inverse_depth, index):
    """Depth-test an opaque quad on image rows ``first`` to ``last`` and write its index."""
    label = i4(i4(r) + i4(1))
    edges = _edges(table, r)
    w0, wx, wy = table[r, W0], table[r, WX], table[r, WY]
    step = f4(wx)
    for row in range(first, last + 1):
        low, high = _span(edges, float(row))
        # Compared before they become integers: the ends of an empty span can be astronomically far.
        if high < low - 1e-3:
            continue
        # Neighbouring faces share edges: a hair of overlap leaves no crack between them.
        x0 = math.ceil(low - 1e-4)
        n = math.floor(high + 1e-4) + 1 - x0
        if n <= 0:
            continue
        start = f4(w0 + wy * row + wx * x0)
        y, left = u8(row), u8(x0)
        for x in range(n):
            at = left + u8(x)
            w = start + step * f4(i4(x))
            old = inverse_depth[y, at]
            closer = w > old
            inverse_depth[y, at] = w if closer else old
            index[y, at] = label if closer else index[y, at]


@njit(**INLINE)
def _fill_cutout(table, r, first, last, cutouts, inverse_depth, index, texel_at, texel):
    """Depth-test a quad with holes and write its row number and texel."""
    texture = u8(table[r, TEXTURE])
    scale_u, scale_v = table[r, REPEAT_U] * SIZE, table[r, REPEAT_V] * SIZE
    shift_u, shift_v = f4(table[r, SHIFT_U] * SIZE), f4(table[r, SHIFT_V] * SIZE)
    edges = _edges(table, r)
    w0, wx, wy = table[r, W0], table[r, WX], table[r, WY]
    a0, ax, ay = table[r, A0] * scale_u, table[r, AX] * scale_u, table[r, AY] * scale_u
    b0, bx, by = table[r, B0] * scale_v, table[r, BX] * scale_v, table[r, BY] * scale_v
    step, step_a, step_b = f4(wx), f4(ax), f4(bx)
    base = i4(CUTOUT - (i4(r) << i4(8)))
    for row in range(first, last + 1):
        low, high = _span(edges, float(row))
        if high < low:
            continue
        x0 = math.ceil(low)
        n = math.floor(high) + 1 - x0
        if n <= 0:
            continue
        start = f4(w0 + wy * row + wx * x0)
        start_a = f4(a0 + ay * row + ax * x0)
        start_b = f4(b0 + by * row + bx * x0)
        # Three loops, so that all but the look-up run in SIMD.
        for x in range(n):
            fx = f4(i4(x))
            z = ONE / (start + step * fx)
            iu = i4((start_a + step_a * fx) * z + shift_u) & i4(SIZE - 1)
            iv = i4((start_b + step_b * fx) * z + shift_v) & i4(SIZE - 1)
            texel_at[x] = u4((iv << i4(8)) | iu)
        for x in range(n):
            texel[x] = cutouts[texture, texel_at[x]]
        y, left = u8(row), u8(x0)
        for x in range(n):
            at = left + u8(x)
            w = start + step * f4(i4(x))
            t = texel[x]
            old = inverse_depth[y, at]
            closer = (w > old) & (t > i4(0))
            inverse_depth[y, at] = w if closer else old
            index[y, at] = base - t if closer else index[y, at]


@njit(**FAST)
def clear(inverse_depth, index, first, last, w0, wx, wy):
    """Start image rows ``first`` to ``last - 1`` with the ground plane and the sky above it."""
    step = f4(wx)
    for row in range(first, last):
        y = u8(row)
        start = f4(w0 + wy * row)
        for x in range(inverse_depth.shape[1]):
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
