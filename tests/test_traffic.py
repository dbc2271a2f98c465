import hashlib
import math
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from nl_env.config import SCENARIOS
from nl_env.scene.traffic import Traffic, simulate
from nl_env.scene.traffic.pedestrians import crossing_is_free
from nl_env.scene.traffic.signals import StopLine, TrafficLight, Yield
from nl_env.scene.traffic.simulation import without_collisions
from nl_env.scene.traffic.trajectories import KNOT_US, Tracks, overlaps, rectangle_distance

URBAN = ("intersection", "roundabout", "u-turn", "two-way")
SECONDS = 6.0
SEEDS = (1, 2, 3)
SEQUENCES = [(scenario, seed) for scenario in SCENARIOS for seed in SEEDS]


@cache
def traffic(scenario: str, seed: int, seconds: float = SECONDS) -> Traffic:
    return simulate(scenario, seed, seconds)


def digest(scene: Traffic) -> str:
    parts = [scene.ego_path()] + [lane.points for lane in scene.lanes]
    parts += [scene.actor_states(t) for t in range(0, scene.duration_us, 500_000)]
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


def ego_motion(scene: Traffic, step_us: int) -> np.ndarray:
    """Columns x, y, heading, speed, acceleration, yaw rate."""
    motions = [scene.ego(t) for t in range(0, scene.duration_us + 1, step_us)]
    return np.array([(m.x, m.y, m.heading, m.speed, m.acceleration, m.yaw_rate) for m in motions])


# ---------------------------------------------------------------- geometry and splines


def test_rectangle_distance_of_known_arrangements():
    size = np.array([4.0, 2.0])

    def distance(x, y, heading):
        return rectangle_distance(np.zeros(3), size, np.array([x, y, heading]), size)

    assert distance(10.0, 0.0, 0.0) == pytest.approx(6.0)
    assert distance(0.0, 5.0, 0.0) == pytest.approx(3.0)
    assert distance(7.0, 6.0, 0.0) == pytest.approx(5.0)
    assert distance(6.0, 0.0, math.pi / 2) == pytest.approx(3.0)
    assert distance(0.0, 0.0, math.pi / 2) == 0.0  # a cross: no corner lies inside the other
    assert distance(3.9, 1.9, 0.0) == 0.0


def test_overlaps_finds_the_one_meeting():
    poses = np.zeros((11, 3, 3))
    poses[:, 0, 0] = np.linspace(-20, 20, 11)
    poses[:, 2, 1] = 3.0
    met = overlaps(poses, np.array([(4.0, 2.0)] * 3))
    assert met.tolist() == [[False, True, False], [True, False, False], [False, False, False]]


def test_splines_reproduce_a_parabola_and_are_exactly_still_at_rest():
    time = (np.arange(40) - 1) * KNOT_US / 1e6
    step = KNOT_US / 1e6
    knots = np.zeros((40, 2, 3))
    knots[:, 0] = np.column_stack((3.0 * time, 1.5 * time**2, 0.2 * time))
    knots[:, 1] = (7.3, -1.1, 0.4)
    for t_us in (0, 61_234, 1_000_001):
        poses, rates, accelerations = Tracks(knots).at(t_us)
        t = t_us / 1e6
        np.testing.assert_allclose(poses[0], (3.0 * t, 1.5 * t * t + 1.5 * step**2 / 3, 0.2 * t), atol=1e-12)
        np.testing.assert_allclose(rates[0], (3.0, 3.0 * t, 0.2), atol=1e-9)
        np.testing.assert_allclose(accelerations[0], (0.0, 3.0, 0.0), atol=1e-9)
        assert poses[1].tolist() == [7.3, -1.1, 0.4]
        assert not rates[1].any() and not accelerations[1].any()


def test_colliding_vehicles_are_left_out_but_never_the_ego():
    places = np.array([(0.0, 0.0), (3.0, 0.0), (20.0, 0.0), (24.0, 0.0), (28.0, 0.0), (60.0, 0.0)])
    poses = np.column_stack((places, np.zeros(6)))[None]
    assert without_collisions(poses, np.array([(4.5, 2.0)] * 6)) == [0, 2, 4, 5]


def test_crossing_is_free_unless_a_vehicle_comes_within_the_look_ahead():
    walk = np.zeros((16, 2))
    vehicles = np.zeros((160, 1, 3))
    vehicles[:, 0, 0] = np.arange(160) - 80.0  # 16 m/s, passes the pedestrian's place at knot 80
    size, ahead = np.array([(4.0, 2.0)]), 32
    free = [crossing_is_free(walk, first, vehicles, size, ahead, 1.0) for first in range(140)]
    assert np.flatnonzero(np.logical_not(free)).tolist() == list(range(80 - 2 - 15 - ahead, 83))


# ---------------------------------------------------------------- signals


class Vehicle:
    def __init__(self, speed: float, distance: float) -> None:
        self.speed, self.distance = speed, distance

    def distance_to(self, line: StopLine) -> float:
        return self.distance


def test_light_turns_red_for_the_approaching_ego_and_never_opens_two_phases():
    lines = [StopLine((f"o{k}", f"ir{k}", 0), 90.0) for k in range(3)]
    light = TrafficLight([[line] for line in lines], red=9.0)
    light.update(0.0, Vehicle(10.0, 200.0), ())
    assert [line.closed for line in lines] == [False, True, True]
    opened = [set() for _ in lines]
    for time in np.arange(1.0, 12.0, 0.1):
        light.update(time, Vehicle(10.0, 20.0), ())
        assert sum(not line.closed for line in lines) <= 1
        for line, times in zip(lines, opened, strict=True):
            if not line.closed:
                times.add(round(float(time), 1))
    assert min(opened[0]) == pytest.approx(10.0, abs=0.11)
    assert opened[1] and opened[2] and max(opened[1]) + 1.9 < min(opened[2])


def test_roundabout_entry_is_closed_while_somebody_is_about_to_pass():
    line, conflict = StopLine(("ses", "se", 0), 15.0), StopLine(("sx", "se", 1), 10.0)
    rule = Yield(line, conflict)
    for distance, closed in ((5.0, True), (60.0, False), (math.inf, False)):
        rule.update(0.0, Vehicle(0.0, math.inf), [Vehicle(6.0, distance)])
        assert line.closed == closed


# ---------------------------------------------------------------- sequences


def test_fresh_process_gives_the_same_bytes():
    code = (
        "from tests.test_traffic import digest, traffic;"
        "print(*(digest(traffic(s, 1)) for s in ('exit', 'intersection', 'roundabout')))"
    )
    found = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        check=True,
    )
    assert found.stdout.split() == [digest(traffic(s, 1)) for s in ("exit", "intersection", "roundabout")]
    assert found.stderr == ""


def test_earlier_sequences_do_not_matter():
    simulate("intersection", 9, 1.0)
    assert digest(simulate("roundabout", 2, SECONDS)) == digest(traffic("roundabout", 2))


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_seeds_differ(scenario):
    speeds = [ego_motion(traffic(scenario, seed), 100_000)[0, 3] for seed in SEEDS]
    assert len({digest(traffic(scenario, seed)) for seed in SEEDS}) == len(SEEDS)
    assert max(speeds) - min(speeds) > 0.5


@pytest.mark.parametrize(("scenario", "seed"), SEQUENCES)
def test_nobody_touches_anybody(scenario, seed):
    scene = traffic(scenario, seed)
    instants = np.arange(0, scene.duration_us + 1, 20_000)
    poses = np.concatenate((scene.ego_track.sample(instants), scene.actor_tracks.sample(instants)), axis=1)
    sizes = np.array([scene.ego_size, *((actor.length, actor.width) for actor in scene.actors)])
    assert not overlaps(poses, sizes).any()


@pytest.mark.parametrize(("scenario", "seed"), SEQUENCES)
def test_ego_moves_like_a_car_and_stays_on_its_road(scenario, seed):
    scene = traffic(scenario, seed)
    x, y, heading, speed, acceleration, yaw_rate = ego_motion(scene, 5_000).T
    assert np.all(np.hypot(np.diff(x), np.diff(y)) <= np.maximum(speed[1:], speed[:-1]) * 0.005 * 1.05 + 1e-9)
    assert np.all(np.abs(np.diff(heading)) < 0.01)
    assert np.abs(speed * yaw_rate).max() < 6.0
    assert acceleration.min() > -3.8
    np.testing.assert_allclose(np.diff(speed), acceleration[1:] * 0.005, atol=2e-3)
    moving = speed > 2.0
    course = np.arctan2(np.diff(y), np.diff(x))[moving[1:]]
    assert np.cos(course - heading[1:][moving[1:]]).min() > 0.8
    centre_lines = np.concatenate([lane.points for lane in scene.lanes])
    away = np.hypot(x[::20, None] - centre_lines[:, 0], y[::20, None] - centre_lines[:, 1]).min(axis=1)
    assert away.max() < 2.4  # half a lane, and half of 2 m between the points


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_world_is_right_handed_and_traffic_keeps_right(scenario):
    """Along the outermost lane the painted edge lies to the right, and nothing is driven on beyond it."""
    scene = traffic(scenario, 1)
    for lane in scene.lanes:
        along = np.arctan2(*np.diff(lane.points, axis=0).T[::-1])
        assert np.cos(along - lane.headings[:-1]).min() > 0.9
    lane = next(lane for lane in scene.lanes if lane.right == "solid" and lane.left != "solid")
    middle = len(lane.points) // 2
    heading = lane.headings[middle]
    right = np.array((math.sin(heading), -math.cos(heading)))
    beyond = lane.points[middle] + lane.width * right
    same_way = [other for other in scene.lanes if other is not lane]
    gaps = [np.hypot(*(other.points - beyond).T).min() for other in same_way if len(other.points) > 20]
    assert min(gaps, default=math.inf) > 1.5


def test_two_way_traffic_passes_on_the_left():
    scene = traffic("two-way", 1)
    ego = scene.ego(0)
    states = scene.actor_states(0)
    vehicles = np.array([actor.kind != "pedestrian" for actor in scene.actors])
    oncoming = states[vehicles & (np.cos(states[:, 2] - ego.heading) < -0.9)]
    left = np.array((-math.sin(ego.heading), math.cos(ego.heading)))
    assert len(oncoming) >= 3
    np.testing.assert_allclose((oncoming[:, :2] - (ego.x, ego.y)) @ left, 4.0, atol=0.5)


def test_city_traffic_stops_and_goes():
    stopped, moved_again = [], 0
    for scenario in URBAN:
        for seed in (11, 12):
            speed = ego_motion(traffic(scenario, seed, 20.0), 100_000)[:, 3]
            stopped.append(np.mean(speed < 2.8))
            halt = np.flatnonzero(speed < 0.05)
            moved_again += len(halt) > 10 and speed[: halt[0]].max() > 3 and speed[halt[-1] :].max() > 2
    assert 0.1 < np.mean(stopped) < 0.5
    assert moved_again >= 3


def test_highway_speeds():
    speeds = [ego_motion(traffic("highway", seed), 100_000)[:, 3] for seed in SEEDS]
    assert np.mean(np.concatenate(speeds) > 50 / 3.6) > 0.5
    assert max(speed.max() for speed in speeds) < 31.0


def test_pedestrians_walk_beside_the_road_and_cross_it():
    walking, crossed = 0, 0
    for scenario, seed in SEQUENCES:
        scene = traffic(scenario, seed)
        on_foot = [k for k, actor in enumerate(scene.actors) if actor.kind == "pedestrian"]
        assert len(on_foot) <= (12 if scenario in URBAN else 0)
        centre_lines = np.concatenate([lane.points for lane in scene.lanes])
        states = np.stack([scene.actor_states(t) for t in range(0, scene.duration_us, 200_000)])
        for k in on_foot:
            x, y, _, speed = states[:, k].T
            away = np.hypot(x[:, None] - centre_lines[:, 0], y[:, None] - centre_lines[:, 1]).min(axis=1)
            assert speed.max() < 1.9
            assert away.max() < 12.0
            walking += 0.75 < speed.max()
            crossed += away.min() < 1.5
    assert walking >= 5
    assert crossed >= 1


def test_shortest_distance_is_to_the_nearest_outline():
    scene = traffic("u-turn", 1)
    t = 2_000_000
    ego = scene.ego_track.at(t)[0, 0]
    each = [
        rectangle_distance(ego, np.array(scene.ego_size), pose, np.array((actor.length, actor.width)))
        for pose, actor in zip(scene.actor_tracks.at(t)[0], scene.actors, strict=True)
    ]
    assert scene.shortest_distance(t) == min(each) > 0


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("motorway", 1, 5.0), "scenario.*motorway.*roundabout"),
        (("highway", -1, 5.0), "seed.*-1"),
        (("highway", 1.5, 5.0), "seed.*1.5"),
        (("highway", 1, 0.0), "duration_s"),
        (("highway", 1, math.nan), "duration_s"),
    ],
)
def test_bad_arguments_are_named(arguments, named):
    with pytest.raises(ValueError, match=named):
        simulate(*arguments)


@pytest.mark.parametrize("t_us", [-1, int(SECONDS * 1e6) + 20_001])
def test_times_outside_the_sequence_are_refused(t_us):
    scene = traffic("highway", 1)
    for method in (scene.ego, scene.actor_states, scene.shortest_distance):
        with pytest.raises(ValueError, match="t_us"):
            method(t_us)
    scene.ego(scene.duration_us + 20_000)
