"""highway-env's IDM / MOBIL drivers, who look along their route, and the street they share."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator

import numpy as np
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle

from nl_env.scene.traffic.roads import UNLIMITED, joint_speed, successors
from nl_env.scene.traffic.signals import LaneIndex, Signal, StopLine
from nl_env.scene.traffic.trajectories import KNOT_US

STEP = KNOT_US / 1e6

SLIP_RATE = 0.8
"""How fast the steering wheel turns: change of the angle between heading and velocity, rad/s."""

FIRM_BRAKING = 3.0
"""A driver who would have to brake harder than this for a closing stop line drives on, m/s^2."""

Turns = dict[str, str]
"""A route: the node that follows a node where the network leaves a choice."""


class Driver(IDMVehicle):
    """A vehicle driven by IDM (speed) and MOBIL (lane changes) along a route.

    The models are highway-env's. Its parameters are set here and not inherited, because its environments
    overwrite those of ``IDMVehicle``. Gaps are measured along the route and bumper to bumper, so that leaders
    around the corner count. Steering is pure pursuit, smooth at 3 m/s^2; highway-env's own controller changes
    lanes at a lateral acceleration of 30 m/s^2.
    """

    ACC_MAX = 3.5
    COMFORT_ACC_MAX = 2.0
    COMFORT_ACC_MIN = -2.5
    DISTANCE_WANTED = 2.5
    TIME_WANTED = 1.2
    LANE_CHANGE_MIN_ACC_GAIN = 0.3

    road: Street

    def __init__(
        self,
        street: Street,
        lane: LaneIndex,
        position: float,
        cruise: float,
        turns: Turns,
        size: tuple[float, float],
        changes_lanes: bool,
    ) -> None:
        """Put a vehicle of ``size`` (length, width) on ``lane`` at its cruising speed ``cruise``."""
        on = street.network.get_lane(lane)
        super().__init__(
            street,
            on.position(position, 0.0),
            on.heading_at(position),
            min(cruise, on.speed_limit),
            enable_lane_change=changes_lanes,
        )
        self.lane, self.lane_index, self.target_lane_index = on, lane, lane
        self.LENGTH, self.WIDTH = size
        self.cruise = cruise
        self.turns = turns
        self.slip = 0.0
        self._located: dict[LaneIndex, tuple[float, float]] = {}
        self.ahead: list[tuple[LaneIndex, float]] = []
        """The lanes ahead, each with the distance from the vehicle's centre to its start."""

    def look_ahead(self) -> None:
        """Update :attr:`ahead` after a move."""
        self._located.clear()
        station = self.locate(self.target_lane_index)[0]
        reach = 20.0 + 4.0 * self.speed
        self.ahead = list(self.road.lanes_ahead(self.target_lane_index, station, self.turns, reach))

    def locate(self, lane: LaneIndex) -> tuple[float, float]:
        """Metres along ``lane`` and to the right of its centre line."""
        if lane not in self._located:
            self._located[lane] = self.road.network.get_lane(lane).local_coordinates(self.position)
        return self._located[lane]

    def distance_to(self, line: StopLine) -> float:
        """Metres along the route from the front bumper to ``line``; ``inf`` if it is not ahead."""
        for lane, start in self.ahead:
            if lane == line.lane:
                distance = start + line.position - self.LENGTH / 2
                return distance if distance > 0 else math.inf
        return math.inf

    def lane_distance_to(self, other: Driver, lane: object = None) -> float:
        """Metres along the route from the front bumper to the rear bumper of ``other``."""
        distance = self.front_distance_to(other)
        for index, start in self.ahead:
            if index[:2] == other.lane_index[:2]:
                distance = start + other.locate(other.lane_index)[0]
                break
        return float(distance - (self.LENGTH + other.LENGTH) / 2)

    def act(self, action: object = None) -> None:
        """Choose lane (MOBIL), steering and acceleration (IDM, with respect to leaders and stop lines)."""
        self.target_speed = self.safe_speed()
        self.follow_road()
        if self.enable_lane_change:
            planned = self.road.lane_to_reach(self.target_lane_index, self.turns)
            self.route = None if planned is None else [planned]  # MOBIL changes lanes only towards it
            self.change_lane_policy()
        leaders = [self.road.neighbour_vehicles(self, self.lane_index)[0]]
        if self.lane_index != self.target_lane_index:
            leaders.append(self.road.neighbour_vehicles(self, self.target_lane_index)[0])
        acceleration = min(self.acceleration(self, leader) for leader in leaders)
        for lane, _ in self.ahead:
            for line in self.road.stop_lines.get(lane, ()):
                gap = self.distance_to(line)
                if line.closed and self.speed**2 / (2 * FIRM_BRAKING) < gap < math.inf:
                    acceleration = min(acceleration, self.idm(gap + 1.5, self.speed))
        if self.speed < 0.3 and acceleration < 0.3:
            acceleration = -self.speed / STEP  # stand still; IDM alone would creep up for ever
        self.action = {
            "steering": self.steering_control(self.target_lane_index),
            "acceleration": max(acceleration, -self.ACC_MAX, -self.speed / STEP),
        }

    def safe_speed(self) -> float:
        """Cruising speed, or less if a curve is coming, m/s."""
        speed = self.cruise * self.road.pace
        previous = None
        for lane, start in self.ahead:
            limit = self.road.speed_limit(previous, lane)
            speed = min(speed, math.sqrt(limit**2 + 2 * 1.8 * max(start - 2.5, 0.0)))
            previous = lane
        return speed

    def acceleration(
        self, ego_vehicle: Driver | None, front_vehicle: Driver | None = None, rear_vehicle: object = None
    ) -> float:
        """IDM acceleration of ``ego_vehicle`` behind ``front_vehicle``, m/s^2."""
        if ego_vehicle is None:
            return 0.0
        if front_vehicle is None:
            return ego_vehicle.idm(math.inf, 0.0)
        along = math.cos(front_vehicle.heading - ego_vehicle.heading)
        closing = ego_vehicle.speed - front_vehicle.speed * along
        return ego_vehicle.idm(ego_vehicle.lane_distance_to(front_vehicle), closing)

    def idm(self, gap: float, closing: float) -> float:
        """Intelligent Driver Model: acceleration for a ``gap`` (m) that shrinks at ``closing`` (m/s)."""
        a, b = self.COMFORT_ACC_MAX, -self.COMFORT_ACC_MIN
        wanted = self.speed * (self.TIME_WANTED + closing / (2 * math.sqrt(a * b)))
        wanted = self.DISTANCE_WANTED + max(wanted, 0.0)
        free = (self.speed / max(self.target_speed, 0.1)) ** self.DELTA
        return float(a * (1 - free - (wanted / max(gap, 0.1)) ** 2))

    def steering_control(self, target_lane_index: LaneIndex) -> float:
        """Steering angle (rad) towards a point 0.8 s ahead, at most 1 m beside the present track."""
        reach = max(4.0, 0.8 * self.speed)
        aim, start = self.ahead[0]
        aside = self.locate(aim)[1]
        aside -= min(max(aside, -1.0), 1.0)
        for lane, offset in self.ahead[1:]:
            if offset < reach:
                aim, start, aside = lane, offset, 0.0
        dx, dy = self.road.network.get_lane(aim).position(reach - start, aside) - self.position
        bearing = math.atan2(dy, dx) - self.heading - self.slip
        slip = math.asin(min(max(self.LENGTH * math.sin(bearing) / math.hypot(dx, dy), -0.6), 0.6))
        self.slip += min(max(slip - self.slip, -SLIP_RATE * STEP), SLIP_RATE * STEP)
        return math.atan(2 * math.tan(self.slip))

    def follow_road(self) -> None:
        """Near the end of a lane, aim at the next one of the route."""
        lane = self.road.network.get_lane(self.target_lane_index)
        if lane.after_end(self.position, *self.locate(self.target_lane_index)):
            following = self.road.next_lane(self.target_lane_index, self.turns)
            self.target_lane_index = following or self.target_lane_index

    def on_state_update(self) -> None:
        """Note which lane is driven on: the same as before, or the one aimed at."""
        if self.lane_index != self.target_lane_index:
            target = self.road.network.get_lane(self.target_lane_index)
            if target.distance(self.position) < self.lane.distance(self.position):
                self.lane, self.lane_index = target, self.target_lane_index


class Street(Road):
    """A highway-env road with signals, on which vehicles are looked up by lane.

    Attributes:
        pace: factor on everybody's cruising speed; below 1 while traffic is slowed down.
        time: s.
    """

    vehicles: list[Driver]

    def __init__(self, network: RoadNetwork) -> None:
        super().__init__(network, np_random=np.random.default_rng(0))  # its drivers draw nothing
        self.time = 0.0
        self.pace = 1.0
        self.signals: list[Signal] = []
        self.stop_lines: dict[LaneIndex, list[StopLine]] = defaultdict(list)
        self._successors = successors(network)
        self._predecessors: dict[LaneIndex, list[LaneIndex]] = defaultdict(list)
        for lane, following in self._successors.items():
            for other in following.values():
                self._predecessors[other].append(lane)
        self._occupants: dict[LaneIndex, list[tuple[float, int, Driver]]] = {}
        self._limits: dict[tuple[LaneIndex | None, LaneIndex], float] = {}

    def install(self, signal: Signal) -> None:
        """Put up ``signal`` and its stop lines."""
        self.signals.append(signal)
        for line in signal.lines:
            self.stop_lines[line.lane].append(line)

    def next_lane(self, lane: LaneIndex, turns: Turns) -> LaneIndex | None:
        """The lane that follows ``lane`` on a route, None at a dead end."""
        following = self._successors[lane]
        return following.get(turns.get(lane[1], "")) or next(iter(following.values()), None)

    def lane_to_reach(self, lane: LaneIndex, turns: Turns) -> LaneIndex | None:
        """The nearest lane beside ``lane``, or itself, on which the route goes on; None if it does on all."""
        origin, node, k = lane
        wanted = turns.get(node)
        onward = [self._successors[origin, node, j] for j in range(len(self.network.graph[origin][node]))]
        open_lanes = [j for j, exits in enumerate(onward) if (wanted in exits if wanted else exits)]
        if len(open_lanes) in (0, len(onward)):
            return None
        return origin, node, min(open_lanes, key=lambda j: abs(j - k))

    def lanes_ahead(
        self, lane: LaneIndex, station: float, turns: Turns, reach: float
    ) -> Iterator[tuple[LaneIndex, float]]:
        """The lanes of a route up to ``reach`` metres from ``station`` on ``lane``, and where each starts."""
        start = -station
        following: LaneIndex | None = lane
        while following is not None and start < reach:
            yield following, start
            start += self.network.get_lane(following).length
            following = self.next_lane(following, turns)

    def speed_limit(self, previous: LaneIndex | None, lane: LaneIndex) -> float:
        """Comfortable speed at the start of ``lane`` coming from ``previous``, m/s."""
        key = previous, lane
        if key not in self._limits:
            on = self.network.get_lane(lane)
            joint = joint_speed(self.network.get_lane(previous), on) if previous else UNLIMITED
            self._limits[key] = min(on.speed_limit, joint)
        return self._limits[key]

    def act(self) -> None:
        """Update who is where and the signals, then let every driver decide."""
        occupants: dict[LaneIndex, list[tuple[float, int, Driver]]] = defaultdict(list)
        for k, vehicle in enumerate(self.vehicles):
            vehicle.look_ahead()
            for lane in dict.fromkeys((vehicle.lane_index, vehicle.target_lane_index)):
                occupants[lane].append((vehicle.locate(lane)[0], k, vehicle))
        self._occupants = {lane: sorted(found) for lane, found in occupants.items()}
        for signal in self.signals:
            signal.update(self.time, self.vehicles[0], self.vehicles)
        super().act()

    def step(self, dt: float) -> None:
        """Move every vehicle; collisions are looked for in the finished trajectories."""
        for vehicle in self.vehicles:
            vehicle.step(dt)
        self.time += dt

    def neighbour_vehicles(
        self, vehicle: Driver, lane_index: LaneIndex | None = None
    ) -> tuple[Driver | None, Driver | None]:
        """Leader and follower of ``vehicle`` on a lane, or else on the lanes that its route goes on to."""
        lane_index = lane_index or vehicle.lane_index
        station = vehicle.locate(lane_index)[0]
        leader = follower = None
        for lane, start in self.lanes_ahead(lane_index, station, vehicle.turns, 20.0 + 4.0 * vehicle.speed):
            for position, _, other in self._occupants.get(lane, ()):
                if other is vehicle:
                    continue
                if start + position <= 0:
                    follower = other
                elif leader is None:
                    leader = other
            if leader is not None:
                break
        if follower is None:
            before = [self._occupants.get(lane, []) for lane in self._predecessors[lane_index]]
            behind = [found for occupants in before for found in occupants if found[2] is not vehicle]
            follower = max(behind)[2] if behind else None
        return leader, follower
