"""Road networks of highway-env: built, lengthened, connected, and read out as lanes of the world.

highway-env builds a road in a method of an environment that reads ``config`` and sets ``road``. Those
methods are called on a bare namespace here: building the whole environment would also spawn its traffic
(unseeded) and overwrite driver parameters for the whole process.

highway-env's y axis points down the screen; :func:`world_lanes` mirrors it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
from highway_env.road.lane import AbstractLane, CircularLane, LineType, SineLane, StraightLane
from highway_env.road.road import RoadNetwork
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from nl_env.scene.traffic.signals import LaneIndex
from nl_env.scene.traffic.trajectories import Lane

UNLIMITED = 60.0
"""Speed limit of a straight lane, m/s: only curves slow drivers down."""

CURVE_ACCELERATION = 2.2
"""Lateral acceleration at which curves are driven, m/s^2."""

KINK_SPEED = 4.0
"""Speed at a joint of two lanes that differ in heading (the mouths of a roundabout), m/s."""

Station = tuple[NDArray[np.float64], float]
"""Position and heading."""

LINE_NAMES = {
    LineType.NONE: "none",
    LineType.STRIPED: "dashed",
    LineType.CONTINUOUS: "solid",
    LineType.CONTINUOUS_LINE: "solid",
}


def build(maker: Callable[..., None], config: dict[str, Any], **arguments: float) -> RoadNetwork:
    """The network made by an environment's unbound road-building method ``maker``."""
    defaults = {"show_trajectories": False, "neighbour_vehicles_connected_lanes": False}
    unused = np.random.default_rng(0)  # roads are not random, but without it Road would make an unseeded one
    scene = SimpleNamespace(config=defaults | config, np_random=unused)
    maker(scene, **arguments)
    network = scene.road.network
    for lane in network.lanes_list():
        lane.speed_limit = curve_speed(lane)
    return network


def curve_speed(lane: AbstractLane) -> float:
    """Comfortable speed on ``lane``, m/s."""
    if isinstance(lane, CircularLane):
        return math.sqrt(CURVE_ACCELERATION * lane.radius)
    if isinstance(lane, SineLane):
        return math.sqrt(CURVE_ACCELERATION / (abs(lane.amplitude) * lane.pulsation**2))
    return UNLIMITED


def lengthen(network: RoadNetwork, distance: float) -> None:
    """Move every way in and out of ``network`` back by ``distance`` metres, so that nobody reaches its end.

    A lane that stops beside another one in the same direction, such as a merging lane, is no way out.
    """
    lanes = network.lanes_dict()
    starts = [_station(lane, 0.0) for lane in lanes.values()]
    ends = [_station(lane, lane.length) for lane in lanes.values()]
    for (origin, node, k), lane in lanes.items():
        if not _near(_station(lane, 0.0), ends):
            _replace(network, (origin, node, k), lane.position(-distance, 0.0), lane.end)
            lane = network.get_lane((origin, node, k))
        if _near(_station(lane, lane.length), starts):
            continue
        if isinstance(lane, CircularLane):
            begin, heading = _station(lane, lane.length)
            beyond = begin + distance * np.array([math.cos(heading), math.sin(heading)])
            tail = StraightLane(begin, beyond, lane.width, lane.line_types, speed_limit=UNLIMITED)
            network.add_lane(node, node + "-beyond", tail)
        else:
            _replace(network, (origin, node, k), lane.start, lane.position(lane.length + distance, 0.0))


def _station(lane: AbstractLane, s: float) -> Station:
    return lane.position(s, 0.0), lane.heading_at(s)


def _near(station: Station, others: list[Station]) -> bool:
    """Whether one of ``others`` is at most one lane away and heads the same way."""
    (point, heading), reach = station, 1.5 * AbstractLane.DEFAULT_WIDTH
    return any(math.dist(point, at) < reach and math.cos(heading - way) > 0 for at, way in others)


def _replace(
    network: RoadNetwork, index: LaneIndex, start: NDArray[np.float64], end: NDArray[np.float64]
) -> None:
    lane = network.get_lane(index)
    network.graph[index[0]][index[1]][index[2]] = StraightLane(
        start, end, lane.width, lane.line_types, lane.forbidden, lane.speed_limit, lane.priority
    )


def successors(network: RoadNetwork) -> dict[LaneIndex, dict[str, LaneIndex]]:
    """For every lane, by next node: the lane that continues it there without a jump to the side."""
    table: dict[LaneIndex, dict[str, LaneIndex]] = {}
    for index, lane in network.lanes_dict().items():
        table[index] = {}
        end, heading = lane.position(lane.length, 0.0), lane.heading_at(lane.length)
        for node, candidates in network.graph.get(index[1], {}).items():
            aside = [abs(other.local_coordinates(end)[1]) for other in candidates]
            best = int(np.argmin(aside))
            if aside[best] < 1.0 and math.cos(candidates[best].heading_at(0.0) - heading) > 0:
                table[index][node] = (index[1], node, best)
    return table


def joint_speed(before: AbstractLane, after: AbstractLane) -> float:
    """Comfortable speed where ``after`` follows ``before``, m/s."""
    kink = math.cos(after.heading_at(0.0) - before.heading_at(before.length))
    return UNLIMITED if kink > math.cos(0.3) else KINK_SPEED


def world_lanes(network: RoadNetwork, path: NDArray[np.float64], radius: float) -> tuple[Lane, ...]:
    """Lanes of ``network`` within ``radius`` of ``path`` (``(M, 2)``, world frame), in the world frame."""
    near = cKDTree(path)
    lanes = []
    for lane in network.lanes_list():
        stations = np.linspace(0.0, lane.length, max(2, round(lane.length / 2.0) + 1))
        points = np.array([lane.position(s, 0.0) for s in stations]) * (1.0, -1.0)
        inside = np.flatnonzero(near.query(points, distance_upper_bound=radius)[0] < radius)
        if len(inside) < 2:
            continue
        span = slice(inside[0], inside[-1] + 1)
        headings = -np.unwrap([lane.heading_at(s) for s in stations[span]])
        left, right = (LINE_NAMES[kind] for kind in lane.line_types)
        lanes.append(Lane(points[span], headings, float(lane.width_at(0.0)), left, right))
    return tuple(lanes)
