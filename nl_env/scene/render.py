"""Software renderer: pixel-aligned intensity and z-depth of parallelograms over a painted ground plane.

One frame is: cull objects and project their quads (``listing``), rasterise (``raster``), shade and blur
(``shading``).
Grey levels are gamma-coded throughout (products of powers are powers of products), so no power is taken
per pixel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from nl_env.lanes import LANES
from nl_env.scene import listing, raster, shading
from nl_env.scene.quads import Objects, Quads
from nl_env.scene.raster import FAST
from nl_env.scene.textures import Textures, halve, load, pack
from nl_env.types import Camera

FAR = 200.0
"""Depth range of the renderer, m; what lies beyond is still seen as intensity."""
SEEN = FAR + 30.0
"""Depth to which surfaces are drawn, m."""
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
    """Working memory of one renderer: frame buffers (with spare columns), the draw list, one row to blur."""

    inverse_depth: NDArray[np.float32]
    indices: NDArray[np.int32]
    shade: NDArray[np.float32]
    table: NDArray[np.float64]
    visible: NDArray[np.int32]
    row: NDArray[np.float32]

    @classmethod
    def allocate(cls, camera: Camera, quads: int, objects: int) -> Buffers:
        """For scenes of at most ``quads`` parallelograms in ``objects`` objects."""
        frame = (camera.height, camera.width + LANES)
        return cls(
            np.zeros(frame, np.float32),
            np.full(frame, raster.OUTSIDE, np.int32),
            np.zeros(frame, np.float32),
            np.zeros((max(quads, 1), raster.COLUMNS), np.float64),
            np.zeros(max(objects, 1), np.int32),
            np.zeros(camera.width, np.float32),
        )


@njit(**FAST)
def render_frame(
    static, static_objects, moving, moving_objects, pose, lens, textures, ground, light, buffers, intensity,
    depth, with_depth,
):  # fmt: skip
    """Render one frame into ``intensity`` and, when asked for, ``depth``."""
    rotation, eye = pose[:3, :3].copy(), pose[:3, 3].copy()
    inverse_depth, index, shade, table = buffers.inverse_depth, buffers.indices, buffers.shade, buffers.table
    visible = buffers.visible
    fx, fy, cx, cy = lens
    height, width = intensity.shape
    # Ground plane z = 0: 1 / depth is the ray's downward slope over the camera's height.
    gx = -rotation[2, 0] / fx / eye[2]
    gy = -rotation[2, 1] / fy / eye[2]
    g0 = -rotation[2, 2] / eye[2] - gx * cx - gy * cy
    used = 0
    for quads, objects in ((static, static_objects), (moving, moving_objects)):
        count = listing.cull_objects(
            objects.centre, objects.radius, rotation, eye, lens, width, height, SEEN, visible
        )
        used = listing.list_quads(
            quads,
            visible,
            count,
            objects.first,
            objects.size,
            rotation,
            eye,
            lens,
            width,
            height,
            SEEN,
            table,
            used,
        )
    # Bands keep the depth and index buffers in the cache while many surfaces are drawn over each other.
    band = max(8, BAND_PIXELS // width)
    for first in range(0, height, band):
        last = min(first + band, height)
        raster.clear(inverse_depth, index, first, last, width, g0, gx, gy)
        raster.rasterise(first, last, used, table, textures.cutouts, inverse_depth, index)
        shading.shade_rows(
            first, last, width, rotation, eye, lens, table, textures.packed, textures.offsets, ground.packed,
            ground.layout, ground.corner, ground.texel, light, inverse_depth, index, shade,
        )  # fmt: skip
    shading.blur(shade, BLUR_SIDE, buffers.row, intensity)
    if with_depth:
        raster.write_depth(inverse_depth, depth, FAR)


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
        quads, self._objects = static
        self._static = quads.packed()
        self._ground = ground
        self._light = light
        self._textures: Textures = load()
        self._lens = (camera.fx, camera.fy, camera.cx, camera.cy)
        self._buffers = Buffers.allocate(
            camera, quads.number + moving_quads, max(self._objects.radius.size, moving_objects)
        )
        self._no_depth = np.zeros((1, 1), np.float32)

    def render(
        self,
        pose: NDArray[np.float64],
        moving: tuple[NDArray[np.float32], Objects],
        intensity: NDArray[np.float32],
        depth: NDArray[np.float32] | None,
    ) -> None:
        """Render from ``pose`` (4x4 camera to world) into ``(H, W)`` float32 ``intensity`` and ``depth``.

        ``moving`` are packed quads (see :meth:`Quads.packed`) and their objects. Intensity is gamma-coded
        grey in [0.001, 1]; depth is z-depth in metres, 0 beyond ``FAR``.
        """
        render_frame(
            self._static,
            self._objects,
            *moving,
            np.ascontiguousarray(pose),
            self._lens,
            self._textures,
            self._ground,
            self._light,
            self._buffers,
            intensity,
            self._no_depth if depth is None else depth,
            depth is not None,
        )
