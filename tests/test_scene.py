"""A drive as a whole: pose and twist, determinism, weather and depth, and what standing and speeding do."""

import hashlib
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from nl_env.config import DrivingConfig, EventCameraConfig, SceneConfig
from nl_env.depth.metrics import full_metrics, paper_metrics
from nl_env.depth.motion import se3_exp
from nl_env.scene import weather, world
from nl_env.scene.quads import Objects, empty_quads
from nl_env.scene.render import Renderer
from nl_env.scene.scene import DrivingScene, camera_pose
from nl_env.scene.traffic import simulate
from nl_env.sensors.event_camera import EventCamera
from nl_env.types import BINS, SLICE_US, TICK_US

CAMERA = DrivingConfig(resolution="quarter").camera
SHORT = SceneConfig(scenario="two-way", style="suburb", weather="ClearNoon", duration_s=3.0)


def make(config=SHORT, seed=11):
    return DrivingScene(config, CAMERA, seed)


def frame(scene, t):
    images = np.full((2, *CAMERA.shape), np.nan, np.float32)
    scene.render(t, *images)
    return images


@pytest.fixture(scope="module")
def scene():
    return make()


def test_camera_axes_are_right_down_forward():
    pose = camera_pose((1.0, 2.0, 3.0), heading=0.0, pitch=0.0, roll=0.0)
    np.testing.assert_allclose(pose[:3, 0], [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(pose[:3, 1], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(pose[:3, 2], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(pose[:, 3], [1, 2, 3, 1])
    north = camera_pose((0.0, 0.0, 0.0), heading=math.pi / 2, pitch=0.0, roll=0.0)
    np.testing.assert_allclose(north[:3, 2], [0, 1, 0], atol=1e-12)
    down = camera_pose((0.0, 0.0, 0.0), heading=0.0, pitch=0.3, roll=0.0)
    np.testing.assert_allclose(down[:3, 2], [math.cos(0.3), 0, -math.sin(0.3)], atol=1e-12)
    for angles in ((0.4, 0.2, -0.3), (-2.0, -0.1, 0.05)):
        rotation = camera_pose((0.0, 0.0, 0.0), *angles)[:3, :3]
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_camera_is_on_the_ego_and_looks_where_it_drives(scene):
    for t in (0, 1_234_567, 3_000_000):
        pose, ego = scene.pose(t), scene.traffic.ego(t)
        np.testing.assert_allclose(pose[:2, 3], [ego.x, ego.y], atol=1e-9)
        assert pose[2, 3] == pytest.approx(SHORT.camera_height, abs=0.05)
        heading = [math.cos(ego.heading), math.sin(ego.heading)]
        assert pose[:2, 2] @ heading > 0.999
        assert scene.speed(t) == ego.speed


def test_twist_is_the_rate_of_the_pose(scene):
    step = 2_000
    for t in (step, 1_000_000, 2_499_000):
        motion = np.linalg.inv(scene.pose(t - step)) @ scene.pose(t + step)
        moved = se3_exp(scene.twist(t) * 2 * step * 1e-6)
        np.testing.assert_allclose(moved[:3, 3], motion[:3, 3], atol=2e-5)
        np.testing.assert_allclose(moved[:3, :3], motion[:3, :3], atol=2e-6)
        assert scene.twist(t)[2] == pytest.approx(scene.speed(t), abs=0.05)  # forward, camera z


def test_a_rigid_rail_does_not_shake():
    still = make(SceneConfig(scenario="two-way", style="rural", vibration=0.0, duration_s=1.0))
    for t in (0, 400_000, 1_000_000):
        np.testing.assert_allclose(still.pose(t)[2], [0, -1, 0, still.pose(0)[2, 3]], atol=1e-12)


def digest(seed):
    """Hash of a short sequence's images, poses and description."""
    scene = make(SceneConfig(duration_s=1.0, weather="HardRainSunset"), seed)
    found = hashlib.sha256(repr(scene.describe()).encode())
    for t in (0, 505_000, 1_000_000):
        found.update(frame(scene, t).tobytes() + scene.pose(t).tobytes() + scene.twist(t).tobytes())
    return found.hexdigest()


def test_same_seed_same_bytes_in_a_fresh_process_with_two_threads():
    fresh = subprocess.run(
        [sys.executable, "-c", f"import {Path(__file__).stem} as tests; print(tests.digest(5))"],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parent,
        env={**os.environ, "NUMBA_NUM_THREADS": "2", "OMP_NUM_THREADS": "2"},
    )
    assert fresh.stdout.strip() == digest(5) != digest(6)


def test_an_instant_does_not_depend_on_what_was_rendered_before(scene):
    first = frame(scene, 700_000)
    frame(scene, 2_100_000)
    assert frame(scene, 700_000).tobytes() == first.tobytes()


@pytest.mark.parametrize("name", ["CloudySunset", "HardRainNoon"])
def test_weather_changes_light_and_never_depth(scene, name):
    other = make(SceneConfig(scenario="two-way", style="suburb", weather=name, duration_s=3.0))
    (clear, depth), (changed, same_depth) = frame(scene, 900_000), frame(other, 900_000)
    assert depth.tobytes() == same_depth.tobytes()
    assert changed.mean() < 0.95 * clear.mean()
    assert other.describe()["weather"] == name


def test_frames_are_finite_in_range_and_sky_has_no_depth(scene):
    intensity, depth = frame(scene, 1_000_000)
    assert intensity.min() >= np.float32(0.001) and intensity.max() <= 1
    assert depth.min() == 0.0 and depth.max() < 200.0
    assert (depth[0] == 0).any() and (depth[-1] > 0).all()


def test_actors_are_drawn_where_the_traffic_says():
    """The depth at the image of an actor's centre is at most its distance, and mostly its near side."""
    scene = make(SceneConfig(scenario="highway", style="rural", weather="ClearNoon", duration_s=3.0), seed=4)
    found = []
    for t in (0, 1_000_000, 2_000_000, 3_000_000):
        _, depth = frame(scene, t)
        pose = scene.pose(t)
        x, y, z = pose[:3, :3].T @ (scene.actor_centres(t)[:, :3] - pose[:3, 3]).T
        for right, down, ahead in zip(x, y, z, strict=True):
            if not 5 < ahead < 50:
                continue
            column = round(CAMERA.fx * right / ahead + CAMERA.cx)
            row = round(CAMERA.fy * down / ahead + CAMERA.cy)
            if 0 <= column < CAMERA.width and 0 <= row < CAMERA.height:
                assert 0 < depth[row, column] < ahead + 1.0
                found.append(depth[row, column] > ahead - 7.0)
    assert len(found) >= 4 and np.mean(found) > 0.5


def test_standing_still_gives_no_events_and_no_repeat_error():
    """The ego waits at its red light; what moves in front of it is masked."""
    scene = make(SceneConfig(scenario="intersection", style="downtown", weather="ClearNoon"), seed=0)
    start, end = 8_000_000, 8_200_000
    assert scene.speed(start) == scene.speed(end) == 0.0
    assert scene.pose(start).tobytes() == scene.pose(end).tobytes()
    still = np.ones(CAMERA.shape, bool)
    camera = EventCamera(EventCameraConfig.preset("ideal"), CAMERA.shape)
    intensity, prior = frame(scene, start)
    camera.reset(intensity, start, np.random.default_rng(0))
    touched = np.zeros(CAMERA.shape, bool)
    for t in range(start + TICK_US, end + 1, TICK_US):
        intensity, truth = frame(scene, t)
        events = camera.events(intensity, t)
        touched[events["y"], events["x"]] = True
        still &= ~actors_in_view(scene, t)
    assert 0.5 < still.mean() < 1.0
    assert not touched[still].any()
    truth = np.where(still, truth, prior)
    assert paper_metrics(prior, truth, 200.0).rmse == 0 == full_metrics(prior, truth, 200.0).log_mae


def actors_in_view(scene, t):
    """``(H, W)`` a rectangle around every moving actor's image, and around that of its motion blur."""
    mask = np.zeros(CAMERA.shape, bool)
    pose = scene.pose(t)
    states = scene.traffic.actor_states(t)
    for actor, state, centre in zip(scene.traffic.actors, states, scene.actor_centres(t), strict=True):
        radius = math.hypot(actor.length, actor.width, actor.height) / 2
        x, y, z = pose[:3, :3].T @ (centre[:3] - pose[:3, 3])
        if state[3] == 0.0 or z < -radius:
            continue
        if z < 2 * radius:
            mask[:] = True
            continue
        reach = CAMERA.fx * radius / (z - radius) + 2
        column, row = CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy
        rows = slice(max(math.floor(row - reach), 0), max(math.ceil(row + reach), 0))
        mask[rows, max(math.floor(column - reach), 0) : max(math.ceil(column + reach), 0)] = True
    return mask


def test_doubling_the_speed_about_doubles_the_events():
    """Events count contrast passed on the way, so twice the way in the same time gives twice the events."""
    drive = simulate("two-way", 11, 3.0)
    light = weather.preset("ClearNoon")
    built = world.build(drive, "suburb", light, CAMERA.fx, np.random.default_rng(0))
    renderer = Renderer(CAMERA, (built.quads, built.objects), built.ground, light.light(), 0, 0)
    no_actors = Objects(
        np.zeros((3, 0), np.float32), np.zeros(0, np.float32), np.zeros(0, np.int32), np.zeros(0, np.int32)
    )
    ego = drive.ego(0)
    counts = []
    for speed in (0.0, 4.0, 8.0):
        camera = EventCamera(EventCameraConfig.preset("ideal"), CAMERA.shape)
        bins, count = np.zeros((BINS, *CAMERA.shape), np.int16), 0
        for tick in range(11):
            t = tick * TICK_US
            way = speed * t * 1e-6
            x, y = ego.x + way * math.cos(ego.heading), ego.y + way * math.sin(ego.heading)
            intensity = np.zeros(CAMERA.shape, np.float32)
            pose = camera_pose((x, y, 2.4), ego.heading, 0.0, 0.0)
            renderer.render(pose, (empty_quads().packed(), no_actors), intensity, None)
            if tick == 0:
                camera.reset(intensity, 0, np.random.default_rng(0))
            else:
                count += camera.accumulate(intensity, t, bins, (t - TICK_US) // SLICE_US * SLICE_US)
        counts.append(count)
    standing, slow, fast = counts
    assert standing == 0 < slow
    assert 1.6 < fast / slow < 2.4
