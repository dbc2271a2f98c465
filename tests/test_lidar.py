"""LiDAR quantisation, beams and energy."""

import numpy as np
import pytest

from nl_env.config import LidarConfig
from nl_env.sensors.lidar import Lidar, decode, encode, quantise
from nl_env.types import Camera

CAMERA = Camera.from_fov(120, 160, 70.0)


def test_quantisation_rounds_to_the_nearest_step():
    step = 200.0 / 65_535
    depth = np.array([10 * step, 10.4 * step, 10.6 * step, 200.0], np.float32)
    np.testing.assert_array_equal(encode(depth, 200.0), [10, 10, 11, 65_535])
    np.testing.assert_allclose(quantise(depth, 200.0), np.array([10, 10, 11, 65_535]) * step, rtol=1e-6)


def test_no_return_is_zero_and_a_return_never_is():
    depth = np.array([0.0, -1.0, np.nan, np.inf, -np.inf, 200.01, 1e30, 1e-6], np.float32)
    np.testing.assert_array_equal(encode(depth, 200.0), [0] * 7 + [1])
    np.testing.assert_array_equal(quantise(depth, 200.0) > 0, [False] * 7 + [True])


@pytest.mark.parametrize("max_depth", [9.0, 200.0, 123.4])
def test_live_and_stored_depth_are_bit_identical_for_every_code(max_depth):
    codes = np.arange(65_536, dtype=np.uint16)
    depth = decode(codes, max_depth)
    assert depth.max() == np.float32(max_depth)
    np.testing.assert_array_equal(encode(depth, max_depth), codes)
    assert quantise(depth, max_depth).tobytes() == depth.tobytes()
    rough = np.random.default_rng(0).uniform(0, 1.2 * max_depth, (30, 40)).astype(np.float32)
    stored = decode(encode(rough, max_depth), max_depth)
    assert quantise(rough, max_depth).tobytes() == stored.tobytes()
    assert np.abs(stored - rough)[stored > 0].max() <= max_depth / 65_535 / 2 * 1.01
    assert quantise(rough, max_depth, out=rough) is rough and rough.tobytes() == stored.tobytes()


def test_dense_sensor_measures_every_row():
    depth = np.full(CAMERA.shape, 50.0, np.float32)
    frame = Lidar(LidarConfig(), CAMERA).measure(depth)
    np.testing.assert_array_equal(frame, quantise(depth, 200.0))
    assert (depth == 50.0).all() and frame is not depth


@pytest.mark.parametrize("beams", [16, 32, 64])
def test_beams_are_evenly_spaced_in_elevation(beams):
    camera = Camera.from_fov(480, 640, 70.0)
    lidar = Lidar(LidarConfig(beams=beams), camera)
    frame = lidar.measure(np.full(camera.shape, 20.0, np.float32))
    hit = np.flatnonzero(frame.any(axis=1))
    np.testing.assert_array_equal(hit, lidar.rows)
    assert len(hit) == beams and frame[hit].all() and {hit[0], hit[-1]} == {0, 479}
    spacing = np.diff(np.arctan((hit - camera.cy) / camera.fy))
    half_row = 0.5 / camera.fy
    assert np.abs(spacing - spacing.mean()).max() <= 2 * half_row


def test_more_beams_than_rows_share_rows():
    frame = Lidar(LidarConfig(beams=128), CAMERA).measure(np.full(CAMERA.shape, 20.0, np.float32))
    assert frame.any(axis=1).mean() > 0.9


def test_energy_counts_frames():
    assert Lidar(LidarConfig(energy_mj=800.0), CAMERA).energy_mj(201) == 160_800.0


def test_refuses_bad_input():
    depth = np.ones(CAMERA.shape, np.float32)
    with pytest.raises(ValueError, match="depth"):
        quantise(depth.astype(np.float64), 200.0)
    with pytest.raises(ValueError, match="max_depth"):
        quantise(depth, 0.0)
    with pytest.raises(ValueError, match="out"):
        quantise(depth, 200.0, out=depth[:3])
    with pytest.raises(ValueError, match="codes"):
        decode(depth, 200.0)
    with pytest.raises(ValueError, match="depth"):
        Lidar(LidarConfig(), CAMERA).measure(depth[:3])
