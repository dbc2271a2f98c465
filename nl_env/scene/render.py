"""Software renderer: pixel-aligned intensity and z-depth of parallelograms over a painted ground plane.

One frame is: cull objects, project their quads, rasterise, shade, add fog, blur. See ``kernels`` for how
the inner loops stay in SIMD. Grey levels are gamma-coded throughout (products of powers are powers of
products), so no power is taken per pixel.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from nl_env.scene import kernels as k
from nl_env.scene.quads import Objects, Quads
from nl_env.scene.textures import DETAIL, LEVELS, SIZE, SKY, UNIT, Textures, halve, load, pack
from nl_env.types import Camera

f4 = np.float32
i4 = np.int32
FAR = 200.0
"""Depth range of the renderer, m; surfaces up to ``FAR + DRAWN_BEYOND`` are still seen as intensity."""
DRAWN_BEYOND = 30.0
DETAIL_METRES = 2.5
"""Size of one repeat of the ground's detail texture."""
BLUR_SIDE = 0.16
"""Side weight of the three-tap optical blur (a Gaussian of about 0.6 px)."""
BAND_PIXELS = 24_000
"""Pixels of a band of image rows that is drawn and shaded together (8 bytes each)."""
_MAP_LEVELS = 6


class GroundMap(NamedTuple):
    """The painted ground: packed mip levels of a gamma-coded grey map.

    Attributes:
        packed: ``(sum of level sizes,)`` uint32.
        layout: ``(levels, 3)`` int64 offset, rows, columns of each level.
        corner: ``(2,)`` float64 world x, y of texel (0, 0)'s centre.
        texel: size of a texel of level 0, m.
    """

    packed: NDArray[np.uint32]
    layout: NDArray[np.int64]
    corner: NDArray[np.float64]
    texel: float

    @classmethod
    def paint(cls, grey: NDArray[np.float32], corner: NDArray[np.float64], texel: float) -> GroundMap:
        """From a ``(rows, columns)`` grey map in [0, 1], y along rows."""
        rows, columns = (n // 2 ** (_MAP_LEVELS - 1) * 2 ** (_MAP_LEVELS - 1) for n in grey.shape)
        image = grey[:rows, :columns].astype(np.float32) * np.float32(255)
        levels, layout, start = [], [], 0
        for level in range(_MAP_LEVELS):
            image = halve(image) if level else image
            levels.append(pack(image, wrap=False))
            layout.append((start, *image.shape))
            start += levels[-1].size
        return cls(np.concatenate(levels), np.array(layout, np.int64), np.asarray(corner, np.float64), texel)


class Light(NamedTuple):
    """Illumination and atmosphere, see ``weather.py``.

    Attributes:
        sky: grey level of the sky at the horizon.
        zenith: relative change of the sky's level straight up.
        clouds: contrast of the clouds.
        ground: factor on the ground map.
        fog: extinction, 1/m.
        haze: grey level far away in the fog.
        gloss: share of sky reflected by wet ground at grazing angles.
    """

    sky: float
    zenith: float
    clouds: float
    ground: float
    fog: float
    haze: float
    gloss: float


class Buffers(NamedTuple):
    """Working memory of one renderer: frame buffers, the draw list, and one row of shading scratch."""

    inverse_depth: NDArray[np.float32]
    index: NDArray[np.int32]
    shade: NDArray[np.float32]
    table: NDArray[np.float64]
    visible: NDArray[np.int32]
    at: NDArray[np.uint32]
    texel: NDArray[np.int32]
    fa: NDArray[np.float32]
    fb: NDArray[np.float32]
    gain: NDArray[np.float32]
    bias: NDArray[np.float32]

    @classmethod
    def allocate(cls, camera: Camera, quads: int, objects: int) -> Buffers:
        """For scenes of at most ``quads`` parallelograms in ``objects`` objects."""
        row = [np.zeros(camera.width, np.float32) for _ in range(4)]
        return cls(
            np.zeros(camera.shape, np.float32),
            np.zeros(camera.shape, np.int32),
            np.zeros(camera.shape, np.float32),
            np.zeros((max(quads, 1), k.COLUMNS), np.float64),
            np.zeros(max(objects, 1), np.int32),
            np.zeros(camera.width, np.uint32),
            np.zeros(camera.width, np.int32),
            *row,
        )


@njit(**k.FAST)
def list_quads(quads, objects, rotation, eye, lens, buffers, used):
    """Append the visible quads to the draw list; returns its length."""
    height, width = buffers.index.shape
    far = FAR + DRAWN_BEYOND
    count = k.cull_objects(objects, rotation, eye, lens, width, height, far, buffers.visible)
    for j in range(count):
        m = buffers.visible[j]
        for q in range(objects.first[m], objects.first[m] + objects.size[m]):
            if k.project(quads, q, rotation, eye, lens, width, height, far, buffers.table[used]):
                used += 1
    return used


@njit(**k.FAST)
def rasterise(first, last, used, textures, buffers):
    """Draw the listed quads on image rows ``first`` to ``last - 1``."""
    for r in range(used):
        row = buffers.table[r]
        y0 = max(first, int(row[k.TOP]))
        y1 = min(last - 1, int(row[k.BOTTOM]))
        if y1 < y0:
            continue
        if row[k.HOLES] == 0.0:
            k.fill_opaque(row, i4(r + 1), y0, y1, buffers.inverse_depth, buffers.index)
        else:
            cutout = textures.cutouts[int(row[k.TEXTURE])]
            k.fill_cutout(row, r, y0, y1, cutout, buffers.inverse_depth, buffers.index, buffers.at, buffers.texel)


@njit(**k.FAST)
def shade(first, last, rotation, eye, lens, textures, ground, light, buffers):
    """Shade image rows ``first`` to ``last - 1``, run by run of equal index."""
    fx, fy, cx, cy = lens
    width = buffers.index.shape[1]
    at, fa, fb, gain, bias = buffers.at, buffers.fa, buffers.fb, buffers.gain, buffers.bias
    packed = textures.packed
    phase_x, phase_y = eye[0] / DETAIL_METRES, eye[1] / DETAIL_METRES
    phase_x -= math.floor(phase_x)
    phase_y -= math.floor(phase_y)
    for y in range(first, last):
        ids, ws, out = buffers.index[y], buffers.inverse_depth[y], buffers.shade[y]
        # World direction of the ray through column x, per metre of depth: s + t x.
        dy = (y - cy) / fy
        sx = rotation[0, 1] * dy + rotation[0, 2] - rotation[0, 0] * cx / fx
        sy = rotation[1, 1] * dy + rotation[1, 2] - rotation[1, 0] * cx / fx
        sz = rotation[2, 1] * dy + rotation[2, 2] - rotation[2, 0] * cx / fx
        tx, ty, tz = rotation[0, 0] / fx, rotation[1, 0] / fx, rotation[2, 0] / fx
        # Texel size on the ground against the geometric mean of the sides of a pixel's footprint.
        slope = max(-(sz + tz * width / 2), 1e-3)
        footprint = eye[2] / slope / fx / math.sqrt(max(slope, 0.02))
        x = 0
        while x < width:
            label = ids[x]
            if label <= k.CUTOUT:
                k.cutout_pixel(ids, x, at, gain, bias, buffers.table)
                x += 1
                continue
            end = x + 1
            while end < width and ids[end] == label:
                end += 1
            if label == k.GROUND:
                level = k.mip_level(footprint / ground.texel, ground.layout.shape[0])
                start, rows, columns = ground.layout[level]
                scale = 1.0 / (ground.texel * (1 << level))
                offset = 0.5 / (1 << level) - 0.5
                k.map_run(
                    at[x:end], fa[x:end], fb[x:end], gain[x:end], ws[x:end],
                    ground.packed[start : start + rows * columns], rows, columns,
                    f4(sx + tx * x), f4(tx), f4(sy + ty * x), f4(ty), f4(scale),
                    f4((eye[0] - ground.corner[0]) * scale + offset), f4((eye[1] - ground.corner[1]) * scale + offset),
                    f4(light.ground / (255.0 * UNIT)),
                )  # fmt: skip
                level = k.mip_level(footprint * SIZE / DETAIL_METRES, LEVELS)
                side = SIZE >> level
                k.detail_run(
                    at[x:end], fa[x:end], fb[x:end], gain[x:end], bias[x:end], ws[x:end],
                    f4(sx + tx * x), f4(tx), f4(sy + ty * x), f4(ty), f4(side / DETAIL_METRES),
                    f4(phase_x * side), f4(phase_y * side), i4(textures.offsets[DETAIL, level]), level,
                    f4(light.gloss), f4(light.sky),
                )  # fmt: skip
            elif label == k.SKY_ID:
                k.sky_run(
                    at[x:end], fa[x:end], fb[x:end], gain[x:end], bias[x:end],
                    f4(sx + tx * x), f4(tx), f4(sy + ty * x), f4(ty), f4(sz + tz * x), f4(tz), f4(light.sky),
                    f4(light.zenith), f4(light.clouds), i4(textures.offsets[SKY, 0]),
                )  # fmt: skip
            else:
                row = buffers.table[label - 1]
                texture = int(row[k.TEXTURE])
                if texture < 0:
                    k.constant_run(at[x:end], gain[x:end], bias[x:end], f4(row[k.GREY]))
                else:
                    level = k.surface_level(row, 0.5 * (x + end), float(y), fx)
                    side = SIZE >> level
                    scale_u, scale_v = row[k.REPEAT_U] * side, row[k.REPEAT_V] * side
                    k.texture_run(
                        at[x:end], fa[x:end], fb[x:end], gain[x:end], bias[x:end], ws[x:end],
                        f4((row[k.A0] + row[k.AX] * x + row[k.AY] * y) * scale_u), f4(row[k.AX] * scale_u),
                        f4((row[k.B0] + row[k.BX] * x + row[k.BY] * y) * scale_v), f4(row[k.BX] * scale_v),
                        i4(textures.offsets[texture, level]), level,
                        f4((row[k.SHIFT_U] + 1.0) * side), f4((row[k.SHIFT_V] + 1.0) * side), f4(row[k.GREY] / UNIT),
                    )  # fmt: skip
            x = end
        k.blend(at, fa, fb, gain, bias, packed, out)
        if light.fog > 0.0:
            k.add_fog(out, ws, f4(light.fog), f4(light.haze))


@njit(**k.FAST)
def render_frame(
    static, static_objects, moving, moving_objects, rotation, eye, lens, textures, ground, light,
    buffers, intensity, depth, with_depth,
):  # fmt: skip
    """Render one frame into ``intensity`` and, when asked for, ``depth``."""
    fx, fy, cx, cy = lens
    height, width = buffers.index.shape
    # Ground plane z = 0: 1 / depth is the ray's downward slope over the camera's height.
    gx = -rotation[2, 0] / fx / eye[2]
    gy = -rotation[2, 1] / fy / eye[2]
    g0 = -rotation[2, 2] / eye[2] - gx * cx - gy * cy
    used = list_quads(static, static_objects, rotation, eye, lens, buffers, 0)
    used = list_quads(moving, moving_objects, rotation, eye, lens, buffers, used)
    # Bands keep the depth and index buffers in the cache while many surfaces are drawn over each other.
    band = max(8, BAND_PIXELS // width)
    for first in range(0, height, band):
        last = min(first + band, height)
        k.clear(buffers.inverse_depth, buffers.index, first, last, g0, gx, gy)
        rasterise(first, last, used, textures, buffers)
        shade(first, last, rotation, eye, lens, textures, ground, light, buffers)
    k.blur(buffers.shade, f4(BLUR_SIDE), buffers.bias, intensity)
    if with_depth:
        k.write_depth(buffers.inverse_depth, depth, FAR)


class Renderer:
    """Renders one static world and its moving objects through one camera.

    Args:
        camera: intrinsics.
        static: every quad that does not move, lit, and its objects.
        ground: the painted ground plane z = 0.
        light: sky, fog, wetness.
        moving_quads, moving_objects: capacity for what :meth:`render` is given.
    """

    def __init__(
        self,
        camera: Camera,
        static: tuple[Quads, Objects],
        ground: GroundMap,
        light: Light,
        moving_quads: int,
        moving_objects: int,
    ) -> None:
        self.camera = camera
        self._static, self._objects = static
        self._ground = ground
        self._light = light
        self._textures: Textures = load()
        self._lens = (camera.fx, camera.fy, camera.cx, camera.cy)
        quads = self._static.count + moving_quads
        self._buffers = Buffers.allocate(camera, quads, max(self._objects.radius.size, moving_objects))
        self._no_depth = np.zeros((1, 1), np.float32)

    def render(
        self,
        pose: NDArray[np.float64],
        moving: tuple[Quads, Objects],
        intensity: NDArray[np.float32],
        depth: NDArray[np.float32] | None,
    ) -> None:
        """Render from ``pose`` (4x4 camera to world) into ``(H, W)`` float32 ``intensity`` and ``depth``.

        Intensity is gamma-coded grey in [0.001, 1]; depth is z-depth in metres, 0 beyond ``FAR``.
        """
        render_frame(
            self._static,
            self._objects,
            *moving,
            np.ascontiguousarray(pose[:3, :3]),
            np.ascontiguousarray(pose[:3, 3]),
            self._lens,
            self._textures,
            self._ground,
            self._light,
            self._buffers,
            intensity,
            self._no_depth if depth is None else depth,
            depth is not None,
        )
