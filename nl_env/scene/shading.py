"""Shading: the grey level of every visible pixel, from the depth and index buffers of ``raster``.

A row is shaded run by run of equal index, eight pixels at a time (see ``lanes``). The last eight of a run may
reach beyond it, and beyond the image: the next run, from left to right, writes over them, and the buffers
have that many spare columns.

``1 / w`` is :func:`lanes.quotient` for the whole groups of eight of a long run and exact for all other
pixels. Images depend on that in their last bits; so they do on the order of the operations below.
"""

from __future__ import annotations

import math

from numba import njit

from nl_env.lanes import EXACT, LANES, first_of, fused, leading, load, quotient, row_of, splat, store, to_int
from nl_env.scene import raster as r
from nl_env.scene.ground_shading import ground_run
from nl_env.scene.raster import FAST, INLINE, ONE, ZERO, along, f4, i4, u8
from nl_env.scene.texels import LONG_RUN, floor, mip_level, repeating
from nl_env.scene.textures import LEVELS, SIZE, SKY, UNIT

FLOOR = f4(0.001)
"""Smallest intensity, so that its logarithm is finite."""


@njit(**EXACT)
def _fill(x0, n, grey, shade):
    """A run of one grey."""
    for i in range(0, n, LANES):
        store(shade, x0 + i, splat(grey))


@njit(**INLINE)
def _surface_run(y, x0, x1, fx, table, row, packed, offsets, inverse_depth, shade):
    """A run on the surface of draw-list row ``row``: one grey, or a mip-mapped texture."""
    grey = f4(table[row, r.GREY])
    texture = int(table[row, r.TEXTURE])
    if texture < 0:
        _fill(x0, x1 - x0, grey, row_of(shade, y))
    else:
        # Less detail where the surface is far or seen at a slant.
        w = table[row, r.W0] + table[row, r.WX] * 0.5 * (x0 + x1) + table[row, r.WY] * y
        gx, gy = table[row, r.WX] * fx, table[row, r.WY] * fx
        cosine = w / math.sqrt(gx * gx + gy * gy + w * w)
        level = mip_level(table[row, r.DENSITY] / (w * fx) / math.sqrt(max(cosine, 0.06)), LEVELS)
        side = SIZE >> level
        scale_u, scale_v = table[row, r.REPEAT_U] * side, table[row, r.REPEAT_V] * side
        start_a = f4((table[row, r.A0] + table[row, r.AX] * x0 + table[row, r.AY] * y) * scale_u)
        start_b = f4((table[row, r.B0] + table[row, r.BX] * x0 + table[row, r.BY] * y) * scale_v)
        step_a, step_b = f4(table[row, r.AX] * scale_u), f4(table[row, r.BX] * scale_v)
        shift_u, shift_v = f4((table[row, r.SHIFT_U] + 1.0) * side), f4((table[row, r.SHIFT_V] + 1.0) * side)
        _draw_surface(
            x0, x1 - x0, start_a, step_a, shift_u, start_b, step_b, shift_v, row_of(packed, 0),
            i4(offsets[texture, level]), i4(8 - level), grey * f4(1 / UNIT), row_of(inverse_depth, y),
            row_of(shade, y),
        )  # fmt: skip


@njit(**EXACT)
def _draw_surface(x0, n, start_a, step_a, shift_u, start_b, step_b, shift_v, packed, offset, bits, factor,
                  inverse_depth, shade):  # fmt: skip
    """Texture ``n`` pixels from ``x0`` on, ``start + step i`` being the texture coordinate times ``w``."""
    one = splat(ONE)
    quick = n // LANES * LANES if n >= LONG_RUN else 0
    for i in range(0, quick, LANES):
        z = quotient(one, load(inverse_depth, x0 + i))
        u = fused(along(i, start_a, step_a), z, splat(shift_u))
        v = fused(along(i, start_b, step_b), z, splat(shift_v))
        grey = repeating(packed, offset, bits, u, v, to_int(u), to_int(v), first_of(n - i))
        store(shade, x0 + i, splat(factor) * grey)
    for i in range(quick, n, LANES):
        z = one / load(inverse_depth, x0 + i)
        u = fused(along(i, start_a, step_a), z, splat(shift_u))
        v = fused(along(i, start_b, step_b), z, splat(shift_v))
        grey = repeating(packed, offset, bits, u, v, to_int(u), to_int(v), first_of(n - i))
        store(shade, x0 + i, splat(factor) * grey)


@njit(**INLINE)
def _sky_run(y, x0, x1, rays, up, brightness, zenith, clouds, packed, offset, shade):
    """A run of sky: a vertical gradient under a flat layer of clouds, at one height per row."""
    sx, sy, tx, ty = rays
    height = max(up, 0.0)
    inverse = 30.0 / (height + 0.25)
    au, bu = f4((sx + tx * x0) * inverse), f4(tx * inverse)
    av, bv = f4((sy + ty * x0) * inverse), f4(ty * inverse)
    grey = brightness * (1.0 + zenith * height / (height + 1.0))
    cloud_gain, cloud_bias = f4(grey * clouds / UNIT), f4(grey * (1.0 - clouds))
    _draw_sky(
        x0, x1 - x0, au, bu, av, bv, row_of(packed, 0), i4(offset), cloud_gain, cloud_bias, row_of(shade, y)
    )


@njit(**EXACT)
def _draw_sky(x0, n, au, bu, av, bv, packed, offset, gain, bias, shade):
    """Shade ``n`` pixels from ``x0`` on; ``a + b i`` are the texture coordinates."""
    for i in range(0, n, LANES):
        u, v = along(i, au, bu), along(i, av, bv)
        grain = repeating(packed, offset, i4(8), u, v, floor(u), floor(v), first_of(n - i))
        store(shade, x0 + i, fused(splat(gain), grain, splat(bias)))


@njit(**INLINE)
def _exp_negative(x):
    """``exp(-x)`` for ``x >= 0`` to 1e-3: enough for fog, and free of calls."""
    y = ONE + x * f4(0.0625) * (ONE + x * f4(0.03125))
    y = y * y
    y = y * y
    y = y * y
    return ONE / (y * y)


@njit(**INLINE)
def _fade_row(y, fog, haze, inverse_depth, shade, width):
    """Fade a row into the fog; the sky (``w = 0``) stays clear."""
    density, grey = f4(fog), f4(haze)
    for x in range(width):
        w = inverse_depth[y, x]
        keep = _exp_negative(density / max(w, f4(1e-4)))
        keep = keep if w > ZERO else ONE
        shade[y, x] = grey + (shade[y, x] - grey) * keep


@njit(**EXACT)
def _run_end(index, x, label):
    """First column from ``x`` on whose index is not ``label``; the width at the latest."""
    while True:
        equal = leading(load(index, x) == splat(label))
        x += equal
        if equal < i4(LANES):
            return x


@njit(**INLINE)
def _leaves(y, x, table, index, shade):
    """A run of texels of quads with holes, which carry their grey levels; returns its end."""
    label = index[y, u8(x)]
    while label <= r.CUTOUT:
        code = r.CUTOUT - label
        line = u8(code >> i4(8))
        shade[y, u8(x)] = f4(table[line, r.GREY] + table[line, r.CONTRAST] * (code & i4(255)))
        x += 1
        label = index[y, u8(x)]
    return x


@njit(**FAST)
def shade_rows(first, last, width, rotation, eye, lens, table, packed, offsets, ground_map, layout, corner,
               texel, light, inverse_depth, index, shade):  # fmt: skip
    """Shade image rows ``first`` to ``last - 1``."""
    fx, fy, cx, cy = lens
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
                x = _leaves(y, x, table, index, shade)
                continue
            end = _run_end(row_of(index, y), x, label)
            if label == r.GROUND:
                ground_run(
                    y, x, end, rays, eye, footprint, ground_map, layout, corner, texel, packed, offsets,
                    film, inverse_depth, shade,
                )  # fmt: skip
            elif label == r.SKY_ID:
                _sky_run(
                    y, x, end, rays, sz + tz * width / 2, light.sky, light.zenith, light.clouds, packed,
                    offsets[SKY, 0], shade,
                )  # fmt: skip
            else:
                line = u8(label - i4(1))
                _surface_run(y, x, end, fx, table, line, packed, offsets, inverse_depth, shade)
            x = end
        if light.fog > 0.0:
            _fade_row(y, light.fog, light.haze, inverse_depth, shade, width)


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
