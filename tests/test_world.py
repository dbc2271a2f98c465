"""Worlds of every scenario and style build and render and leave the road free; weather does what it says."""

from functools import lru_cache

import numpy as np
import pytest
from scipy.spatial import cKDTree

from nl_env.config import SCENARIOS, STYLES, WEATHERS, DrivingConfig
from nl_env.scene import weather, world
from nl_env.scene.quads import Objects, empty_quads
from nl_env.scene.rain import Rain
from nl_env.scene.render import Renderer
from nl_env.scene.scene import camera_pose
from nl_env.scene.traffic import simulate

CAMERA = DrivingConfig(resolution="quarter").camera
NOTHING = Objects(
    np.zeros((3, 0), np.float32), np.zeros(0, np.float32), np.zeros(0, np.int32), np.zeros(0, np.int32)
)
SHIN, ROOF = 0.2, 2.4
"""Heights between which something stands in a vehicle's way, m."""


@lru_cache
def traffic(scenario):
    return simulate(scenario, 3, 3.0)


def build(scenario, style, name="ClearNoon", seed=0, camera=CAMERA):
    rng = np.random.default_rng(seed)
    return world.build(traffic(scenario), style, weather.preset(name), camera.fx, rng)


def surface_points(quads):
    """``(3, N)`` points on every parallelogram: corners, middles of the edges, centre."""
    return np.concatenate(
        [quads.origin + s * quads.u + t * quads.v for s in (0, 0.5, 1) for t in (0, 0.5, 1)], axis=1
    )


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_every_style_builds_renders_and_leaves_the_way_free(scenario):
    drive = traffic(scenario)
    path = drive.ego_path()
    metres = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]
    dense = np.arange(0.0, metres[-1], 0.25)
    way = cKDTree(np.stack([np.interp(dense, metres, path[:, i]) for i in (0, 1)], axis=1))
    for style in STYLES:
        built = build(scenario, style)
        x, y, z = surface_points(built.quads)
        tall = (z > SHIN) & (z < ROOF)
        nearest, _ = way.query(np.stack([x[tall], y[tall]], axis=1))
        assert nearest.min() > drive.ego_size[1] / 2, f"{style}: something stands in the ego's way"

        renderer = Renderer(
            CAMERA, (built.quads, built.objects), built.ground, weather.preset("ClearNoon").light(), 0, 0
        )
        intensity, depth = (np.full(CAMERA.shape, np.nan, np.float32) for _ in range(2))
        ego = drive.ego(1_500_000)
        renderer.render(
            camera_pose((ego.x, ego.y, 2.4), ego.heading, 0.0, 0.0),
            (empty_quads().packed(), NOTHING),
            intensity,
            depth,
        )
        assert np.isfinite(intensity).all() and intensity.std() > 0.03
        assert (depth[-1] > 1).all() and 0.05 < (depth == 0).mean() < 0.6
        above_horizon = depth[: CAMERA.height // 2 - 2]
        assert (above_horizon > 0).mean() > 0.02, f"{style}: nothing stands beside the road"


def test_the_same_generator_gives_the_same_world_and_another_one_another():
    first, again, other = (build("intersection", "suburb", seed=seed) for seed in (1, 1, 2))
    for one, same in zip(first.quads, again.quads, strict=True):
        assert one.tobytes() == same.tobytes()
    assert first.ground.packed.tobytes() == again.ground.packed.tobytes()
    assert first.quads.origin.tobytes() != other.quads.origin.tobytes()


def test_objects_hold_every_quad_once_and_their_spheres_enclose_them():
    built = build("two-way", "park")
    objects = built.objects
    owner = np.repeat(np.arange(objects.size.size), objects.size)
    np.testing.assert_array_equal(np.r_[0, np.cumsum(objects.size)[:-1]], objects.first)
    assert owner.size == built.quads.albedo.size
    points = surface_points(built.quads).reshape(3, 9, -1)
    away = np.linalg.norm(points - objects.centre[:, None, owner], axis=0).max(axis=0)
    assert (away <= objects.radius[owner] * (1 + 1e-4) + 1e-3).all()


def test_normals_are_unit_vectors_square_to_their_surface():
    quads = build("exit", "rural").quads
    np.testing.assert_allclose(np.linalg.norm(quads.normal, axis=0), 1.0, atol=1e-4)
    for edge in (quads.u, quads.v):
        lengths = np.maximum(np.linalg.norm(edge, axis=0), 1e-6)
        assert np.abs((edge * quads.normal).sum(axis=0) / lengths).max() < 1e-3


def test_lane_lines_are_painted_brighter_than_the_asphalt():
    drive = traffic("highway")
    ground = build("highway", "rural").ground
    _, rows, columns = ground.layout[0]
    grey = (ground.packed[: rows * columns] & 255).reshape(rows, columns)

    def mean_grey(points):
        column, row = np.rint((points - ground.corner) / ground.texel).astype(int).T
        return grey[row, column].mean()

    beside_path = [
        lane for lane in drive.lanes if np.abs(lane.points - drive.ego_path()[0]).max(1).min() < 30
    ]
    solid = [lane for lane in beside_path if lane.right == "solid"]
    assert solid
    for lane in solid:
        right = np.stack([np.sin(lane.headings), -np.cos(lane.headings)], axis=1)
        near = np.linalg.norm(lane.points - drive.ego_path()[0], axis=1) < 100
        line, middle = lane.points + right * lane.width / 2, lane.points + right * lane.width / 4
        assert mean_grey(line[near]) > 1.3 * mean_grey(middle[near])


def test_a_finer_sensor_gets_more_detail():
    fine = DrivingConfig(resolution="full").camera
    coarse_world, fine_world = build("two-way", "park"), build("two-way", "park", camera=fine)
    assert fine_world.quads.albedo.size > coarse_world.quads.albedo.size


def test_weathers_are_fourteen_different_lights():
    lights = [weather.preset(name).light() for name in WEATHERS]
    assert len(set(lights)) == len(WEATHERS) == 14
    for light in lights:
        assert 0 < light.sky <= 1 and 0 < light.ground < 1.5 and 0 <= light.gloss < 1 and light.fog >= 0


@pytest.mark.parametrize("sky", ["Clear", "Cloudy", "Wet", "WetCloudy", "SoftRain", "MidRain", "HardRain"])
def test_sunset_is_darker_and_noisier_than_noon(sky):
    noon, sunset = weather.preset(sky + "Noon"), weather.preset(sky + "Sunset")
    assert sunset.light().sky < noon.light().sky and sunset.light().ground < noon.light().ground
    assert sunset.noise_scale > noon.noise_scale


def test_clouds_flatten_the_shading():
    normals = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 0, 1.0]]).T

    def contrast(name):
        shade = weather.preset(name).shade(normals, 0.3)
        return shade.max() / shade.min()

    assert contrast("ClearNoon") > 1.3 * contrast("CloudyNoon") > 1.3


def test_wet_ground_is_darker_and_glossy():
    dry, wet = weather.preset("ClearNoon").light(), weather.preset("WetNoon").light()
    assert wet.ground < dry.ground and wet.gloss > dry.gloss == 0


@pytest.mark.parametrize("name", WEATHERS)
def test_streaks_fall_only_in_rain(name):
    grey = np.full(CAMERA.shape, 0.4, np.float32)
    drawn = grey.copy()
    rain = Rain(weather.preset(name).streaks, CAMERA, seed=1)
    rain.draw(400_000, drawn)
    assert (drawn >= grey).all() and drawn.max() <= 1
    assert ((drawn > grey).any()) == ("Rain" in name)
    again, later = grey.copy(), grey.copy()
    rain.draw(400_000, again)
    rain.draw(405_000, later)
    assert again.tobytes() == drawn.tobytes()
    assert (later.tobytes() != drawn.tobytes()) == ("Rain" in name)


@pytest.mark.parametrize("scenario", ["intersection", "roundabout"])
def test_no_vehicle_drives_through_a_parking_space(scenario):
    drive = simulate(scenario, seed=3, duration_s=6.0)
    builder = world._Builder(drive, "downtown", 100.0, np.random.default_rng(3))
    spaces, yaws = builder.along(6.5, (1.4, 1.55), share=1.0, jitter=0.1, half_length=2.5)
    assert len(spaces) > 20
    vehicles = np.array([actor.kind != "pedestrian" for actor in drive.actors])
    cos, sin = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
    for t in range(0, drive.duration_us + 1, 100_000):
        ego = drive.ego(t)
        centres = np.vstack([drive.actor_states(t)[vehicles, :2], (ego.x, ego.y)])
        x, y = np.moveaxis(centres[None] - spaces[:, None], 2, 0)
        along, across = np.abs(cos * x + sin * y), np.abs(cos * y - sin * x)
        # Half a parked car and half the width of a driving one.
        assert not ((along < 2.3 + 0.9) & (across < 0.93 + 0.9)).any()
