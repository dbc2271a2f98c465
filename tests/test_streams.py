import numpy as np
import pytest

from nl_env.config import DrivingConfig, EventCameraConfig, LidarConfig, SceneConfig
from nl_env.streams import SyntheticStream
from nl_env.types import SLICE_US


def make(duration_s=0.2, **arguments):
    return SyntheticStream(DrivingConfig(scene=SceneConfig(duration_s=duration_s), **arguments))


def play(stream, seed):
    return [stream.reset(seed), *(stream.advance() for _ in range(stream.slices))]


@pytest.fixture(scope="module")
def samples():
    return play(make(), seed=5)


def test_time_lidar_and_events_of_every_slice(samples):
    assert [s.index for s in samples] == list(range(11))
    assert [s.t for s in samples] == [k * SLICE_US for k in range(11)]
    assert [s.lidar is not None for s in samples] == [k % 5 == 0 for k in range(11)]
    assert samples[0].event_count == 0 and not samples[0].bins.any()
    for sample in samples[1:]:
        np.testing.assert_array_equal(sample.event_frame, sample.bins.sum(axis=0))
        assert sample.event_count >= np.abs(sample.bins, dtype=np.int64).sum() > 0


def test_depth_is_what_a_dense_lidar_measures(samples):
    steps = samples[5].depth / (200.0 / 65535)
    np.testing.assert_allclose(steps, np.rint(steps), atol=2e-2)
    np.testing.assert_array_equal(samples[5].lidar, samples[5].depth)
    assert samples[5].depth.min() == 0.0 and 0 < samples[5].depth.max() <= 200.0


def test_same_seed_same_bytes_and_sequences_do_not_leak_into_each_other(samples):
    stream = make()
    play(stream, seed=6)
    for expected, found in zip(samples, play(stream, seed=5), strict=True):
        assert expected.bins.tobytes() == found.bins.tobytes()
        assert expected.depth.tobytes() == found.depth.tobytes()
        assert expected.state.pose.tobytes() == found.state.pose.tobytes()


def test_ego_moves_as_its_twist_says(samples):
    before, after = samples[4].state, samples[5].state
    moved = before.pose[:3, :3].T @ (after.pose[:3, 3] - before.pose[:3, 3])
    np.testing.assert_allclose(moved, before.twist[:3] * SLICE_US * 1e-6, atol=5e-3)


def test_lidar_period_and_beams():
    stream = make(lidar=LidarConfig(rate_hz=25, beams=16), events=EventCameraConfig.preset("ideal"))
    found = play(stream, seed=5)
    assert [s.lidar is not None for s in found] == [k % 2 == 0 for k in range(11)]
    rows = (found[0].lidar > 0).any(axis=1)
    assert 0 < rows.sum() <= 16


def test_intensity_is_for_display_and_description_is_json(samples):
    stream = make()
    stream.reset(5)
    intensity = stream.intensity()
    assert intensity.shape == stream.camera.shape and 0 <= intensity.min() < intensity.max() <= 1
    assert stream.describe()["seed"] == 5


def test_out_of_order_calls_are_refused():
    stream = make()
    with pytest.raises(RuntimeError, match="reset"):
        stream.advance()
    play(stream, seed=5)
    with pytest.raises(RuntimeError, match="ended at slice 10"):
        stream.advance()
    stream.close()
    stream.close()
    with pytest.raises(RuntimeError, match="reset"):
        stream.intensity()
