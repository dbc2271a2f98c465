"""Shading of the ground: the painted map, times a repeating detail texture, under a film of water."""

from __future__ import annotations

import math

from numba import njit

from nl_env.lanes import (
    EXACT,
    LANES,
    first_of,
    fused,
    gather,
    load,
    quotient,
    row_of,
    splat,
    store,
    to_float,
    to_int,
    where,
)
from nl_env.scene.raster import INLINE, ONE, ZERO, along, f4, i4
from nl_env.scene.texels import LONG_RUN, bilinear, floor, mip_level, repeating
from nl_env.scene.textures import DETAIL, LEVELS, SIZE, UNIT

DETAIL_METRES = 2.5
"""Size of one repeat of the ground's detail texture."""
MAP_UNIT = 255.0
"""Texel value of a white ground."""


@njit(**INLINE)
def ground_run(y, x0, x1, rays, eye, footprint, ground_map, layout, corner, texel, packed, offsets, light,
                inverse_depth, shade):  # fmt: skip
    """A run of ground: the painted map, times a repeating detail texture, under a glossy film when wet."""
    sx, sy, tx, ty = rays
    grey, gloss, sky = light
    level = mip_level(footprint / texel, layout.shape[0])
    start, rows, columns = layout[level, 0], layout[level, 1], layout[level, 2]
    per_metre = 1.0 / (texel * (1 << level))
    shift = 0.5 / (1 << level) - 0.5
    scale = f4(per_metre)
    mx, my = f4((eye[0] - corner[0]) * per_metre + shift), f4((eye[1] - corner[1]) * per_metre + shift)
    ax, ay, bx, by = f4(sx + tx * x0), f4(sy + ty * x0), f4(tx), f4(ty)
    right, low, stride, base = f4(columns - 2), f4(rows - 2), i4(columns), i4(start)
    rays_from = (ax, bx, ay, by)
    depth_row, shade_row, textures = row_of(inverse_depth, y), row_of(shade, y), row_of(packed, 0)
    painted = (scale, mx, my, right, low, stride, base)
    _draw_paint(x0, x1 - x0, rays_from, painted, row_of(ground_map, 0), depth_row, shade_row)
    level = mip_level(footprint * SIZE / DETAIL_METRES, LEVELS)
    side = SIZE >> level
    px, py = eye[0] / DETAIL_METRES, eye[1] / DETAIL_METRES
    scale, mx, my = (
        f4(side / DETAIL_METRES),
        f4((px - math.floor(px)) * side),
        f4((py - math.floor(py)) * side),
    )
    detail = (scale, mx, my, i4(offsets[DETAIL, level]), i4(8 - level))
    film = (f4(grey / (MAP_UNIT * UNIT)), f4(gloss), f4(sky))
    _draw_detail(x0, x1 - x0, rays_from, detail, film, textures, depth_row, shade_row)


@njit(**EXACT)
def _draw_paint(x0, n, rays, painted, ground_map, inverse_depth, shade):
    """Texels of the ground map for ``n`` pixels from ``x0`` on, whose rays lean by ``a + b i``."""
    scale = splat(painted[0])
    quick = n // LANES * LANES
    for i in range(0, quick, LANES):
        texels = quotient(scale, load(inverse_depth, x0 + i))
        store(shade, x0 + i, _paint(i, n, rays, texels, painted, ground_map))
    for i in range(quick, n, LANES):
        texels = scale / load(inverse_depth, x0 + i)
        store(shade, x0 + i, _paint(i, n, rays, texels, painted, ground_map))


@njit(**EXACT)
def _paint(i, n, rays, texels, painted, ground_map):
    """The ground map where the rays end, ``texels`` of the map away."""
    ax, bx, ay, by = rays
    _, mx, my, right, low, stride, base = painted
    u, v = fused(along(i, ax, bx), texels, splat(mx)), fused(along(i, ay, by), texels, splat(my))
    u = where(u > splat(ZERO), u, splat(ZERO))
    v = where(v > splat(ZERO), v, splat(ZERO))
    u = where(u < splat(right), u, splat(right))
    v = where(v < splat(low), v, splat(low))
    iu, iv = to_int(u), to_int(v)
    at = splat(base) + iv * splat(stride) + iu
    return bilinear(gather(ground_map, at, first_of(n - i)), u - to_float(iu), v - to_float(iv))


@njit(**EXACT)
def _draw_detail(x0, n, rays, detail, film, packed, inverse_depth, shade):
    """Turn the ground map's texels into grey: times the grain of the ground, and under the film."""
    one, film_share, softness = splat(ONE), splat(film[1]), splat(f4(25))
    quick = n // LANES * LANES if n >= LONG_RUN else 0
    for i in range(0, quick, LANES):
        z = quotient(one, load(inverse_depth, x0 + i))
        share = quotient(film_share * z, z + softness)
        grey = _ground_grey(i, n, rays, z, share, load(shade, x0 + i), detail, film, packed)
        store(shade, x0 + i, grey)
    for i in range(quick, n, LANES):
        z = one / load(inverse_depth, x0 + i)
        share = film_share * z / (z + softness)
        grey = _ground_grey(i, n, rays, z, share, load(shade, x0 + i), detail, film, packed)
        store(shade, x0 + i, grey)


@njit(**EXACT)
def _ground_grey(i, n, rays, z, share, paint, detail, film, packed):
    """Ground at depth ``z``; ``share`` of its light comes from the film of water."""
    ax, bx, ay, by = rays
    scale, mx, my, offset, bits = detail
    factor, _, film_grey = film
    texels = splat(scale) * z
    u, v = fused(along(i, ax, bx), texels, splat(mx)), fused(along(i, ay, by), texels, splat(my))
    grain = repeating(packed, offset, bits, u, v, floor(u), floor(v), first_of(n - i))
    gain = (splat(ONE) - share) * (splat(factor) * paint)
    return fused(gain, grain, splat(film_grey) * share)
