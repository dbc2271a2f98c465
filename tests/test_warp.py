import math

import numpy as np
import pytest

from nl_env.depth.extrapolators import make_extrapolator
from nl_env.depth.warp import splat, warp
from nl_env.types import Camera, ExtrapolationInput

CAMERA = Camera.from_fov(48, 64, 70.0)
RANGE = 200.0


def moved(x=0.0, y=0.0, z=0.0, yaw_deg=0.0):
    """Old camera to new camera when the camera moves by (x, y, z) and turns right by ``yaw_deg``."""
    c, s = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    pose = np.array([[c, 0, s, x], [0, 1, 0, y], [-s, 0, c, z], [0, 0, 0, 1.0]])
    return np.linalg.inv(pose)


def plane_depth(normal, offset, motion):
    """Depth image of the old frame's plane ``normal . X = offset`` after the motion."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(CAMERA.shape)], -1)
    pose = np.linalg.inv(motion)
    slope = rays @ pose[:3, :3].T @ normal
    with np.errstate(divide="ignore"):
        depth = (offset - pose[:3, 3] @ normal) / slope
    return np.where((slope > 0) & (depth < RANGE), depth, 0).astype(np.float32)


WALL = np.array([0, 0, 1.0]), 20.0
GROUND = np.array([0, 1.0, 0]), 1.6
SLANTED = np.array([0.5, 0.2, 1.0]), 15.0
MOTIONS = {
    "towards it": moved(z=3.0),
    "a little": moved(x=0.01, z=0.05),
    "yaw": moved(yaw_deg=4.0),
    "yaw by a fraction of a pixel": moved(yaw_deg=0.2),
    "all together": moved(0.3, 0.05, 1.0, -3.0),
}


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
@pytest.mark.parametrize("plane", [WALL, GROUND, SLANTED], ids=["wall", "ground", "slanted"])
def test_planes_are_warped_exactly(plane, motion):
    warped, hit = splat(plane_depth(*plane, np.eye(4)), CAMERA, motion, RANGE)
    expected = plane_depth(*plane, motion)
    surface = hit & (warped > 0) & (expected > 0)
    np.testing.assert_allclose(warped[surface], expected[surface], rtol=1e-5)
    # The horizon may land one row off; nothing else is confused with the sky.
    assert np.count_nonzero(hit & ((warped > 0) != (expected > 0))) <= CAMERA.width


@pytest.mark.parametrize("plane", [WALL, GROUND, SLANTED], ids=["wall", "ground", "slanted"])
def test_approaching_a_surface_leaves_no_cracks(plane):
    prior = plane_depth(*plane, np.eye(4))
    for metres in (0.05, 0.5, 3.0):
        warped, _ = splat(prior, CAMERA, moved(z=metres), RANGE)
        below_horizon = plane_depth(*plane, moved(z=metres)) > 0
        assert np.count_nonzero(warped[below_horizon] == 0) <= CAMERA.width


def test_standing_still_changes_nothing():
    generator = np.random.default_rng(0)
    leaves = np.where(generator.random(CAMERA.shape) < 0.5, generator.uniform(2, 150, CAMERA.shape), 0)
    leaves = leaves.astype(np.float32)
    warped, hit = splat(leaves, CAMERA, np.eye(4), RANGE)
    assert hit.all()
    np.testing.assert_allclose(warped, leaves, rtol=1e-6)


def test_a_post_moves_by_its_parallax_keeps_its_width_and_leaves_a_hole():
    prior = np.full(CAMERA.shape, 50, np.float32)
    prior[:, 30:33] = 5
    # The camera goes right by 5 pixels of parallax at 5 m, half a pixel at 50 m.
    motion = moved(x=5 * 5 / CAMERA.fx)
    warped, hit = splat(prior, CAMERA, motion, RANGE)
    near = np.abs(warped - 5) < 1e-4
    assert (np.flatnonzero(near.all(axis=0)) == [25, 26, 27]).all() and near.sum() == 3 * CAMERA.height
    hole = np.flatnonzero(~hit.any(axis=0))
    assert set(hole) <= set(range(28, 34)) | {CAMERA.width - 1} and {30, 31} <= set(hole)
    kept = warp(prior, CAMERA, motion, RANGE)
    assert (kept[:, hole] == prior[:, hole]).all() and (kept[hit] == warped[hit]).all()


@pytest.mark.parametrize("width", [8, 63, 65, 150])
def test_rows_of_any_length_are_moved_whole(width):
    """Columns of different depths, so that mixing them up would show; the camera moves up by 3 pixels."""
    camera = Camera.from_fov(24, width, 70.0)
    columns = np.linspace(5, 60, width, dtype=np.float32)
    motion = np.eye(4)
    for k in (0, width // 2, width - 1):
        motion[1, 3] = 3 * columns[k] / camera.fy
        prior = np.zeros(camera.shape, np.float32)
        prior[:, k] = columns[k]
        warped, hit = splat(prior, camera, motion, RANGE)
        np.testing.assert_allclose(warped[3:, k], columns[k], rtol=1e-6)
        assert hit[3:, k].all() and not warped[:, :k].any() and not warped[:, k + 1 :].any()
        assert warped[:3, k].max() == 0


def test_the_nearer_surface_wins():
    prior = np.full(CAMERA.shape, 40, np.float32)
    prior[:, :32] = 10
    warped, _ = splat(prior, CAMERA, moved(x=-2.0), RANGE)
    shift = round(2.0 * CAMERA.fx / 10)
    np.testing.assert_allclose(warped[:, shift + 1 : 31 + shift], 10, rtol=1e-5)


def test_sky_turns_with_the_camera_and_ignores_its_way():
    prior = np.full(CAMERA.shape, 30, np.float32)
    prior[:20] = 0
    forward, hit = splat(prior, CAMERA, moved(z=2.0), RANGE)
    assert hit[:18].all() and (forward[:18] == 0).all()
    pitch = math.radians(5)
    c, s = math.cos(pitch), math.sin(pitch)
    looking_up = np.array([[1, 0, 0, 0], [0, c, s, 0], [0, -s, c, 0], [0, 0, 0, 1.0]])
    turned, hit = splat(prior, CAMERA, looking_up, RANGE)
    horizon = 20 + math.tan(pitch) * CAMERA.fy
    assert (turned[int(horizon) + 2 :] > 0).all()
    assert (turned[hit][turned[hit] == 0]).size and (turned[int(horizon) - 2] == 0).all()


def test_what_moves_behind_the_camera_or_out_of_range_is_gone():
    prior = np.full(CAMERA.shape, 5, np.float32)
    assert not splat(prior, CAMERA, moved(z=6.0), RANGE)[1].any()
    warped, hit = splat(np.full(CAMERA.shape, 198, np.float32), CAMERA, moved(z=-4.0), RANGE)
    assert hit.any() and (warped == 0).all()


def test_input_is_checked_and_not_modified():
    prior = plane_depth(*SLANTED, np.eye(4))
    before = prior.copy()
    splat(prior, CAMERA, moved(z=1.0), RANGE)
    assert (prior == before).all()
    with pytest.raises(ValueError, match=r"depth: found shape \(2, 2\), expected the camera's, \(48, 64\)"):
        splat(np.ones((2, 2), np.float32), CAMERA, np.eye(4), RANGE)
    with pytest.raises(ValueError, match=r"motion: (?s:.*)expected a finite \(4, 4\) matrix"):
        splat(prior, CAMERA, np.full((4, 4), np.nan), RANGE)


def test_warp_extrapolator_uses_true_poses_when_it_has_odometry():
    start, now = np.eye(4), np.linalg.inv(moved(0.2, 0, 1.5, 2.0))
    frame = plane_depth(*SLANTED, np.eye(4))
    inputs = ExtrapolationInput(50_000, CAMERA, RANGE, [frame], [0], [], poses=[start, now])
    predicted = make_extrapolator("warp", odometry=True)(inputs).depth
    expected = plane_depth(*SLANTED, np.linalg.inv(now))
    hit = splat(frame, CAMERA, np.linalg.inv(now), RANGE)[1]
    assert hit.mean() > 0.9
    np.testing.assert_allclose(predicted[hit], expected[hit], rtol=1e-5)
