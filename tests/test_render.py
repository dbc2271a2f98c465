"""The renderer against ray casting: z-depth of planes and boxes, what hides what, and what light may do."""

import numpy as np
import pytest

from nl_env.scene.quads import Objects, QuadBuilder, assemble, empty_quads, place
from nl_env.scene.render import FAR, GroundMap, Light, Renderer
from nl_env.scene.scene import camera_pose
from nl_env.scene.textures import BRICK, LEAVES_NEAR, noise
from nl_env.types import Camera

CAMERA = Camera.from_fov(120, 160, 76.0)
CLEAR = Light(sky=0.8, zenith=-0.2, clouds=0.2, ground=0.9, fog=0.0, haze=0.7, gloss=0.0)
NOTHING = Objects(
    np.zeros((3, 0), np.float32), np.zeros(0, np.float32), np.zeros(0, np.int32), np.zeros(0, np.int32)
)
BOXES = (
    ((12.0, 0.5), (3.0, 4.0, 2.5), 0.0),
    ((25.0, -6.0), (5.0, 2.0, 9.0), 0.6),
    ((60.0, 10.0), (14.0, 14.0, 20.0), -0.3),
)
"""Centre (x, y), size and yaw of boxes on the ground."""


def ground_map():
    grey = np.clip(0.5 + 0.15 * noise(np.random.default_rng(1), 256, 1.0), 0, 1)
    return GroundMap.paint(grey, np.array([-128.0, -128.0]), 1.0)


GROUND = ground_map()


def box(centre, size, yaw=0.0, texture=BRICK):
    builder = QuadBuilder()
    builder.box((0, 0, 0), size, 0.6, texture)
    return place(builder.build(), np.array([[*centre, 0.0]]), np.array([yaw]))


def quad(origin, u, v, **material):
    builder = QuadBuilder()
    builder.quad(origin, u, v, 0.6, **material)
    return place(builder.build(), np.zeros((1, 3)), np.zeros(1))


def look(pose, parts, moving=(), light=CLEAR):
    """Intensity and depth of placed parts from a pose."""
    static = assemble(list(parts)) if parts else (empty_quads(), NOTHING)
    quads, objects = assemble(list(moving)) if moving else (empty_quads(), NOTHING)
    renderer = Renderer(CAMERA, static, GROUND, light, quads.albedo.size, objects.radius.size)
    intensity, depth = np.full(CAMERA.shape, np.nan, np.float32), np.full(CAMERA.shape, np.nan, np.float32)
    renderer.render(pose, (quads.packed(), objects), intensity, depth)
    return intensity, depth


def level(x=0.0, y=0.0, z=2.0, heading=0.0, pitch=0.0, roll=0.0):
    return camera_pose((x, y, z), heading, pitch, roll)


def cast(pose, boxes):
    """``(H, W)`` z-depth of the ground and of boxes: every pixel's ray against slabs, in float64."""
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, np.ones(x.shape)], -1)
    directions, eye = rays @ pose[:3, :3].T, pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        nearest = np.where(directions[..., 2] < 0, -eye[2] / directions[..., 2], np.inf)
        for (cx, cy), size, yaw in boxes:
            turn = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
            start, along = turn @ (eye - [cx, cy, size[2] / 2]), directions @ turn.T
            ends = np.stack([(-np.array(size) / 2 - start) / along, (np.array(size) / 2 - start) / along])
            enter, leave = ends.min(0).max(-1), ends.max(0).min(-1)
            nearest = np.where((enter < leave) & (enter > 0), np.minimum(nearest, enter), nearest)
    return np.where(nearest < FAR, nearest, 0.0)


@pytest.mark.parametrize(
    "pose",
    [
        level(),
        level(y=3.0, z=1.2, heading=0.2, pitch=0.05, roll=0.1),
        level(x=5.0, y=-20.0, z=15.0, heading=1.2, pitch=0.5, roll=-0.3),
        level(x=12.0, y=3.0, z=1.5),  # beside the first box, whose side runs past the camera
    ],
    ids=["ahead", "tilted", "from above", "beside"],
)
def test_depth_of_ground_and_boxes_is_that_of_ray_casting(pose):
    expected = cast(pose, BOXES)
    _, depth = look(pose, [box(*b) for b in BOXES])
    error = np.abs(depth - expected) / np.maximum(expected, 1.0)
    # A pixel whose centre is on an edge may go to either side.
    assert (error > 1e-4).mean() < 1e-3
    assert np.median(error[expected > 0]) < 1e-6
    for b in BOXES:  # every box is seen, or the comparison would say little
        assert (cast(pose, [b]) != cast(pose, [])).sum() > 20


def test_wall_square_to_the_camera_has_one_depth():
    _, depth = look(level(z=10.0), [box((31.0, 0.0), (2.0, 200.0, 60.0))])
    np.testing.assert_allclose(depth[:60], 30.0, rtol=1e-5)


def test_nearer_surfaces_hide_farther_ones_in_any_order():
    near, far = box((15.0, 0.0), (2.0, 3.0, 3.0)), box((40.0, 0.0), (2.0, 40.0, 12.0))
    first, second = look(level(), [near, far]), look(level(), [far, near])
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)
    middle = first[1][58, 80]
    assert middle == pytest.approx(14.0, rel=1e-4)


def test_moving_objects_look_like_standing_ones():
    parts = [box(*b) for b in BOXES]
    for one, other in zip(look(level(), parts), look(level(), parts[:1], moving=parts[1:]), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("two_sided", [False, True])
@pytest.mark.parametrize("towards", [False, True])
def test_back_faces_are_seen_only_of_two_sided_surfaces(two_sided, towards):
    normal = (-1.0, 0.0, 0.0) if towards else (1.0, 0.0, 0.0)
    wall = quad((20.0, -5.0, 0.0), (0, 10.0, 0), (0, 0, 6.0), two_sided=two_sided, normal=normal)
    _, depth = look(level(), [wall])
    seen = depth[55, 80] == pytest.approx(20.0, rel=1e-4)
    assert seen == (two_sided or towards)


def test_leaves_have_holes_and_what_is_behind_shows_through():
    leaves = quad(
        (10.0, -30.0, -30.0),
        (0, 60.0, 0),
        (0, 0, 60.0),
        texture=LEAVES_NEAR[0],
        cutout=True,
        repeat=(8.0, 8.0),
    )
    _, depth = look(level(z=5.0), [leaves, box((41.0, 0.0), (2.0, 200.0, 80.0))])
    above = depth[:50]
    on_leaf, behind = np.isclose(above, 10.0, rtol=1e-4), np.isclose(above, 40.0, rtol=1e-4)
    assert (on_leaf | behind).all()
    assert 0.35 < on_leaf.mean() < 0.75


def test_sky_and_what_is_beyond_the_range_have_no_depth():
    intensity, depth = look(level(), [box((FAR + 12.0, 0.0), (4.0, 30.0, 60.0))])
    assert not depth[:50].any()
    assert abs(float(intensity[45, 80]) - float(intensity[45, 20])) > 0.05  # still seen as intensity
    assert depth.min() == 0.0 and depth.max() < FAR
    _, near = look(level(), [box((FAR - 8.0, 0.0), (4.0, 30.0, 60.0))])
    assert near[45, 80] == pytest.approx(FAR - 10.0, rel=1e-4)


@pytest.mark.parametrize(
    "light",
    [CLEAR, CLEAR._replace(sky=1.0, ground=3.0), CLEAR._replace(sky=0.0, ground=0.0, fog=0.01, haze=0.0)],
    ids=["clear", "glaring", "black"],
)
def test_intensity_is_a_positive_grey_level_at_most_1(light):
    intensity, _ = look(level(), [box(*b) for b in BOXES], light=light)
    assert intensity.min() >= np.float32(0.001) and intensity.max() <= 1.0


def test_fog_draws_distant_surfaces_to_its_grey_and_leaves_depth_alone():
    walls = [
        box((20.0, -12.0), (2.0, 20.0, 30.0), texture=-1),
        box((150.0, 60.0), (2.0, 120.0, 90.0), texture=-1),
    ]
    clear, depth = look(level(), walls)
    foggy, same_depth = look(level(), walls, light=CLEAR._replace(fog=0.02, haze=0.3))
    np.testing.assert_array_equal(depth, same_depth)
    near, far = (30, 140), (30, 30)
    assert depth[near] == pytest.approx(19.0, rel=1e-4) and depth[far] == pytest.approx(149.0, rel=1e-4)
    for pixel, metres in ((near, 19.0), (far, 149.0)):
        kept = np.exp(-0.02 * metres)
        assert foggy[pixel] == pytest.approx(kept * clear[pixel] + (1 - kept) * 0.3, abs=5e-3)


def test_intensity_does_not_depend_on_whether_depth_is_asked_for():
    static = assemble([box(*b) for b in BOXES])
    renderer = Renderer(CAMERA, static, GROUND, CLEAR, 0, 0)
    images = [np.zeros(CAMERA.shape, np.float32) for _ in range(3)]
    renderer.render(level(), (empty_quads().packed(), NOTHING), images[0], images[2])
    renderer.render(level(), (empty_quads().packed(), NOTHING), images[1], None)
    assert images[0].tobytes() == images[1].tobytes()
