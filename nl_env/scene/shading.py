"""Shading: the grey level of every visible pixel, from the depth and index buffers of ``raster``.

A row is shaded run by run of equal index: each run leaves a texel index, two fractions, a gain and a bias
per pixel, and one pass over the row blends them. Texel look-ups stand in loops of their own, so that the
arithmetic before and after them stays in SIMD.
"""

from __future__ import annotations

import math

from numba import njit

from nl_env.scene import raster as r
from nl_env.scene.raster import FAST, INLINE, ONE, ZERO, f4, i4, u4, u8
from nl_env.scene.textures import DETAIL, LEVELS, SIZE, SKY, UNIT

FLOOR = f4(0.001)
"""Smallest intensity, so that its logarithm is finite."""
DETAIL_METRES = 2.5
"""Size of one repeat of the ground's detail texture."""
MAP_UNIT = 255.0
"""Texel value of a white ground."""


@njit(**INLINE)
def _bilinear(t, a, b):
    """Blend the four neighbours packed in texel ``t``; ``a`` and ``b`` are the fractions along x and y."""
    t00 = f4(i4(t & u4(255)))
    t01 = f4(i4((t >> u4(8)) & u4(255)))
    t10 = f4(i4((t >> u4(16)) & u4(255)))
    t11 = f4(i4(t >> u4(24)))
    top = t00 + (t01 - t00) * a
    return top + (t10 + (t11 - t10) * a - top) * b


@njit(**INLINE)
def _floor_int(x):
    """Largest integer not above ``x``, as int32."""
    i = i4(x)
    return i4(i - i4(1)) if x < f4(i) else i


@njit(**INLINE)
def _mip_level(texels, levels):
    """Mip level at which ``texels`` per pixel become at most one and a half."""
    level = 0
    while texels > 1.5 and level < levels - 1:
        texels *= 0.5
        level += 1
    return level


@njit(**INLINE)
def _surface_run(y, x0, x1, fx, table, row, offsets, inverse_depth, at, fa, fb, gain, bias):
    """A run on the surface of draw-list row ``row``: one grey, or a mip-mapped texture."""
    grey = f4(table[row, r.GREY])
    texture = int(table[row, r.TEXTURE])
    if texture < 0:
        for i in range(x0, x1):
            x = u8(i)
            at[x] = u4(0)
            gain[x] = ZERO
            bias[x] = grey
        return
    # Less detail where the surface is far or seen at a slant.
    w = table[row, r.W0] + table[row, r.WX] * 0.5 * (x0 + x1) + table[row, r.WY] * y
    gx, gy = table[row, r.WX] * fx, table[row, r.WY] * fx
    cosine = w / math.sqrt(gx * gx + gy * gy + w * w)
    level = _mip_level(table[row, r.DENSITY] / (w * fx) / math.sqrt(max(cosine, 0.06)), LEVELS)
    side = SIZE >> level
    scale_u, scale_v = table[row, r.REPEAT_U] * side, table[row, r.REPEAT_V] * side
    start_a = f4((table[row, r.A0] + table[row, r.AX] * x0 + table[row, r.AY] * y) * scale_u)
    start_b = f4((table[row, r.B0] + table[row, r.BX] * x0 + table[row, r.BY] * y) * scale_v)
    step_a, step_b = f4(table[row, r.AX] * scale_u), f4(table[row, r.BX] * scale_v)
    shift_u, shift_v = f4((table[row, r.SHIFT_U] + 1.0) * side), f4((table[row, r.SHIFT_V] + 1.0) * side)
    offset, bits, mask = i4(offsets[texture, level]), i4(8 - level), i4(side - 1)
    left = u8(x0)
    factor = grey * f4(1 / UNIT)
    for i in range(x1 - x0):
        x = left + u8(i)
        fi = f4(i4(i))
        z = ONE / inverse_depth[y, x]
        u = (start_a + step_a * fi) * z + shift_u
        v = (start_b + step_b * fi) * z + shift_v
        iu = i4(u)
        iv = i4(v)
        fa[x] = u - f4(iu)
        fb[x] = v - f4(iv)
        at[x] = u4(offset + (((iv & mask) << bits) | (iu & mask)))
        gain[x] = factor
        bias[x] = ZERO


@njit(**INLINE)
def _ground_run(y, x0, x1, rays, eye, footprint, ground_map, layout, corner, texel, offsets, light,
                inverse_depth, at, fa, fb, gain, bias):  # fmt: skip
    """A run of ground: the painted map, times a repeating detail texture, under a glossy film when wet."""
    sx, sy, tx, ty = rays
    grey, gloss, sky = light
    level = _mip_level(footprint / texel, layout.shape[0])
    start, rows, columns = layout[level, 0], layout[level, 1], layout[level, 2]
    per_metre = 1.0 / (texel * (1 << level))
    shift = 0.5 / (1 << level) - 0.5
    scale = f4(per_metre)
    mx, my = f4((eye[0] - corner[0]) * per_metre + shift), f4((eye[1] - corner[1]) * per_metre + shift)
    ax, ay, bx, by = f4(sx + tx * x0), f4(sy + ty * x0), f4(tx), f4(ty)
    right, low, stride, base = f4(columns - 2), f4(rows - 2), i4(columns), i4(start)
    left, n = u8(x0), x1 - x0
    for i in range(n):
        x = left + u8(i)
        fi = f4(i4(i))
        z = ONE / inverse_depth[y, x]
        u = min(max((ax + bx * fi) * z * scale + mx, ZERO), right)
        v = min(max((ay + by * fi) * z * scale + my, ZERO), low)
        iu = i4(u)
        iv = i4(v)
        fa[x] = u - f4(iu)
        fb[x] = v - f4(iv)
        at[x] = u4(base + iv * stride + iu)
    for i in range(n):
        x = left + u8(i)
        at[x] = ground_map[at[x]]
    factor = f4(grey / (MAP_UNIT * UNIT))
    level = _mip_level(footprint * SIZE / DETAIL_METRES, LEVELS)
    side = SIZE >> level
    bits, mask, offset = i4(8 - level), i4(side - 1), i4(offsets[DETAIL, level])
    px, py = eye[0] / DETAIL_METRES, eye[1] / DETAIL_METRES
    scale, mx, my = (
        f4(side / DETAIL_METRES),
        f4((px - math.floor(px)) * side),
        f4((py - math.floor(py)) * side),
    )
    film_share, film_grey = f4(gloss), f4(sky)
    for i in range(n):
        x = left + u8(i)
        fi = f4(i4(i))
        z = ONE / inverse_depth[y, x]
        u = (ax + bx * fi) * z * scale + mx
        v = (ay + by * fi) * z * scale + my
        iu = _floor_int(u)
        iv = _floor_int(v)
        film = film_share * z / (z + f4(25))
        gain[x] = factor * _bilinear(at[x], fa[x], fb[x]) * (ONE - film)
        bias[x] = film_grey * film
        fa[x] = u - f4(iu)
        fb[x] = v - f4(iv)
        at[x] = u4(offset + (((iv & mask) << bits) | (iu & mask)))


@njit(**INLINE)
def _sky_run(x0, x1, rays, up, brightness, zenith, clouds, offset, at, fa, fb, gain, bias):
    """A run of sky: a vertical gradient under a flat layer of clouds, at one height per row."""
    sx, sy, tx, ty = rays
    height = max(up, 0.0)
    inverse = 30.0 / (height + 0.25)
    au, bu = f4((sx + tx * x0) * inverse), f4(tx * inverse)
    av, bv = f4((sy + ty * x0) * inverse), f4(ty * inverse)
    mask, start = i4(SIZE - 1), i4(offset)
    grey = brightness * (1.0 + zenith * height / (height + 1.0))
    cloud_gain, cloud_bias = f4(grey * clouds / UNIT), f4(grey * (1.0 - clouds))
    left = u8(x0)
    for i in range(x1 - x0):
        x = left + u8(i)
        fi = f4(i4(i))
        u = au + bu * fi
        v = av + bv * fi
        iu = _floor_int(u)
        iv = _floor_int(v)
        fa[x] = u - f4(iu)
        fb[x] = v - f4(iv)
        at[x] = u4(start + (((iv & mask) << i4(8)) | (iu & mask)))
        gain[x] = cloud_gain
        bias[x] = cloud_bias


@njit(**INLINE)
def _exp_negative(x):
    """``exp(-x)`` for ``x >= 0`` to 1e-3: enough for fog, and free of calls."""
    y = ONE + x * f4(0.0625) * (ONE + x * f4(0.03125))
    y = y * y
    y = y * y
    y = y * y
    return ONE / (y * y)


@njit(**INLINE)
def _finish_row(y, packed, fog, haze, inverse_depth, at, fa, fb, gain, bias, shade):
    """Look the row's texels up, blend them, and fade them into the fog; the sky (``w = 0``) stays clear."""
    n = shade.shape[1]
    for x in range(n):
        at[x] = packed[at[x]]
    for x in range(n):
        shade[y, x] = bias[x] + gain[x] * _bilinear(at[x], fa[x], fb[x])
    if fog > 0.0:
        density, grey = f4(fog), f4(haze)
        for x in range(n):
            w = inverse_depth[y, x]
            keep = _exp_negative(density / max(w, f4(1e-4)))
            keep = keep if w > ZERO else ONE
            shade[y, x] = grey + (shade[y, x] - grey) * keep


@njit(**FAST)
def shade_rows(first, last, rotation, eye, lens, table, packed, offsets, ground_map, layout, corner, texel,
               light, inverse_depth, index, at, fa, fb, gain, bias, shade):  # fmt: skip
    """Shade image rows ``first`` to ``last - 1``."""
    fx, fy, cx, cy = lens
    width = index.shape[1]
    film = (light.ground, light.gloss, light.sky)
    for row in range(first, last):
        y = u8(row)
        # World direction of the ray through column x, per metre of depth: s + t x.
        dy = (row - cy) / fy
        sx = rotation[0, 1] * dy + rotation[0, 2] - rotation[0, 0] * cx / fx
        sy = rotation[1, 1] * dy + rotation[1, 2] - rotation[1, 0] * cx / fx
        sz = rotation[2, 1] * dy + rotation[2, 2] - rotation[2, 0] * cx / fx
        tz = rotation[2, 0] / fx
        rays = (sx, sy, rotation[0, 0] / fx, rotation[1, 0] / fx)
        # Side of a pixel's footprint on the ground: the geometric mean, as it is far longer than wide.
        slope = max(-(sz + tz * width / 2), 1e-3)
        footprint = eye[2] / slope / fx / math.sqrt(max(slope, 0.02))
        x = 0
        while x < width:
            label = index[y, u8(x)]
            if label <= r.CUTOUT:
                code = r.CUTOUT - label
                line = u8(code >> i4(8))
                at[u8(x)] = u4(0)
                gain[u8(x)] = ZERO
                bias[u8(x)] = f4(table[line, r.GREY] + table[line, r.CONTRAST] * (code & i4(255)))
                x += 1
                continue
            end = x + 1
            while end < width and index[y, u8(end)] == label:
                end += 1
            if label == r.GROUND:
                _ground_run(
                    y, x, end, rays, eye, footprint, ground_map, layout, corner, texel, offsets, film,
                    inverse_depth, at, fa, fb, gain, bias,
                )  # fmt: skip
            elif label == r.SKY_ID:
                _sky_run(
                    x, end, rays, sz + tz * width / 2, light.sky, light.zenith, light.clouds, offsets[SKY, 0],
                    at, fa, fb, gain, bias,
                )  # fmt: skip
            else:
                line = u8(label - i4(1))
                _surface_run(y, x, end, fx, table, line, offsets, inverse_depth, at, fa, fb, gain, bias)
            x = end
        _finish_row(y, packed, light.fog, light.haze, inverse_depth, at, fa, fb, gain, bias, shade)


@njit(**FAST)
def blur(shade, side, row, intensity):
    """Three-by-three optical blur, clipped to [FLOOR, 1]."""
    height, width = intensity.shape
    weight = f4(side)
    centre = ONE - weight - weight
    for y in range(height):
        above, here, below = u8(max(y - 1, 0)), u8(y), u8(min(y + 1, height - 1))
        for x in range(width):
            row[x] = min(centre * shade[here, x] + weight * (shade[above, x] + shade[below, x]), ONE)
        for i in range(width - 2):
            middle = u8(i) + u8(1)
            beside = row[u8(i)] + row[middle + u8(1)]
            intensity[here, middle] = max(centre * row[middle] + weight * beside, FLOOR)
        last = u8(width - 1)
        intensity[here, u8(0)] = max((centre + weight) * row[u8(0)] + weight * row[u8(1)], FLOOR)
        intensity[here, last] = max((centre + weight) * row[last] + weight * row[last - u8(1)], FLOOR)
