"""Pedestrians: they walk or stand beside the road and cross it where and when no vehicle comes.

Vehicles are simulated first and do not react to them; a crossing is therefore only taken if the finished
vehicle trajectories leave it free.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from nl_env.scene.traffic.trajectories import KNOT_US, Actor, Crossing, Lane, overlaps, point_distance

STEP = KNOT_US / 1e6
MAX_COUNT = 12
WALKING_SPEEDS = (0.8, 1.8)
KERB_DISTANCES = (1.0, 3.0)
"""Where pedestrians walk: metres outside the outermost lane."""

CROSSING_MARGIN = 1.2
"""Metres between a crossing pedestrian and any vehicle outline, m."""

LOOK_AHEAD = 2.0
"""Seconds within which no vehicle may reach the place of a crossing pedestrian."""


@njit(cache=True, error_model="numpy")
def crossing_is_free(walk, first, vehicles, sizes, ahead, margin):
    """Whether a pedestrian at ``walk[k]`` at knot ``first + k`` keeps ``margin`` from all vehicles.

    ``walk`` is ``(k, 2)``, ``vehicles`` ``(K, m, 3)``, ``sizes`` ``(m, 2)``; every position is compared with
    the vehicles of the same knot and of the ``ahead`` following ones.
    """
    for k in range(len(walk)):
        for t in range(first + k, min(first + k + ahead + 1, len(vehicles))):
            for m in range(vehicles.shape[1]):
                if point_distance(walk[k, 0], walk[k, 1], vehicles[t, m], sizes[m]) < margin:
                    return False
    return True


class Pavement:
    """The strips beside the outermost lanes."""

    def __init__(self, lanes: Sequence[Lane]) -> None:
        self._lanes = lanes
        self._points = np.concatenate([lane.points for lane in lanes])
        self._half_widths = np.concatenate([np.full(len(lane.points), lane.width / 2) for lane in lanes])
        self._tree = cKDTree(self._points)

    def beside_road(self, points: NDArray[np.float64], clearance: float) -> NDArray[np.bool_]:
        """``(N,)``: which ``points`` are at least ``clearance`` metres outside of every lane."""
        distances, found = self._tree.query(points, k=4)
        aside = np.sqrt(
            np.maximum(distances**2 - 1.0, 0.0)
        )  # lane points are at most 1 m along the lane away
        return np.all(aside > self._half_widths[found] + clearance, axis=1)

    def strips(self, distance: float) -> list[NDArray[np.float64]]:
        """Paths ``(N, 3)`` (x, y, heading) of at least 16 m, ``distance`` metres outside the road."""
        paths = []
        for lane in self._lanes:
            for side in (-1.0, 1.0):
                normal = np.stack((-np.sin(lane.headings), np.cos(lane.headings)), axis=1)
                points = lane.points + side * (lane.width / 2 + distance) * normal
                free = self.beside_road(points, distance - 0.5)
                path = np.column_stack((points, lane.headings))
                runs = np.split(path, np.flatnonzero(np.diff(free.astype(np.int8))) + 1)
                paths += runs[(0 if free[0] else 1) :: 2]
        return [path for path in paths if len(path) >= 8]

    def across(self, place: Crossing) -> NDArray[np.float64] | None:
        """``(2, 2)`` start and end of the way across the road at ``place``; None if the road is too wide."""
        offsets = np.arange(-16.0, 16.1, 0.25)
        normal = np.array((-math.sin(place.heading), math.cos(place.heading)))
        line = np.array((place.x, place.y)) + offsets[:, None] * normal
        free = self.beside_road(line, KERB_DISTANCES[0])
        right, left = np.flatnonzero(free & (offsets < 0)), np.flatnonzero(free & (offsets > 0))
        if len(right) == 0 or len(left) == 0:
            return None
        return line[[right[-1], left[0]]]


def populate_pavements(
    rng: np.random.Generator,
    lanes: Sequence[Lane],
    crossings: Sequence[Crossing],
    vehicles: NDArray[np.float64],
    sizes: NDArray[np.float64],
) -> tuple[list[Actor], NDArray[np.float64]]:
    """Up to ``MAX_COUNT`` pedestrians near the ego's path.

    Args:
        rng: source of all randomness.
        lanes: the road, world frame.
        crossings: where a light stops the traffic; pedestrians also cross elsewhere.
        vehicles: ``(K, m, 3)`` poses of all vehicles at the knots, the ego first.
        sizes: ``(m, 2)`` length and width of each.

    Returns:
        The pedestrians and their ``(K, n, 3)`` knots.
    """
    pavement = Pavement(lanes)
    path = vehicles[:, 0]
    strips = pavement.strips(float(rng.uniform(*KERB_DISTANCES)))
    walks = []
    for _ in range(int(rng.integers(MAX_COUNT + 1))):
        meeting = path[int(rng.integers(len(path)))]
        if rng.random() < 0.3:
            place = crossings[int(rng.integers(len(crossings)))] if crossings else Crossing(*meeting)
            walk = _cross(rng, pavement, place, vehicles, sizes)
        else:
            walk = _stroll(rng, strips, meeting, len(path))
        if walk is not None:
            walks.append(walk)
    if not walks:
        return [], np.empty((len(path), 0, 3))
    return _keep_apart(rng, np.stack(walks, axis=1), vehicles, sizes)


def _stroll(
    rng: np.random.Generator, strips: list[NDArray[np.float64]], meeting: NDArray[np.float64], knots: int
) -> NDArray[np.float64] | None:
    """``(K, 3)`` knots of somebody who walks along a strip, or stands, near where the ego passes."""
    near = [strip for strip in strips if np.hypot(*(strip[:, :2] - meeting[:2]).T).min() < 45.0]
    if not near:
        return None
    strip = near[int(rng.integers(len(near)))]
    stations = np.concatenate(((0.0,), np.cumsum(np.hypot(*np.diff(strip[:, :2], axis=0).T))))
    at = stations[int(np.argmin(np.hypot(*(strip[:, :2] - meeting[:2]).T)))] + rng.uniform(-40.0, 40.0)
    way = rng.choice((-1.0, 1.0))
    speed = 0.0 if rng.random() < 0.25 else float(rng.uniform(*WALKING_SPEEDS))
    along = np.clip(at + way * speed * STEP * (np.arange(knots) - knots / 2), 0.0, stations[-1])
    walk = np.column_stack([np.interp(along, stations, column) for column in strip.T])
    walk[:, 2] += 0.0 if way > 0 else np.pi
    return walk


def _cross(
    rng: np.random.Generator,
    pavement: Pavement,
    place: Crossing,
    vehicles: NDArray[np.float64],
    sizes: NDArray[np.float64],
) -> NDArray[np.float64] | None:
    """``(K, 3)`` knots of somebody who crosses at ``place`` when the ego is as near as is safe, or None."""
    ends = pavement.across(place)
    if ends is None:
        return None
    start, end = ends[:: int(rng.choice((-1, 1)))]
    sideways = rng.uniform(-1.5, 1.5) * np.array((math.cos(place.heading), math.sin(place.heading)))
    start, end = start + sideways, end + sideways
    way = end - start
    speed = rng.uniform(1.0, WALKING_SPEEDS[1])
    steps = math.ceil(np.hypot(*way) / (speed * STEP))
    crossing = start + np.linspace(0.0, 1.0, steps + 1)[:, None] * way
    starts = np.arange(0, len(vehicles) - steps // 2, 4)
    ego_distances = np.hypot(vehicles[starts, 0, 0] - place.x, vehicles[starts, 0, 1] - place.y)
    for first in starts[np.argsort(ego_distances, kind="stable")].tolist():
        if crossing_is_free(crossing, first, vehicles, sizes, int(LOOK_AHEAD / STEP), CROSSING_MARGIN):
            progress = np.clip(np.arange(len(vehicles)) - first, 0, steps)
            return np.column_stack((crossing[progress], np.full(len(vehicles), math.atan2(way[1], way[0]))))
    return None


def _keep_apart(
    rng: np.random.Generator,
    walks: NDArray[np.float64],
    vehicles: NDArray[np.float64],
    sizes: NDArray[np.float64],
) -> tuple[list[Actor], NDArray[np.float64]]:
    """Give every walker a body and leave out those who would touch a vehicle or an earlier walker."""
    bodies = rng.uniform((0.3, 0.45, 1.55), (0.45, 0.6, 1.9), (walks.shape[1], 3))
    outlines = np.concatenate((sizes, bodies[:, :2] + 0.3))
    met = overlaps(np.concatenate((vehicles, walks), axis=1), outlines)
    kept: list[int] = []
    for k in range(walks.shape[1]):
        others = [*range(len(sizes)), *(len(sizes) + j for j in kept)]
        if not met[len(sizes) + k, others].any():
            kept.append(k)
    return [Actor("pedestrian", *map(float, bodies[k])) for k in kept], walks[:, kept]
