"""The event camera against analytic cases."""

import pickle

import numpy as np
import pytest

from nl_env.config import EventCameraConfig
from nl_env.representations import event_frame, voxel_grid
from nl_env.sensors.event_camera import EventCamera
from nl_env.types import EVENT_DTYPE

TICK = 5_000


def camera(shape=(4, 6), random_reference=False, start=0, level=0.2, seed=0, **config):
    """A camera that has just seen a uniform image."""
    cam = EventCamera(EventCameraConfig(**config), shape, random_reference)
    cam.reset(uniform(np.log(level), shape), start, np.random.default_rng(seed))
    return cam


def uniform(log_level, shape=(4, 6)):
    return np.full(shape, np.exp(log_level), np.float32)


def ramp(cam, log_rate, ticks, start=0, level=0.2, tick=TICK):
    """Events of a uniform ramp of ``log_rate`` per second that starts at ``level``."""
    parts = []
    for k in range(1, ticks + 1):
        image = uniform(np.log(level) + log_rate * k * tick * 1e-6, cam.shape)
        parts.append(cam.events(image, start + k * tick))
    return np.concatenate(parts)


def textures(shape, ticks, seed, change=0.25):
    """Random images whose logs walk: quiet pixels, busy pixels, reversals, and a still left edge."""
    rng = np.random.default_rng(seed)
    walk = rng.normal(0, 1, shape)
    pace = change * rng.random(shape) ** 3 * 8
    pace[:, : shape[1] // 4] = 0
    images = []
    for _ in range(ticks):
        images.append(np.exp(np.clip(walk, -6, 0)).astype(np.float32))
        walk = walk + pace * rng.normal(0, 1, shape)
    return images


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("start", [0, 36_000_000_000])
def test_log_ramp_gives_floor_delta_over_threshold_events_at_the_right_microseconds(sign, start):
    rate, threshold, ticks = sign * 7.3, 0.1, 6
    events = ramp(camera(start=start), rate, ticks, start)
    expected = (
        np.arange(1, int(abs(rate) * ticks * TICK * 1e-6 / threshold) + 1) * threshold / abs(rate) * 1e6
    )
    assert events.dtype == EVENT_DTYPE and np.all(np.diff(events["t"]) >= 0)
    for y, x in np.ndindex(4, 6):
        times = events["t"][(events["x"] == x) & (events["y"] == y)]
        assert len(times) == len(expected)
        assert np.abs(times - start - np.floor(expected)).max() <= 1
    assert np.all(events["p"] == sign)


def test_on_and_off_thresholds_are_separate():
    rising = ramp(camera(threshold_on=0.1, threshold_off=0.3), 50.0, 4)
    falling = ramp(camera(threshold_on=0.1, threshold_off=0.3, level=1.0), -50.0, 4, level=1.0)
    assert len(rising) == 24 * 10 and len(falling) == 24 * 3


def test_window_is_half_open_and_an_exact_multiple_counts():
    cam = camera(threshold_on=0.25)
    events = cam.events(uniform(np.log(0.2) + 0.5), TICK)
    assert len(events) == 24 * 2 and events["t"].max() == TICK - 1
    assert len(cam.events(uniform(np.log(0.2) + 0.5), 2 * TICK)) == 0


def test_refractory_period_drops_known_events_and_the_reference_still_moves():
    events = ramp(camera(shape=(1, 1), refractory_us=2_500), 95.0, 2)
    np.testing.assert_allclose(events["t"], [1_052, 4_210, 7_368], atol=1)
    quiet = camera(shape=(1, 1), refractory_us=1_000_000)
    assert len(ramp(quiet, 100.0, 2)) == 1
    quiet.events(uniform(np.log(0.2) + 1.0, (1, 1)), 3 * TICK)
    assert len(quiet.events(uniform(np.log(0.2) + 1.09, (1, 1)), 4 * TICK)) == 0


def test_leak_gives_on_events_at_its_rate_through_many_time_bases():
    cam = camera(leak_rate_hz=2.0, threshold_on=0.5, threshold_off=0.4)
    still = uniform(np.log(0.2))
    events = np.concatenate([cam.events(still, 100_000 * k) for k in range(1, 7_001)])
    assert np.all(events["p"] == 1)
    times = events["t"][(events["x"] == 3) & (events["y"] == 2)]
    assert len(times) in (1_399, 1_400)
    np.testing.assert_allclose(np.diff(times), 500_000, atol=60)


def test_shot_noise_rate_polarity_and_darkness():
    def rate(level, scale=1.0):
        cam = camera(shape=(60, 80), level=level, shot_rate_hz=10.0)
        cam.noise_scale = scale
        still = uniform(np.log(level), cam.shape)
        events = np.concatenate([cam.events(still, TICK * k) for k in range(1, 101)])
        if len(events):
            assert abs(events["p"].mean()) < 4 / np.sqrt(len(events))
            assert abs((events["t"] % TICK).mean() - TICK / 2) < 4 * TICK / np.sqrt(12 * len(events))
        return len(events) / (cam.shape[0] * cam.shape[1] * 100 * TICK * 1e-6)

    sigma = 24_000**0.5 / 2_400  # of the count over 0.5 s, as a rate
    assert abs(rate(0.001) - 10.0) < 4 * sigma
    assert abs(rate(1.0) - 2.5) < 2 * sigma
    assert abs(rate(0.001, scale=3.0) - 30.0) < 7 * sigma
    assert rate(0.001, scale=0.0) == 0


def test_a_still_ideal_scene_is_silent():
    image = np.exp(np.random.default_rng(3).uniform(-6.9, 0, (60, 80))).astype(np.float32)
    for seed in range(3):
        cam = EventCamera(EventCameraConfig.preset("ideal"), image.shape)
        cam.reset(image, 0, np.random.default_rng(seed))
        assert sum(len(cam.events(image, TICK * k)) for k in range(1, 20)) == 0


def test_threshold_mismatch_has_the_configured_spread():
    cam = camera(shape=(60, 80), threshold_on=0.3, threshold_mismatch=0.03)
    events = ramp(cam, 100.0, 1)
    first = np.full(cam.shape, np.inf)
    np.minimum.at(first, (events["y"], events["x"]), events["t"])
    thresholds = first * 1e-6 * 100.0
    assert abs(thresholds.mean() - 0.3) < 0.002 and abs(thresholds.std() - 0.03) < 0.0015


@pytest.mark.parametrize("ticks", [[TICK] * 6, [10_000] * 3, [1_250, 8_750, 20_000]])
def test_low_pass_step_response_is_the_analytic_exponential(ticks):
    cutoff, threshold, before, after = 60.0, 0.01, 0.05, 0.6
    cam = camera(shape=(1, 1), level=before, threshold_on=threshold, cutoff_hz=cutoff)
    bandwidth = 2 * np.pi * cutoff * (after + 20 / 255) / (1 + 20 / 255)
    total = 0
    for t in np.cumsum(ticks):
        total += len(cam.events(np.full((1, 1), after, np.float32), int(t)))
        risen = np.log(after / before) * (1 - np.exp(-bandwidth * t * 1e-6))
        assert abs(total - risen / threshold) <= 1


def translating(speed, ticks=200, amplitude=1.0, wavelength=40.0):
    """Events per pixel of a sinusoid in log intensity that moves ``speed`` px/s."""
    cam = EventCamera(EventCameraConfig(threshold_on=0.05, threshold_off=0.05), (2, 80))
    x = np.arange(80)
    count, bins = 0, np.zeros((5, 2, 80), np.int16)
    for k in range(ticks + 1):
        phase = 2 * np.pi * (x - speed * k * TICK * 1e-6) / wavelength
        image = np.repeat(np.exp(amplitude * (np.sin(phase) - 1))[None], 2, 0).astype(np.float32)
        if k == 0:
            cam.reset(image, 0, np.random.default_rng(0))
        else:
            count += cam.accumulate(image, k * TICK, bins, (k * TICK - 1) // 20_000 * 20_000)
    return count / 160


def test_a_translating_texture_gives_the_count_of_its_gradient_and_twice_at_twice_the_speed():
    speed, seconds = 100.0, 1.0
    mean_gradient = 4 / 40.0  # of sin with amplitude 1 over a wavelength of 40 px
    slow, fast = translating(speed), translating(2 * speed)
    assert abs(slow - speed * seconds * mean_gradient / 0.05) < 0.05 * slow
    assert abs(fast / slow - 2) < 0.05


@pytest.mark.parametrize("preset", ["ideal", "realistic"])
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("tick", [TICK, 1_700, 20_000])
def test_binned_and_listed_events_agree_and_leave_the_same_state(preset, seed, tick):
    shape = (37, 53)  # not a multiple of the chunk
    steps = sorted({*range(0, 80_001, tick), *range(0, 80_001, 20_000)})
    images = textures(shape, len(steps), seed)
    cameras = [EventCamera(EventCameraConfig.preset(preset), shape) for _ in range(2)]
    for cam in cameras:
        cam.noise_scale = 20.0
        cam.reset(images[0], 0, np.random.default_rng(seed))
    bins, parts, count = np.zeros((4, 5, *shape), np.int16), [], 0
    for t0, t1, image in zip(steps[:-1], steps[1:], images[1:], strict=True):
        slice_start = t0 // 20_000 * 20_000
        count += cameras[0].accumulate(image, t1, bins[t0 // 20_000], slice_start)
        parts.append(cameras[1].events(image, t1))
        assert np.all((parts[-1]["t"] >= t0) & (parts[-1]["t"] < t1))
        cameras.reverse()  # each camera takes both paths: their states must agree, too
    events = np.concatenate(parts)
    assert count == len(events) > 10_000
    for start, summed in zip(range(0, 80_000, 20_000), bins, strict=True):
        np.testing.assert_array_equal(summed, voxel_grid(events, shape, start, start + 20_000))
        np.testing.assert_array_equal(summed.sum(0), event_frame(events, shape, start, start + 20_000))


def test_thresholds_stay_a_window_apart_through_time_bases_where_nothing_happens():
    shape = (20, 40)  # more than one chunk, the last one not full
    cam = EventCamera(EventCameraConfig(leak_rate_hz=100.0, threshold_on=0.5, cutoff_hz=0.0), shape)
    image = np.full(shape, 0.3, np.float32)
    cam.reset(image, 0, np.random.default_rng(0))
    count = sum(len(cam.events(image, 400 * k)) for k in range(1, 401))
    assert count == pytest.approx(0.16 * 100.0 * image.size, rel=0.1)
    pixels = cam._pixels
    window = pixels.on_step + pixels.off_step
    np.testing.assert_allclose(pixels.on_at - pixels.off_at, window, atol=1e-6)
    assert cam._base > 0


def test_same_seed_same_events_reset_redraws_and_a_pickled_camera_continues():
    images = textures((20, 30), 6, 0)

    def run(cam, seed):
        cam.reset(images[0], 0, np.random.default_rng(seed))
        return np.concatenate([cam.events(image, TICK * k) for k, image in enumerate(images[1:], 1)])

    cam = EventCamera(EventCameraConfig.preset("realistic"), (20, 30))
    first, second, again = run(cam, 0), run(cam, 1), run(cam, 0)
    assert first.tobytes() == again.tobytes() != second.tobytes()
    copy = pickle.loads(pickle.dumps(cam))
    assert cam.events(images[2], 10 * TICK).tobytes() == copy.events(images[2], 10 * TICK).tobytes()


def test_refuses_bad_input():
    with pytest.raises(ValueError, match="shape"):
        EventCamera(EventCameraConfig(), (0, 5))
    image = uniform(-1.0)
    with pytest.raises(RuntimeError, match="reset"):
        EventCamera(EventCameraConfig(), (4, 6)).events(image, TICK)
    cam = camera()
    for bad in (np.nan, np.inf, 0.0, -1.0):
        spoilt = image.copy()
        spoilt[2, 3] = bad
        with pytest.raises(ValueError, match="intensity"):
            cam.events(spoilt, TICK)
    for wrong in (image[:3], image.astype(np.float64)):
        with pytest.raises(ValueError, match="intensity"):
            cam.events(wrong, TICK)
    for t in (0, -5, 10_000_000):
        with pytest.raises(ValueError, match="t_us"):
            cam.events(image, t)
    bins = np.zeros((5, 4, 6), np.int16)
    with pytest.raises(ValueError, match="bins"):
        cam.accumulate(image, TICK, bins.astype(np.int32), 0)
    with pytest.raises(ValueError, match="slice_start_us"):
        cam.accumulate(image, TICK, bins, 1)
    cam.noise_scale = -1.0
    with pytest.raises(ValueError, match="noise_scale"):
        cam.events(image, TICK)
