"""The seven scenarios: on which road, where to, among whom and past which signals the ego drives."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from highway_env.envs.exit_env import ExitEnv
from highway_env.envs.highway_env import HighwayEnv
from highway_env.envs.intersection_env import IntersectionEnv
from highway_env.envs.merge_env import MergeGenericEnv
from highway_env.envs.roundabout_env import RoundaboutGenericEnv
from highway_env.envs.two_way_env import TwoWayEnv
from highway_env.envs.u_turn_env import UTurnEnv
from highway_env.road.lane import StraightLane

from nl_env.scene.traffic.drivers import Street, Turns
from nl_env.scene.traffic.roads import build, lengthen
from nl_env.scene.traffic.signals import DeadEnd, LaneIndex, StopLine, TrafficLight, Yield
from nl_env.scene.traffic.trajectories import Crossing

MARGIN = 260.0
"""Metres of road behind the ego's start and beyond where it can get to."""

SETBACK = 3.0
"""Metres between a stop line and the middle of the crossing behind it."""


@dataclass(frozen=True)
class Flow:
    """``count`` vehicles spread over ``[begin, end]`` metres of ``lane``, each with one of the ``routes``."""

    lane: LaneIndex
    begin: float
    end: float
    count: int
    routes: Sequence[Turns] = ({},)


@dataclass
class Layout:
    """A street and what is going to happen on it.

    Attributes:
        street: the road, with its signals.
        lane, position: where the ego is at time 0, position in metres along the lane.
        turns: the ego's route.
        flows: the other vehicles at time 0.
        changes_lanes: whether drivers may overtake.
        crossings: where pedestrians cross at a light.
    """

    street: Street
    lane: LaneIndex
    position: float
    turns: Turns
    flows: list[Flow]
    changes_lanes: bool = False
    crossings: list[Crossing] = field(default_factory=list)


def red_time(rng: np.random.Generator) -> float:
    """How long a light that the ego meets stays red, s; one in six does not turn red."""
    return float(rng.uniform(6.0, 11.0)) if rng.random() < 5 / 6 else 0.0


def add_crossings(
    layout: Layout, rng: np.random.Generator, cruise: float, duration: float, first: float
) -> None:
    """Put pedestrian lights on the ego's route, the first one after ``first`` metres."""
    distance = first
    while distance < cruise * duration:
        crossing = _crossing_at(layout, distance)
        if crossing is None:
            distance += 5.0
            continue
        lines, place = crossing
        layout.street.install(TrafficLight([lines], red_time(rng)))
        layout.crossings.append(place)
        distance += cruise * rng.uniform(9.0, 16.0)


def _crossing_at(layout: Layout, distance: float) -> tuple[list[StopLine], Crossing] | None:
    """Stop lines, the ego's first, and place of a crossing on the ego's route, where the road is straight."""
    street = layout.street
    ahead = street.lanes_ahead(layout.lane, layout.position, layout.turns, distance)
    index, start = list(ahead)[-1]
    lane, station = street.network.get_lane(index), distance - start
    if not isinstance(lane, StraightLane) or not 15.0 < station < lane.length - 15.0:
        return None
    x, y = lane.position(station, 0.0)
    lines = [StopLine(index, station - SETBACK)]
    for other_index, other in street.network.lanes_dict().items():
        along, aside = other.local_coordinates(np.array([x, y]))
        parallel = abs(math.sin(other.heading_at(along) - lane.heading)) < 0.1
        if other_index != index and parallel and abs(aside) < 12.0 and SETBACK < along < other.length:
            lines.append(StopLine(other_index, along - SETBACK))
    return lines, Crossing(float(x), -float(y), -float(lane.heading))


def highway(rng: np.random.Generator, cruise: float, duration: float) -> Layout:
    """Two to four straight lanes in one direction."""
    lanes = int(rng.integers(2, 5))
    network = build(HighwayEnv._create_road, {"lanes_count": lanes})
    for lane in network.lanes_list():
        lane.end = lane.start + (2 * MARGIN + 1.2 * cruise * duration) * lane.direction
        lane.length = float(np.linalg.norm(lane.end - lane.start))
    flows = [Flow(("0", "1", k), MARGIN - 70.0, MARGIN + 150.0, math.ceil(9 / lanes)) for k in range(lanes)]
    ego_lane = ("0", "1", int(rng.integers(lanes)))
    return Layout(Street(network), ego_lane, MARGIN, {}, flows, changes_lanes=True)


def merge(rng: np.random.Generator, cruise: float, duration: float) -> Layout:
    """A two-lane highway and a ramp joining it; the ego is on either."""
    config = {
        "lanes_count": 2,
        "before_merge_length": 150,
        "converge_merge_length": 80,
        "parallel_merge_length": 180,
        "after_merge_length": 150,
    }
    network = build(MergeGenericEnv._make_road, config)
    lengthen(network, MARGIN + 1.2 * cruise * duration)
    main, ramp = network.graph["a"]["b"][0].length, network.graph["j"]["k"][0].length
    to_merge = cruise * rng.uniform(2.0, 6.0)  # metres to where the ramp bends towards the highway
    begin = main - 80.0 - to_merge
    flows = [Flow(("a", "b", k), begin - 70.0, begin + 150.0, 4) for k in range(2)]
    flows.append(Flow(("j", "k", 0), ramp - to_merge - 60.0, ramp - to_merge + 60.0, 3))
    street = Street(network)
    parallel = network.graph["b"]["c"][2]
    street.install(DeadEnd(StopLine(("b", "c", 2), parallel.length - 2.0)))
    on_ramp = rng.random() < 0.4
    lane, position = (("j", "k", 0), ramp - to_merge) if on_ramp else (("a", "b", 1), begin)
    return Layout(street, lane, position, {}, flows, changes_lanes=True)


def exit_(rng: np.random.Generator, cruise: float, duration: float) -> Layout:
    """A three-lane highway with an exit, which the ego mostly takes."""
    config = {"lanes_count": 3}
    network = build(ExitEnv._create_road, config, road_length=1000, exit_position=400, exit_length=200)
    lengthen(network, MARGIN + 1.2 * cruise * duration)
    before = network.graph["0"]["1"][0].length
    position = before - cruise * rng.uniform(2.0, 7.0)
    leave, stay = {"2": "exit"}, {"2": "3"}
    flows = [Flow(("0", "1", k), position - 70.0, position + 150.0, 3, (stay,)) for k in range(2)]
    flows.append(Flow(("0", "1", 2), position - 60.0, position + 150.0, 4, (leave, stay)))
    leaves = rng.random() < 0.7
    lane = ("0", "1", 2 if leaves else int(rng.integers(3)))
    return Layout(Street(network), lane, position, leave if leaves else stay, flows, changes_lanes=True)


def intersection(rng: np.random.Generator, cruise: float, duration: float) -> Layout:
    """A four-way intersection with lights; the ego turns left, right or goes straight.

    The ego's arm and the opposite one are green together, unless somebody may turn left; left turns exist
    only from the ego's arm.
    """
    network = build(IntersectionEnv._make_road, {})
    lengthen(network, MARGIN + cruise * duration)
    street = Street(network)
    length = network.graph["o0"]["ir0"][0].length
    lines = [StopLine((f"o{k}", f"ir{k}", 0), length - 4.0) for k in range(4)]
    left, straight, right = {"ir0": "il1"}, {"ir0": "il2"}, {"ir0": "il3"}
    turns = (left, straight, right)[rng.choice(3, p=(0.3, 0.4, 0.3))]
    if turns is left:
        phases, mine = [[lines[0]], [lines[1], lines[3]], [lines[2]]], [left, straight, right]
    else:
        phases, mine = [[lines[0], lines[2]], [lines[1], lines[3]]], [straight, right]
    street.install(TrafficLight(phases, red_time(rng)))
    to_line = cruise * rng.uniform(3.5, 8.0)
    position = length - to_line
    flows = [
        Flow(("o0", "ir0", 0), position + 12.0, length - 20.0, 2, mine),
        Flow(("o0", "ir0", 0), position - 60.0, position - 12.0, int(rng.integers(2)), mine),
    ]
    for arm in (1, 2, 3):
        onward = ({f"ir{arm}": f"il{(arm + 2) % 4}"}, {f"ir{arm}": f"il{(arm - 1) % 4}"})
        flows.append(Flow((f"o{arm}", f"ir{arm}", 0), length - 90.0, length - 20.0, 3, onward))
        flows.append(Flow((f"il{arm}", f"o{arm}", 0), 5.0, 90.0, 1))
    layout = Layout(street, ("o0", "ir0", 0), position, turns, flows)
    add_crossings(layout, rng, cruise, duration, to_line + cruise * rng.uniform(5.0, 10.0))
    return layout


def roundabout(rng: np.random.Generator, cruise: float, duration: float) -> Layout:
    """A roundabout that is yielded to; the ego leaves it at any of the four arms."""
    radius = float(rng.uniform(16.0, 24.0))
    network = build(RoundaboutGenericEnv._make_road, {"roundabout_radius": radius, "roundabout_lanes": 2})
    lengthen(network, MARGIN + cruise * duration)
    street = Street(network)
    around = {"sx": "se", "ex": "ee", "nx": "ne", "wx": "we"}
    routes = [around | {f"{arm}x": f"{arm}xs"} for arm in "senw"]
    for arm in "senw":
        entry, before = (f"{arm}es", f"{arm}e", 0), (f"{arm}x", f"{arm}e", 1)
        conflict = StopLine(before, network.get_lane(before).length)
        street.install(Yield(StopLine(entry, network.get_lane(entry).length - 3.5), conflict))
    length = network.graph["ser"]["ses"][0].length
    position = length - cruise * rng.uniform(2.0, 6.0)
    flows = [
        Flow(("ser", "ses", 0), position + 12.0, length, 2, routes),
        Flow(("ser", "ses", 0), position - 50.0, position - 12.0, int(rng.integers(2)), routes),
    ]
    for arm in "enw":
        flows.append(Flow((f"{arm}er", f"{arm}es", 0), length - 60.0, length, 2, routes))
        flows.append(Flow((f"{arm}xs", f"{arm}xr", 0), 0.0, 60.0, 1))
    outer, inner = (("ne", "wx", 1), ("we", "sx", 1), ("ee", "nx", 1)), (("ee", "nx", 0), ("we", "sx", 0))
    flows += [Flow(lane, 2.0, 12.0, 1, routes) for lane in outer]
    flows += [Flow(lane, 2.0, 12.0, 1, (around,)) for lane in inner]
    layout = Layout(street, ("ser", "ses", 0), position, routes[int(rng.integers(4))], flows)
    add_crossings(layout, rng, cruise, duration, cruise * rng.uniform(1.5, 10.0))
    return layout


def u_turn(rng: np.random.Generator, cruise: float, duration: float) -> Layout:
    """A two-lane street that turns back on itself."""
    network = build(UTurnEnv._make_road, {}, length=128)
    lengthen(network, MARGIN + cruise * duration)
    length = network.graph["a"]["b"][0].length
    position = length - cruise * rng.uniform(3.0, 9.0)
    flows = []
    for k in range(2):
        flows.append(Flow(("a", "b", k), position + 12.0, length, 2))
        flows.append(Flow(("a", "b", k), position - 60.0, position - 12.0, 1))
        flows.append(Flow(("c", "d", k), 0.0, 100.0, 2))
    layout = Layout(Street(network), ("a", "b", int(rng.integers(2))), position, {}, flows)
    add_crossings(layout, rng, cruise, duration, cruise * rng.uniform(1.5, 5.0))
    return layout


def two_way(rng: np.random.Generator, cruise: float, duration: float) -> Layout:
    """A street with one lane in each direction."""
    length = 2 * MARGIN + 2 * cruise * duration
    network = build(TwoWayEnv._make_road, {}, length=length)
    oncoming = length - MARGIN  # metres along the opposite lane to where it passes the ego's start
    flows = [
        Flow(("a", "b", 1), MARGIN + 14.0, MARGIN + 90.0, 2),
        Flow(("a", "b", 1), MARGIN - 60.0, MARGIN - 12.0, int(rng.integers(2))),
        Flow(("b", "a", 0), oncoming - 2 * cruise * 20.0, oncoming, 6),
    ]
    layout = Layout(Street(network), ("a", "b", 1), MARGIN, {}, flows)
    add_crossings(layout, rng, cruise, duration, cruise * rng.uniform(3.0, 9.0))
    return layout


LAYOUTS: dict[str, Callable[[np.random.Generator, float, float], Layout]] = {
    "highway": highway,
    "intersection": intersection,
    "roundabout": roundabout,
    "merge": merge,
    "exit": exit_,
    "u-turn": u_turn,
    "two-way": two_way,
}
