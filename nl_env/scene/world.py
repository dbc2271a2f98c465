"""The static world around a drive: what stands along the roads, in four styles, and a belt beyond."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nl_env.scene import models
from nl_env.scene import textures as tex
from nl_env.scene.ground import Ground
from nl_env.scene.quads import Objects, Quads, assemble, place
from nl_env.scene.render import GroundMap
from nl_env.scene.textures import GAMMA
from nl_env.scene.traffic import Traffic
from nl_env.scene.weather import Weather

_VARIANTS = 6
"""Templates of each kind per world."""


@dataclass(frozen=True)
class Style:
    """What lines the roads. Spacings and setbacks (from the road's edge) in metres, shares in [0, 1].

    Attributes:
        building_spacing, building_setback, building_share: houses along the road.
        belt, belt_reach, belt_buildings: trees and houses in the far belt, out to which distance from the
            ego's path, and the share of houses. Nothing stands further out.
        tree_spacing, tree_setback: first row of trees.
        second_row: setback of a second row of trees, None for no such row.
        bush_share, furniture_share, parked_share, fence_share, kerbs: roadside things.
    """

    building_spacing: float
    building_setback: tuple[float, float]
    building_share: float
    belt: int
    belt_reach: float
    belt_buildings: float
    tree_spacing: float
    tree_setback: tuple[float, float]
    second_row: tuple[float, float] | None
    bush_share: float
    furniture_share: float
    parked_share: float
    fence_share: float
    kerbs: bool


STYLES: dict[str, Style] = {
    "downtown": Style(15, (11, 17.5), 1.0, 310, 145.0, 0.45, 33, (4, 7), None, 0.1, 0.7, 0.35, 0.06, True),
    "suburb": Style(
        19, (20, 45), 0.75, 245, 124.0, 0.45, 27, (4.5, 16), (17, 55), 0.25, 0.7, 0.35, 0.2, True
    ),
    "park": Style(19, (20, 45), 0.3, 245, 124.0, 0.45, 16, (4.5, 16), (17, 55), 0.25, 0.7, 0.35, 0.2, True),
    "rural": Style(19, (14, 40), 0.2, 200, 98.0, 0.12, 25, (5.5, 20), (15, 45), 0.25, 0.3, 0.0, 0.2, False),
}
_HIGHWAYS = ("highway", "merge", "exit")
_TREE_LEVELS = (
    (0.0, 14.0, 3, tex.LEAVES_FAR),
    (14.0, 45.0, 6, tex.LEAVES_FAR),
    (45.0, np.inf, 12, tex.LEAVES_NEAR),
)
"""Canopy radius in pixels at the nearest sight (from, below), leaf planes, their textures."""
_STEP = 1.5
"""How much further out, m, the ground is probed to tell the road's edge from the space between lanes."""
_BARRIERS = 0.95
"""Share of a highway's edges that has a guard rail."""


@dataclass(frozen=True)
class World:
    """Everything that stands still.

    Attributes:
        quads, objects: lit geometry.
        ground: the painted ground plane.
    """

    quads: Quads
    objects: Objects
    ground: GroundMap


class _Builder:
    """Collects placed templates."""

    def __init__(self, traffic: Traffic, style: str, focal: float, rng: np.random.Generator) -> None:
        self.rng = rng
        self.focal = focal
        self.reach = STYLES[style].belt_reach
        self.path = traffic.ego_path()
        self.lanes = traffic.lanes
        self.ground = Ground(self.lanes, self.path, style, rng)
        self.parts: list[tuple[Quads, Objects]] = []

    def path_distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance of ``(N, 2)`` points from the ego's path."""
        path = self.path[::5]
        return np.asarray(np.sqrt(((points[:, None] - path[None]) ** 2).sum(2)).min(1))

    def along(
        self,
        spacing: float,
        setback: tuple[float, float],
        share: float = 1.0,
        jitter: float = 0.3,
        half_length: float = 0.0,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Points beside the roads and yaw angles that turn a template's -y towards the road.

        What reaches ``half_length`` metres along the road keeps both ends off every lane.
        """
        points, yaws = [], []
        for lane in self.lanes:
            length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(lane.points, axis=0), axis=1))]
            count = int(length[-1] / spacing)
            if not count:
                continue
            for side in (1, -1):
                s = (
                    np.arange(count) + self.rng.uniform(-jitter, jitter, count) + self.rng.uniform()
                ) * spacing
                keep = (self.rng.random(count) < share) & (s > 0) & (s < length[-1])
                s = s[keep]
                heading = np.interp(s, length, np.unwrap(lane.headings))
                centre = np.stack([np.interp(s, length, lane.points[:, i]) for i in (0, 1)], 1)
                offset = self.rng.uniform(*setback, len(s))
                normal = side * np.stack([-np.sin(heading), np.cos(heading)], 1)
                at = centre + normal * (lane.width / 2 + offset)[:, None]
                # Beside another lane is in somebody's way: a step further out must be further off the road.
                clear = self.ground.field(at + _STEP * normal) >= offset + 0.1
                if half_length:
                    ahead = half_length * np.stack([np.cos(heading), np.sin(heading)], 1)
                    for end in (at + ahead, at - ahead):
                        clear &= self.ground.field(end) >= offset - 0.8
                points.append(at[clear])
                yaws.append(heading[clear] + (0.0 if side > 0 else np.pi))
        if not points:
            return np.zeros((0, 2)), np.zeros(0)
        return self.thin(np.concatenate(points), np.concatenate(yaws), 0.6 * spacing)

    def thin(
        self, points: NDArray[np.float64], yaws: NDArray[np.float64], cell: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Keep one point per ``cell`` metres, and only those near enough to be seen from the path."""
        near = self.path_distance(points) < self.reach if len(points) else np.zeros(0, bool)
        points, yaws = points[near], yaws[near]
        _, first = np.unique(np.floor(points / cell).astype(np.int64), axis=0, return_index=True)
        first.sort()
        return points[first], yaws[first]

    def add(
        self,
        templates: Sequence[Quads],
        points: NDArray[np.float64],
        yaws: NDArray[np.float64],
        scale: tuple[float, float] = (1.0, 1.0),
        brightness: tuple[float, float] = (1.0, 1.0),
    ) -> None:
        """Place a random template at each point."""
        kind = self.rng.integers(len(templates), size=len(points))
        scales = self.rng.uniform(*scale, len(points))
        lights = self.rng.uniform(*brightness, len(points))
        for i, template in enumerate(templates):
            m = kind == i
            if m.any():
                position = np.concatenate([points[m], np.zeros((int(m.sum()), 1))], 1)
                self.parts.append(place(template, position, yaws[m], scales[m], lights[m]))

    def variants(self, make: Callable[[np.random.Generator], Quads], count: int = _VARIANTS) -> list[Quads]:
        """A few random templates of one kind."""
        return [make(self.rng) for _ in range(count)]

    def trees(self, points: NDArray[np.float64], scale: tuple[float, float]) -> None:
        """Trees with as many leaf planes as their nearest sight deserves; no level changes during a drive."""
        seen = self.focal * 2.6 / np.maximum(self.path_distance(points), 4.0) if len(points) else np.zeros(0)
        for low, high, cards, leaves in _TREE_LEVELS:
            at = points[(seen >= low) & (seen < high)]
            if len(at):
                kinds = [models.tree(self.rng, cards, leaves, conifer=i % 4 == 3) for i in range(_VARIANTS)]
                if leaves == tex.LEAVES_NEAR:
                    # Seen from afar, twigs would only flicker.
                    kinds.append(models.bare_tree(self.rng))
                self.add(kinds, at, self.rng.uniform(0, 2 * np.pi, len(at)), scale, (0.25, 0.5))

    def houses(
        self, templates: Sequence[Quads], points: NDArray[np.float64], yaws: NDArray[np.float64]
    ) -> None:
        """Buildings whose whole footprint is off the road."""
        if not len(points):
            return
        half = 8.0
        corners = [
            points + half * np.stack([np.cos(yaws + a), np.sin(yaws + a)], 1)
            for a in np.arange(8) * np.pi / 4
        ]
        clear = np.min([self.ground.field(c) for c in corners], axis=0) >= 1.5
        self.add(templates, points[clear], yaws[clear])


def build(traffic: Traffic, style: str, weather: Weather, focal: float, rng: np.random.Generator) -> World:
    """The world of one sequence.

    Args:
        traffic: roads and the ego's path.
        style: one of ``STYLES``.
        weather: light and wetness.
        focal: focal length in pixels; what is never seen larger than a few pixels gets less detail.
        rng: the sequence's generator.
    """
    s = STYLES[style]
    b = _Builder(traffic, style, focal, rng)
    houses = b.variants(lambda r: models.building(r, style), 8)
    points, yaws = b.along(
        s.building_spacing, (s.building_setback[0] + 5, s.building_setback[1] + 5), s.building_share, 0.15
    )
    b.houses(houses, points, yaws)

    centre = b.path[rng.integers(len(b.path), size=s.belt)]
    reach, angle = rng.uniform(45, s.belt_reach, s.belt), rng.uniform(0, 2 * np.pi, s.belt)
    belt = centre + reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    belt = belt[b.ground.field(belt) > 10]
    built = rng.random(len(belt)) < s.belt_buildings
    b.houses(houses, belt[built], rng.uniform(0, 2 * np.pi, int(built.sum())))
    b.trees(belt[~built], (0.9, 1.75))

    row, _ = b.along(s.tree_spacing, s.tree_setback, 1.0, 0.4)
    b.trees(row, (0.8, 1.75))
    b.ground.shadow(row, 2.5, rng)
    if s.second_row is not None:
        b.trees(b.along(1.1 * s.tree_spacing, s.second_row, 0.8, 0.5)[0], (0.8, 1.75))

    highway = traffic.scenario in _HIGHWAYS
    b.add(b.variants(models.bush), *b.along(22, (3, 6), s.bush_share, 0.6), (0.6, 1.6), (0.25, 0.5))
    poles = [models.pole(rng, lamp=i % 3 > 0) for i in range(_VARIANTS)]
    b.add(poles, *b.along(40, (0.5, 1.2), 0.9))
    b.add(b.variants(models.sign, 3), *b.along(45, (0.4, 1.2), 0.6, 0.5))
    b.add(b.variants(models.furniture), *b.along(25, (0.8, 3.2), s.furniture_share, 0.5))
    b.add(b.variants(models.fence), *b.along(5.2, (3.6, 4.4), s.fence_share, 0.0))
    b.add([models.barrier()], *b.along(4, (0.6, 0.7), _BARRIERS if highway else 0.0, 0.0, 2.0))
    if s.parked_share and not highway:
        cars = [models.car(rng, 4.6, 1.85, 1.45) for _ in range(_VARIANTS)]
        b.add(cars, *b.along(6.5, (1.4, 1.55), s.parked_share, 0.1, 2.5))
    if s.kerbs:
        b.add([models.kerb()], *b.along(4, (0.5, 0.55), 1.0, 0.0))

    quads, objects = assemble(b.parts)
    return World(light(quads, weather, float(rng.uniform(0, 2 * np.pi))), objects, b.ground.finish())


def light(quads: Quads, weather: Weather, azimuth: float) -> Quads:
    """Quads with linear albedo turned into gamma-coded grey under the sun; leaves have no bright side."""
    shade = np.where(quads.cutout == 1, weather.exposure, weather.shade(quads.normal, azimuth))
    return quads._replace(albedo=(np.clip(quads.albedo * shade, 0.004, 1) ** GAMMA).astype(np.float32))
