"""The draw list: which parallelograms may be seen, projected into the image.

On a plane ``w = 1 / z``, ``s w`` and ``t w`` are affine in the pixel. A row of the list holds those three
planes, the four edges as straight lines, the rows and columns they span, and the material (see ``raster``).
"""

from __future__ import annotations

import math

from numba import njit

from nl_env.lanes import row_of
from nl_env.scene.raster import (
    A0,
    ALBEDO,
    AX,
    AY,
    B0,
    BOTTOM,
    BX,
    BY,
    CONTRAST,
    DENSITY,
    DENSITY_PER_M,
    FAST,
    GREY,
    HAS_HOLES,
    HIGH,
    HIGH_SLOPE,
    HOLES,
    INLINE,
    LEFT,
    LOW,
    LOW_SLOPE,
    NEAR,
    NORMAL,
    REPEAT,
    REPEAT_U,
    REPEAT_V,
    RIGHT,
    SHIFT,
    SHIFT_U,
    SHIFT_V,
    TEXTURE,
    TEXTURE_ID,
    TOP,
    TWO_SIDED,
    UNBOUNDED,
    W0,
    WX,
    WY,
    ZERO,
    U,
    V,
)
from nl_env.scene.textures import SIZE, UNIT


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
    axes = (
        rotation[0, 0], rotation[0, 1], rotation[0, 2],
        rotation[1, 0], rotation[1, 1], rotation[1, 2],
        rotation[2, 0], rotation[2, 1], rotation[2, 2],
    )  # fmt: skip
    position = eye[0], eye[1], eye[2]
    for j in range(count):
        m = visible[j]
        for q in range(first[m], first[m] + size[m]):
            if project(row_of(packed, q), axes, position, lens, width, height, far, row_of(table, used)):
                used += 1
    return used


@njit(**INLINE)
def project(quad, axes, position, lens, width, height, far, row):
    """Write draw-list row ``r`` for quad ``q``; returns False when it cannot be seen."""
    fx, fy, cx, cy = lens
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = axes
    eye = position
    ex, ey, ez = quad[0] - eye[0], quad[1] - eye[1], quad[2] - eye[2]
    facing = quad[NORMAL] * ex + quad[NORMAL + 1] * ey + quad[NORMAL + 2] * ez
    if facing >= 0.0 and quad[TWO_SIDED] == ZERO:
        return False
    ux, uy, uz = quad[U], quad[U + 1], quad[U + 2]
    vx, vy, vz = quad[V], quad[V + 1], quad[V + 2]
    o2 = r02 * ex + r12 * ey + r22 * ez
    u2 = r02 * ux + r12 * uy + r22 * uz
    v2 = r02 * vx + r12 * vy + r22 * vz
    z1, z2, z3 = o2 + u2, o2 + v2, o2 + u2 + v2
    z_min = min(min(o2, z1), min(z2, z3))
    if max(max(o2, z1), max(z2, z3)) < NEAR or z_min > far:
        return False
    o0 = r00 * ex + r10 * ey + r20 * ez
    o1 = r01 * ex + r11 * ey + r21 * ez
    u0 = r00 * ux + r10 * uy + r20 * uz
    u1 = r01 * ux + r11 * uy + r21 * uz
    v0 = r00 * vx + r10 * vy + r20 * vz
    v1 = r01 * vx + r11 * vy + r21 * vz
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
    row[W0], row[WX], row[WY] = c2, c0, c1
    row[A0], row[AX], row[AY] = a2, a0, a1
    row[B0], row[BX], row[BY] = b2, b0, b1
    _edge(row, 0, a2, a0, a1)
    _edge(row, 1, c2 - a2, c0 - a0, c1 - a1)
    _edge(row, 2, b2, b0, b1)
    _edge(row, 3, c2 - b2, c0 - b0, c1 - b1)
    row[TOP], row[BOTTOM], row[LEFT], row[RIGHT] = top, bottom, left, right
    row[TEXTURE] = quad[TEXTURE_ID]
    row[HOLES] = quad[HAS_HOLES]
    row[REPEAT_U], row[REPEAT_V] = quad[REPEAT], quad[REPEAT + 1]
    row[SHIFT_U], row[SHIFT_V] = quad[SHIFT], quad[SHIFT + 1]
    density = SIZE * quad[DENSITY_PER_M]
    row[DENSITY] = density
    albedo = quad[ALBEDO]
    contrast = 0.0
    if quad[HAS_HOLES] != ZERO:
        # Beyond one texel per pixel the grain averages out; the holes stay, as a point-sampled depth needs.
        texels = density * 0.5 * (o2 + z3) / fx
        contrast = albedo / UNIT * min(1.0, 1.0 / max(texels, 1e-6))
    row[CONTRAST] = contrast
    row[GREY] = albedo - contrast * UNIT
    return True


@njit(**INLINE)
def _edge(row, e, p0, px, py):
    """Store the half-plane ``p0 + px x + py y >= 0`` as a bound on x."""
    px = 1e-20 if abs(px) < 1e-20 else px
    inverse = -1.0 / px
    edge, slope = p0 * inverse, py * inverse
    inside_right = px > 0.0
    row[LOW + e], row[LOW_SLOPE + e] = edge if inside_right else -UNBOUNDED, slope if inside_right else 0.0
    row[HIGH + e], row[HIGH_SLOPE + e] = UNBOUNDED if inside_right else edge, 0.0 if inside_right else slope
