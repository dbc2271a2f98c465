"""The painted ground: asphalt, pavement, verge, lane markings, patches and cracks as one grey map."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.ndimage import distance_transform_edt

from nl_env.scene.render import GroundMap
from nl_env.scene.textures import GAMMA, noise
from nl_env.scene.traffic import Lane

MARGIN = 190.0
"""The map reaches this far beyond the ego's path, m."""
_FIELD_TEXEL = 0.8
_MAX_TEXELS = 5e6
_MARKING = 222


class RoadField:
    """Distance to the nearest road surface, looked up anywhere on the map."""

    def __init__(self, road: NDArray[np.uint8], corner: NDArray[np.float64], texel: float) -> None:
        self._corner, self._texel = corner, texel
        self.distance: NDArray[np.float32] = (distance_transform_edt(road == 0) * texel).astype(np.float32)

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        """Distance in metres at ``(N, 2)`` points; -1 off the map."""
        cell = np.floor((points - self._corner) / self._texel).astype(np.int64)
        rows, columns = self.distance.shape
        inside = (cell >= 0).all(1) & (cell[:, 0] < columns) & (cell[:, 1] < rows)
        out = np.full(len(points), -1, np.float32)
        out[inside] = self.distance[cell[inside, 1], cell[inside, 0]]
        return out


@njit(cache=True, error_model="numpy", fastmath=True)
def _compose(road, field, ratio, patches, asphalt, near, pavement, verge, slabs, slab_texels, out):
    """Grey of every texel from its distance to the road, large patches of tone, and pavement slabs."""
    rows, columns = out.shape
    n = patches.shape[0]
    for y in range(rows):
        fy = min(int(y * ratio), field.shape[0] - 1)
        for x in range(columns):
            fx = min(int(x * ratio), field.shape[1] - 1)
            if road[y, x] > 0:
                grey = asphalt
            else:
                d = field[fy, fx]
                grey = pavement if d < near else verge
                if slabs and d < near and (x % slab_texels == 0 or y % slab_texels == 0):
                    grey *= 0.75
            grey *= 1.0 + 0.12 * patches[y * n // rows, x * n // columns]
            out[y, x] = min(max(grey, 1.0), 255.0)


class Ground:
    """Paints the map of one world.

    Args:
        lanes: the road network near the path.
        path: ``(M, 2)`` ego positions.
        style: ``config.STYLES``.
        rng: source of tones, patches and cracks.
    """

    def __init__(
        self, lanes: Sequence[Lane], path: NDArray[np.float64], style: str, rng: np.random.Generator
    ) -> None:
        corner = path.min(0) - MARGIN
        extent = path.max(0) + MARGIN - corner
        texel = max(0.2, math.sqrt(extent[0] * extent[1] / _MAX_TEXELS))
        self._corner, self._texel = corner, texel
        size = (int(extent[0] / texel), int(extent[1] / texel))
        image = Image.new("L", size, 0)
        draw = ImageDraw.Draw(image)
        for lane in lanes:
            draw.line(
                self._pixels(lane.points), 255, max(1, round((lane.width + 0.8) / texel)), joint="curve"
            )
        road = np.asarray(image)
        coarse = max(1, round(_FIELD_TEXEL / texel))
        self.field = RoadField(road[::coarse, ::coarse], corner, coarse * texel)
        town = style in ("downtown", "suburb")
        self._canvas = np.empty(road.shape, np.uint8)
        tones = noise(rng, 512, 1.2)
        _compose(
            road, self.field.distance, 1.0 / coarse, tones, rng.uniform(55, 95), 3.0,
            135.0 if town else 95.0, 105.0 if style == "downtown" else rng.uniform(60, 110), town,
            max(2, round(1.6 / texel)), self._canvas,
        )  # fmt: skip
        self._image = Image.fromarray(self._canvas)
        self._draw = ImageDraw.Draw(self._image)
        self._wear(rng, path)
        for lane in lanes:
            self._mark(lane)

    def _pixels(self, points: NDArray[np.float64]) -> list[tuple[float, float]]:
        return [(float(x), float(y)) for x, y in (points - self._corner) / self._texel]

    def _wear(self, rng: np.random.Generator, path: NDArray[np.float64]) -> None:
        """Repair patches, oil stains and cracks, densest where they are seen: near the path."""
        count = 12 * len(path)
        at = path[rng.integers(len(path), size=count)] + rng.normal(scale=14.0, size=(count, 2))
        at = at[self.field(at) == 0]
        for x, y in self._pixels(at):
            if rng.random() < 0.5:
                a, b = rng.uniform(0.3, 2.2) / self._texel, rng.uniform(0.3, 1.4) / self._texel
                column, row = (
                    int(min(max(x, 0), self._image.width - 1)),
                    int(min(max(y, 0), self._image.height - 1)),
                )
                here = float(self._canvas[row, column])
                self._draw.ellipse((x - a, y - b, x + a, y + b), int(here * rng.choice([0.72, 1.25])))
            else:
                dx, dy = rng.uniform(-5, 5, 2) / self._texel
                self._draw.line((x, y, x + dx, y + dy), 38)

    def _mark(self, lane: Lane) -> None:
        normal = np.stack([-np.sin(lane.headings), np.cos(lane.headings)], 1)
        for side, kind in ((1, lane.left), (-1, lane.right)):
            if kind == "none":
                continue
            line = lane.points + side * normal * lane.width / 2
            if kind == "solid":
                self._draw.line(self._pixels(line), _MARKING, 1, joint="curve")
                continue
            travelled = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
            for start in np.arange(0.0, travelled[-1] - 3.0, 9.0):
                at = np.array([start, start + 3.0])
                dash = np.stack(
                    [np.interp(at, travelled, line[:, 0]), np.interp(at, travelled, line[:, 1])], 1
                )
                self._draw.line(self._pixels(dash), _MARKING, 1)

    def shadow(self, centres: NDArray[np.float64], radius: float, rng: np.random.Generator) -> None:
        """Dappled shadows of trees at ``(N, 2)`` centres."""
        for x, y in self._pixels(centres + radius * np.array([0.8, 0.5])):
            for _ in range(8):
                column = int(x + rng.normal() * radius / self._texel * 0.45)
                row = int(y + rng.normal() * radius / self._texel * 0.45)
                r = max(1, int(radius / self._texel * rng.uniform(0.1, 0.35)))
                if r < column < self._image.width - r and r < row < self._image.height - r:
                    dark = int(0.55 * self._canvas[row, column])
                    self._draw.ellipse((column - r, row - r, column + r, row + r), dark)

    def finish(self) -> GroundMap:
        """The map for the renderer, gamma-coded."""
        table = ((np.arange(256) / 255.0) ** GAMMA).astype(np.float32)
        return GroundMap.paint(table[np.asarray(self._image)], self._corner + 0.5 * self._texel, self._texel)
