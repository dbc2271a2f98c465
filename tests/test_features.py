import math
from dataclasses import replace

import numpy as np
import pytest

from nl_env.depth.features import (
    CHANNELS,
    EVENTS,
    INVERSE_SCALE,
    LOG_CENTRE,
    LOG_SCALE,
    Scene,
    coarse_camera,
    features,
    hide_events,
)
from nl_env.depth.warp import warp
from nl_env.types import Camera

CAMERA = Camera.from_fov(48, 64, 70.0)
RANGE = 200.0
FORWARD = np.eye(4)
FORWARD[2, 3] = -2.0
"""The camera drives 2 m ahead."""


def scene(**changes):
    rng = np.random.default_rng(0)
    rows = np.arange(CAMERA.height)[:, None] + np.zeros(CAMERA.shape)
    prior = np.where(rows < 12, 0, 30 - rows * 0.3).astype(np.float32)
    voxel = rng.integers(-3, 4, (5, *CAMERA.shape)).astype(np.float32)
    known = Scene(CAMERA, RANGE, prior, prior + np.float32(1) * (prior > 0), np.eye(4), voxel, 0.2)
    return replace(known, **changes)


def channel(stack, name):
    return stack[CHANNELS.index(name)]


def depth(codes, returns):
    return np.where(returns > 0, np.exp(codes * LOG_SCALE + LOG_CENTRE), 0)


def test_the_warped_frame_is_the_warp_baseline():
    stack = features(scene(), FORWARD)
    expected = warp(scene().prior, CAMERA, FORWARD, RANGE)
    warped = depth(channel(stack, "warped log depth"), channel(stack, "warped return"))
    np.testing.assert_allclose(warped, expected, rtol=1e-5)
    inverse = np.divide(1, expected, out=np.zeros_like(expected), where=expected > 0)
    np.testing.assert_allclose(channel(stack, "warped inverse depth"), inverse * INVERSE_SCALE, rtol=1e-5)
    prior = depth(channel(stack, "prior log depth"), channel(stack, "prior return"))
    np.testing.assert_allclose(prior, scene().prior, rtol=1e-5)


def test_no_return_is_coded_as_the_range():
    codes = channel(features(scene(), np.eye(4)), "prior log depth")
    np.testing.assert_allclose(codes[:12], (math.log(RANGE) - LOG_CENTRE) / LOG_SCALE, rtol=1e-6)


def test_flow_is_the_way_of_the_surface_in_pixels():
    wall = np.full(CAMERA.shape, 20.0, np.float32)
    stack = features(scene(prior=wall, previous=wall), FORWARD)
    hit = channel(stack, "warped hit") > 0
    columns = np.arange(CAMERA.width) - CAMERA.cx + np.zeros(CAMERA.shape)
    # What is now at 18 m was seen at 20 m, closer to the centre by 18 / 20.
    np.testing.assert_allclose(
        np.sinh(channel(stack, "flow x"))[hit], (columns * (1 - 18 / 20))[hit], rtol=1e-4, atol=1e-4
    )


def test_the_previous_frame_shows_what_moved_by_itself():
    wall = np.full(CAMERA.shape, 20.0, np.float32)
    still = features(scene(prior=wall, previous=wall), np.eye(4))
    assert np.abs(channel(still, "previous against warped")).max() == 0
    nearing = wall.copy()
    nearing[10:20, 10:20] = 22.0
    stack = features(scene(prior=wall, previous=nearing), np.eye(4))
    moved = channel(stack, "previous against warped")
    np.testing.assert_allclose(moved[12:18, 12:18], math.log(22 / 20) / LOG_SCALE, rtol=1e-4)
    assert np.abs(moved[30:]).max() == 0
    alone = features(scene(prior=wall, previous=None), np.eye(4))
    assert channel(alone, "previous hit").max() == 0


def test_events_are_compressed_and_may_be_hidden():
    stack = features(scene(), np.eye(4))
    counts = scene().voxel
    np.testing.assert_allclose(stack[EVENTS], np.sign(counts) * np.log1p(np.abs(counts)), rtol=1e-6)
    whole = features(scene(voxel=counts.astype(np.int8)), np.eye(4))
    np.testing.assert_array_equal(whole, stack)
    hidden = hide_events(whole)
    assert np.abs(hidden[EVENTS]).max() == 0
    np.testing.assert_array_equal(hidden[: EVENTS.start], stack[: EVENTS.start])


def test_compensated_bins_agree_where_the_motion_is_right():
    """Three columns of events run with a wall's flow; all bins then show them where the last one would."""
    sideways = np.eye(4)
    sideways[0, 3] = 10 * 20.0 / CAMERA.fx  # 10 pixels in the gap
    wall = np.full(CAMERA.shape, 20.0, np.float32)
    voxel = np.zeros((5, *CAMERA.shape), np.float32)
    for k in range(5):
        voxel[k, :, 20 + 2 * k] = 4
    known = scene(prior=wall, previous=None, voxel=voxel)
    bins = features(known, sideways, compensated=True)[EVENTS]
    assert set(np.flatnonzero(bins.sum((0, 1)) > 0.1)) == {29}
    np.testing.assert_allclose(bins[:, :, 29], math.log(5), rtol=1e-3)
    wrong = features(known, np.eye(4), compensated=True)[EVENTS]
    np.testing.assert_array_equal(wrong, features(known, np.eye(4))[EVENTS])


def test_longer_gaps_are_told():
    codes = [channel(features(scene(gap=gap), np.eye(4)), "gap")[0, 0] for gap in (0.1, 0.2, 0.4)]
    np.testing.assert_allclose(codes, [0, 0.5, 1.0], atol=1e-6)


def test_coarse_pixels_look_where_full_ones_did():
    camera = Camera.from_fov(240, 320, 75.0)
    rng = np.random.default_rng(1)
    prior = rng.uniform(5, 50, camera.shape).astype(np.float32)
    voxel = rng.integers(-2, 3, (5, *camera.shape)).astype(np.int8)
    full = Scene(camera, RANGE, prior, prior, np.eye(4), voxel, 0.1)
    coarse = full.coarse()
    assert coarse.camera == coarse_camera(camera) and coarse.camera.shape == (120, 160)
    y, x = 30, 50
    np.testing.assert_array_equal(coarse.prior[y, x], prior[2 * y + 1, 2 * x + 1])
    ray = (x - coarse.camera.cx) / coarse.camera.fx, (y - coarse.camera.cy) / coarse.camera.fy
    fine = (2 * x + 1 - camera.cx) / camera.fx, (2 * y + 1 - camera.cy) / camera.fy
    np.testing.assert_allclose(ray, fine)
    block = voxel[0, 2 * y : 2 * y + 2, 2 * x : 2 * x + 2]
    assert coarse.voxel[0, y, x] == block.mean(dtype=np.float32)
    quarter = scene()
    assert quarter.coarse() is quarter


def test_bad_input_is_named():
    with pytest.raises(ValueError, match="voxel"):
        features(scene(voxel=np.zeros((4, *CAMERA.shape), np.float32)), np.eye(4))
    with pytest.raises(ValueError, match="gap"):
        features(scene(gap=0.0), np.eye(4))
    with pytest.raises(ValueError, match="motion"):
        features(scene(), np.full((4, 4), np.nan))
    with pytest.raises(ValueError, match="depth"):
        features(scene(prior=np.ones((3, 3), np.float32)), np.eye(4))
