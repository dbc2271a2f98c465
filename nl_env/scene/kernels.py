"""Rasterisation and shading kernels.

Depth is kept as ``w = 1 / z``: on a plane ``w``, ``u w`` and ``v w`` are affine in the pixel, so a span of
a parallelogram needs no division and its ends follow from four straight lines. Opaque surfaces only
write ``w`` and their index; they are shaded afterwards, in runs of equal index, so hidden surfaces cost
no texture look-up. Inner loops are branch-free float32 over contiguous rows, and loops that look up
texels are split in three (coordinates, look-up, blend) so that the first and the last stay in SIMD.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from nl_env.scene.textures import LEVELS, SIZE, UNIT

f4 = np.float32
i4 = np.int32
u4 = np.uint32
ZERO, ONE = f4(0), f4(1)
GROUND, SKY_ID, CUTOUT = i4(0), i4(-1), i4(-2)
"""Index buffer: the ground, the sky, draw-list row ``r`` as ``r + 1``, and a cut-out texel as
``CUTOUT - (r << 8 | texel)``."""
NEAR = 0.15
"""Nearest visible depth, m."""
FLOOR = f4(0.001)
"""Smallest intensity, so that its logarithm is finite."""
FAST = {"fastmath": True, "error_model": "numpy", "cache": True, "boundscheck": False}
_INLINE = {**FAST, "forceinline": True}

# Columns of the draw list, one row per visible quad: planes of w, s w and t w over the pixel ...
W0, WX, WY, A0, AX, AY, B0, BX, BY = range(9)
# ... the four edges as x = EDGE + SLOPE y, and whether the inside is to the right ...
EDGE, SLOPE, SIDE = 9, 13, 17
TOP, BOTTOM, LEFT, RIGHT = 21, 22, 23, 24
# ... and the material.
GREY, CONTRAST, TEXTURE, REPEAT_U, REPEAT_V, SHIFT_U, SHIFT_V, DENSITY, HOLES = range(25, 34)
COLUMNS = 34


@njit(**_INLINE)
def bilinear(t, a, b):
    """Blend the four neighbours packed in texel ``t``; ``a`` and ``b`` are the fractions along x and y."""
    t00 = f4(i4(t & u4(255)))
    t01 = f4(i4((t >> u4(8)) & u4(255)))
    t10 = f4(i4((t >> u4(16)) & u4(255)))
    t11 = f4(i4(t >> u4(24)))
    top = t00 + (t01 - t00) * a
    return top + (t10 + (t11 - t10) * a - top) * b


@njit(**_INLINE)
def floor_int(x):
    """Largest integer not above ``x``, as int32."""
    i = i4(x)
    return i4(i - i4(1)) if x < f4(i) else i


@njit(**FAST)
def cull_objects(objects, rotation, eye, lens, width, height, far, visible):
    """Indices of the objects whose bounding sphere meets the view frustum; returns how many."""
    fx, fy, cx, cy = lens
    count = 0
    lx, rx, ty, by = cx + 1.0, width - cx, cy + 1.0, height - cy
    ln, rn = 1.0 / math.sqrt(fx * fx + lx * lx), 1.0 / math.sqrt(fx * fx + rx * rx)
    tn, bn = 1.0 / math.sqrt(fy * fy + ty * ty), 1.0 / math.sqrt(fy * fy + by * by)
    smallest = 0.35 / fx
    for m in range(objects.radius.shape[0]):
        x = objects.centre[0, m] - eye[0]
        y = objects.centre[1, m] - eye[1]
        z = objects.centre[2, m] - eye[2]
        r = objects.radius[m]
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
def project(quads, q, rotation, eye, lens, width, height, far, row):
    """Write the draw-list row of quad ``q``; returns False when it cannot be seen."""
    fx, fy, cx, cy = lens
    ex = quads.origin[0, q] - eye[0]
    ey = quads.origin[1, q] - eye[1]
    ez = quads.origin[2, q] - eye[2]
    facing = quads.normal[0, q] * ex + quads.normal[1, q] * ey + quads.normal[2, q] * ez
    if facing >= 0.0 and quads.two_sided[q] == 0:
        return False
    ux, uy, uz = quads.u[0, q], quads.u[1, q], quads.u[2, q]
    vx, vy, vz = quads.v[0, q], quads.v[1, q], quads.v[2, q]
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
    if z_min < NEAR:
        # The corners behind the camera have no image: the edges alone bound the spans.
        top, bottom, left, right = 0.0, height - 1.0, 0.0, width - 1.0
    else:
        p0, p1, p2, p3 = 1.0 / o2, 1.0 / z1, 1.0 / z2, 1.0 / z3
        y0, y1, y2, y3 = o1 * p0, (o1 + u1) * p1, (o1 + v1) * p2, (o1 + u1 + v1) * p3
        x0, x1, x2, x3 = o0 * p0, (o0 + u0) * p1, (o0 + v0) * p2, (o0 + u0 + v0) * p3
        top = math.ceil(max(fy * min(min(y0, y1), min(y2, y3)) + cy, 0.0))
        bottom = math.floor(min(fy * max(max(y0, y1), max(y2, y3)) + cy, height - 1.0))
        left = math.ceil(max(fx * min(min(x0, x1), min(x2, x3)) + cx, 0.0))
        right = math.floor(min(fx * max(max(x0, x1), max(x2, x3)) + cx, width - 1.0))
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
    row[W0], row[WX], row[WY] = c2, c0, c1
    row[A0], row[AX], row[AY] = a2, a0, a1
    row[B0], row[BX], row[BY] = b2, b0, b1
    _edge(row, 0, a2, a0, a1)
    _edge(row, 1, c2 - a2, c0 - a0, c1 - a1)
    _edge(row, 2, b2, b0, b1)
    _edge(row, 3, c2 - b2, c0 - b0, c1 - b1)
    row[TOP], row[BOTTOM], row[LEFT], row[RIGHT] = top, bottom, left, right
    row[TEXTURE] = quads.texture[q]
    row[HOLES] = quads.cutout[q]
    row[REPEAT_U], row[REPEAT_V] = quads.repeat[0, q], quads.repeat[1, q]
    row[SHIFT_U], row[SHIFT_V] = quads.shift[0, q], quads.shift[1, q]
    albedo = quads.albedo[q]
    row[GREY], row[CONTRAST] = albedo, 0.0
    row[DENSITY] = SIZE * quads.density[q]
    if quads.cutout[q] != 0:
        # Beyond one texel per pixel the grain averages out; the holes stay, as a point-sampled depth needs.
        texels = row[DENSITY] * 0.5 * (o2 + z3) / fx
        row[CONTRAST] = albedo / UNIT * min(1.0, 1.0 / max(texels, 1e-6))
        row[GREY] = albedo - row[CONTRAST] * UNIT
    return True


@njit(**_INLINE)
def _edge(row, e, p0, px, py):
    """Store the half-plane ``p0 + px x + py y >= 0`` as a bound on x."""
    if abs(px) < 1e-20:
        px = 1e-20
    inverse = -1.0 / px
    row[EDGE + e] = p0 * inverse
    row[SLOPE + e] = py * inverse
    row[SIDE + e] = px


@njit(**_INLINE)
def span(row, y):
    """First and last pixel of a draw-list row's quad on image row ``y``."""
    low, high = row[LEFT], row[RIGHT]
    for e in range(4):
        x = row[EDGE + e] + row[SLOPE + e] * y
        low = max(low, x) if row[SIDE + e] > 0.0 else low
        high = high if row[SIDE + e] > 0.0 else min(high, x)
    return low, high


@njit(**FAST)
def fill_opaque(row, label, first, last, inverse_depth, index):
    """Depth-test an opaque quad on image rows ``first`` to ``last`` and write its label."""
    step = f4(row[WX])
    for y in range(first, last + 1):
        low, high = span(row, float(y))
        # Neighbouring faces share edges: a hair of overlap leaves no crack between them.
        x0 = int(math.ceil(low - 1e-4))
        x1 = int(math.floor(high + 1e-4)) + 1
        if x1 <= x0:
            continue
        start = f4(row[W0] + row[WY] * y + row[WX] * x0)
        ws = inverse_depth[y, x0:x1]
        ids = index[y, x0:x1]
        for x in range(x1 - x0):
            w = start + step * f4(i4(x))
            old = ws[x]
            closer = w > old
            ws[x] = w if closer else old
            ids[x] = label if closer else ids[x]


@njit(**FAST)
def fill_cutout(row, number, first, last, cutout, inverse_depth, index, texel_at, texel):
    """Depth-test a quad with holes and write its row number and texel."""
    scale_u, scale_v = row[REPEAT_U] * SIZE, row[REPEAT_V] * SIZE
    shift_u, shift_v = f4(row[SHIFT_U] * SIZE), f4(row[SHIFT_V] * SIZE)
    step = f4(row[WX])
    step_a, step_b = f4(row[AX] * scale_u), f4(row[BX] * scale_v)
    base = i4(CUTOUT - (number << 8))
    for y in range(first, last + 1):
        low, high = span(row, float(y))
        x0 = int(math.ceil(low))
        x1 = int(math.floor(high)) + 1
        n = x1 - x0
        if n <= 0:
            continue
        start = f4(row[W0] + row[WY] * y + row[WX] * x0)
        start_a = f4((row[A0] + row[AY] * y + row[AX] * x0) * scale_u)
        start_b = f4((row[B0] + row[BY] * y + row[BX] * x0) * scale_v)
        for x in range(n):
            fx = f4(i4(x))
            z = ONE / (start + step * fx)
            iu = i4((start_a + step_a * fx) * z + shift_u) & i4(SIZE - 1)
            iv = i4((start_b + step_b * fx) * z + shift_v) & i4(SIZE - 1)
            texel_at[x] = u4((iv << i4(8)) | iu)
        for x in range(n):
            texel[x] = cutout[texel_at[x]]
        ws = inverse_depth[y, x0:x1]
        ids = index[y, x0:x1]
        for x in range(n):
            w = start + step * f4(i4(x))
            t = texel[x]
            old = ws[x]
            closer = (w > old) & (t > i4(0))
            ws[x] = w if closer else old
            ids[x] = base - t if closer else ids[x]


@njit(**FAST)
def clear(inverse_depth, index, first, last, w0, wx, wy):
    """Start image rows ``first`` to ``last - 1`` with the ground plane and the sky above it."""
    step = f4(wx)
    for y in range(first, last):
        start = f4(w0 + wy * y)
        ws = inverse_depth[y]
        ids = index[y]
        for x in range(len(ws)):
            w = start + step * f4(i4(x))
            above = w <= f4(2e-4)
            ws[x] = ZERO if above else w
            ids[x] = SKY_ID if above else GROUND


@njit(**FAST)
def texture_run(at, fa, fb, gain, bias, ws, start_a, step_a, start_b, step_b, offset, level, shift_u, shift_v, grey):
    """Texture coordinates of a run on a surface; coordinates are in texels of the chosen mip level."""
    bits = i4(8 - level)
    mask = i4((SIZE >> level) - 1)
    for x in range(len(at)):
        fx = f4(i4(x))
        z = ONE / ws[x]
        u = (start_a + step_a * fx) * z + shift_u
        v = (start_b + step_b * fx) * z + shift_v
        iu = i4(u)
        iv = i4(v)
        fa[x] = u - f4(iu)
        fb[x] = v - f4(iv)
        at[x] = u4(offset + (((iv & mask) << bits) | (iu & mask)))
        gain[x] = grey
        bias[x] = ZERO


@njit(**FAST)
def constant_run(at, gain, bias, grey):
    """A run of one grey level."""
    for x in range(len(at)):
        at[x] = u4(0)
        gain[x] = ZERO
        bias[x] = grey


@njit(**FAST)
def cutout_pixel(ids, x, at, gain, bias, table):
    """One pixel of a cut-out surface: its texel is in the index buffer."""
    code = CUTOUT - ids[x]
    row = code >> i4(8)
    at[x] = u4(0)
    gain[x] = ZERO
    bias[x] = f4(table[row, GREY] + table[row, CONTRAST] * (code & i4(255)))


@njit(**FAST)
def map_run(at, fa, fb, gain, ws, level, rows, columns, x0, dx, y0, dy, scale, mx, my, grey):
    """Painted ground: fills ``gain`` with the map's grey level, using the other arrays as scratch."""
    right, low = f4(columns - 2), f4(rows - 2)
    stride = i4(columns)
    n = len(at)
    for x in range(n):
        fx = f4(i4(x))
        z = ONE / ws[x]
        u = min(max((x0 + dx * fx) * z * scale + mx, ZERO), right)
        v = min(max((y0 + dy * fx) * z * scale + my, ZERO), low)
        iu = i4(u)
        iv = i4(v)
        fa[x] = u - f4(iu)
        fb[x] = v - f4(iv)
        at[x] = u4(iv * stride + iu)
    for x in range(n):
        at[x] = level[at[x]]
    for x in range(n):
        gain[x] = grey * bilinear(at[x], fa[x], fb[x])


@njit(**FAST)
def detail_run(at, fa, fb, gain, bias, ws, x0, dx, y0, dy, scale, tx, ty, offset, level, gloss, sky):
    """Texture coordinates of the ground's repeating detail, and the glossy film of wet ground."""
    bits = i4(8 - level)
    mask = i4((SIZE >> level) - 1)
    for x in range(len(at)):
        fx = f4(i4(x))
        z = ONE / ws[x]
        u = (x0 + dx * fx) * z * scale + tx
        v = (y0 + dy * fx) * z * scale + ty
        iu = floor_int(u)
        iv = floor_int(v)
        fa[x] = u - f4(iu)
        fb[x] = v - f4(iv)
        at[x] = u4(offset + (((iv & mask) << bits) | (iu & mask)))
        film = gloss * z / (z + f4(25))
        gain[x] = gain[x] * (ONE - film)
        bias[x] = sky * film


@njit(**FAST)
def sky_run(at, fa, fb, gain, bias, x0, dx, y0, dy, z0, dz, brightness, zenith, clouds, offset):
    """Texture coordinates of a flat layer of clouds. ``x0 + dx * x`` etc. are world directions."""
    mask = i4(SIZE - 1)
    for x in range(len(at)):
        fx = f4(i4(x))
        up = max(z0 + dz * fx, ZERO)
        inverse = f4(30) / (up + f4(0.25))
        u = (x0 + dx * fx) * inverse
        v = (y0 + dy * fx) * inverse
        iu = floor_int(u)
        iv = floor_int(v)
        fa[x] = u - f4(iu)
        fb[x] = v - f4(iv)
        at[x] = u4(offset + (((iv & mask) << i4(8)) | (iu & mask)))
        level = brightness * (ONE + zenith * up / (up + ONE))
        gain[x] = level * clouds * f4(1 / UNIT)
        bias[x] = level * (ONE - clouds)


@njit(**FAST)
def blend(at, fa, fb, gain, bias, packed, out):
    """Look up a row of surface texels and write ``bias + gain * texel``."""
    n = len(out)
    for x in range(n):
        at[x] = packed[at[x]]
    for x in range(n):
        out[x] = bias[x] + gain[x] * bilinear(at[x], fa[x], fb[x])


@njit(**_INLINE)
def _exp_negative(x):
    """``exp(-x)`` for ``x >= 0`` to 1e-3: enough for fog, and free of calls."""
    y = ONE + x * f4(0.0625) * (ONE + x * f4(0.03125))
    y = y * y
    y = y * y
    y = y * y
    return ONE / (y * y)


@njit(**FAST)
def add_fog(out, ws, density, grey):
    """Blend a row towards the fog colour with distance; the sky (``w = 0``) is left as it is."""
    for x in range(len(out)):
        w = ws[x]
        keep = _exp_negative(density / max(w, f4(1e-4)))
        keep = keep if w > ZERO else ONE
        out[x] = grey + (out[x] - grey) * keep


@njit(**FAST)
def blur(shade, side, row, intensity):
    """Three-by-three optical blur, clipped to [FLOOR, 1]."""
    height, width = intensity.shape
    centre = ONE - side - side
    for y in range(height):
        above, here, below = shade[max(y - 1, 0)], shade[y], shade[min(y + 1, height - 1)]
        for x in range(width):
            row[x] = min(centre * here[x] + side * (above[x] + below[x]), ONE)
        out = intensity[y]
        for x in range(1, width - 1):
            out[x] = max(centre * row[x] + side * (row[x - 1] + row[x + 1]), FLOOR)
        out[0] = max((centre + side) * row[0] + side * row[1], FLOOR)
        out[width - 1] = max((centre + side) * row[width - 1] + side * row[width - 2], FLOOR)


@njit(**FAST)
def write_depth(inverse_depth, depth, far):
    """z-depth in metres, 0 beyond ``far``."""
    limit = f4(1.0 / far)
    for y in range(depth.shape[0]):
        ws = inverse_depth[y]
        out = depth[y]
        for x in range(len(out)):
            w = ws[x]
            z = ONE / max(w, limit)
            out[x] = z if w > limit else ZERO


@njit(**FAST)
def mip_level(texels, levels):
    """Mip level at which ``texels`` per pixel become at most one and a half."""
    level = 0
    while texels > 1.5 and level < levels - 1:
        texels *= 0.5
        level += 1
    return level


@njit(**FAST)
def surface_level(row, x, y, fx):
    """Mip level of a textured surface around pixel ``(x, y)``, less detailed where it is seen at a slant."""
    w = row[W0] + row[WX] * x + row[WY] * y
    gx, gy = row[WX] * fx, row[WY] * fx
    cosine = w / math.sqrt(gx * gx + gy * gy + w * w)
    return mip_level(row[DENSITY] / (w * fx) / math.sqrt(max(cosine, 0.06)), LEVELS)
