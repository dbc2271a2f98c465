import numpy as np
import pytest

from nl_env.depth.extrapolators import Warp
from nl_env.depth.metrics import full_metrics
from nl_env.depth.motion import IntervalMotion, continued, estimate_motion, se3_exp, se3_log
from nl_env.types import Camera, ExtrapolationInput

CAMERA = Camera.from_fov(120, 160, 70.0)
RANGE = 200.0


def street(pose, car_at=None):
    """Ray-cast depth of a street: ground, two walls, a house at its end, boxes, perhaps a car ahead."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(CAMERA.shape)], -1)
    rays = rays @ pose[:3, :3].T
    depth = np.full(CAMERA.shape, np.inf)

    def rectangle(axis, value, **limits):
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (value - pose[axis, 3]) / rays[..., axis]
            points = pose[:3, 3] + t[..., None] * rays
            inside = t > 0.1
            for name, (low, high) in limits.items():
                coordinate = points[..., "xyz".index(name)]
                inside &= (coordinate > low) & (coordinate < high)
        np.copyto(depth, t, where=inside & (t < depth))

    rectangle(1, 1.6)
    rectangle(0, -6, y=(-8, 1.6))
    rectangle(0, 8, y=(-5, 1.6))
    rectangle(2, 60, y=(-12, 1.6))
    boxes = [(-4, 12), (3, 18), (-3, 30), (5, 9)]
    for x, z in boxes if car_at is None else [*boxes, (-0.8, car_at)]:
        rectangle(2, z, x=(x, x + 1.6), y=(-1, 1.6))
        rectangle(0, x, y=(-1, 1.6), z=(z, z + 2))
        rectangle(0, x + 1.6, y=(-1, 1.6), z=(z, z + 2))
    return np.where(depth < RANGE, depth, 0).astype(np.float32)


def error_of(motion, pose):
    """Metres and degrees between an estimate and the motion to ``pose`` from the origin."""
    twist = se3_log(motion @ pose)
    return np.linalg.norm(twist[:3]), np.degrees(np.linalg.norm(twist[3:]))


def test_se3_log_inverts_exp():
    generator = np.random.default_rng(0)
    for scale in (0.0, 1e-7, 1e-3, 1.0):
        twist = scale * generator.normal(size=6)
        np.testing.assert_allclose(se3_log(se3_exp(twist)), twist, atol=1e-12)


def test_se3_exp_of_a_known_turn():
    # A quarter turn about y along a circle of radius 1.
    motion = se3_exp(np.array([0, 0, np.pi / 2, 0, np.pi / 2, 0]))
    np.testing.assert_allclose(motion[:3, 3], [1, 0, 1], atol=1e-12)
    np.testing.assert_allclose(motion[:3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-12)


def test_constant_velocity_composes():
    motion = se3_exp(np.array([0.1, -0.02, -1.5, 0.01, 0.08, -0.02]))
    half = continued(motion, 0.5)
    np.testing.assert_allclose(half @ half, motion, atol=1e-12)
    np.testing.assert_allclose(continued(motion, 2.0), motion @ motion, atol=1e-12)


@pytest.mark.parametrize(
    "twist",
    [
        [0.05, 0, 0.5, 0, 0.01, 0],
        [0, 0, 1.0, 0.002, 0.03, 0.001],
        [0, 0.01, 2.0, 0, 0, 0],
        [0.02, 0, -0.5, 0, -0.02, 0],
        [0, 0, 3.0, 0, 0, 0],
    ],
)
def test_motion_through_a_street_is_recovered(twist):
    pose = se3_exp(np.array(twist))
    metres, degrees = error_of(estimate_motion(street(np.eye(4)), street(pose), CAMERA, RANGE), pose)
    assert metres < 0.02 + 0.02 * np.linalg.norm(twist[:3])
    assert degrees < 0.1


def test_standing_still_is_recovered():
    frame = street(np.eye(4))
    np.testing.assert_allclose(estimate_motion(frame, frame, CAMERA, RANGE), np.eye(4), atol=1e-3)


def test_a_car_driving_ahead_does_not_count_as_standing():
    pose = se3_exp(np.array([0, 0, 1.0, 0, 0, 0]))
    old, new = street(np.eye(4), car_at=15.0), street(pose, car_at=16.2)
    metres, degrees = error_of(estimate_motion(old, new, CAMERA, RANGE), pose)
    assert metres < 0.05 and degrees < 0.2


def test_what_the_frames_do_not_show_stays_at_the_guess():
    guess = se3_exp(np.array([0, 0, -1.2, 0, 0.01, 0]))
    sky = np.zeros(CAMERA.shape, np.float32)
    np.testing.assert_allclose(estimate_motion(sky, sky, CAMERA, RANGE, guess), guess, atol=1e-6)
    rows = np.arange(CAMERA.height)[:, None] - CAMERA.cy
    ground = np.where(rows > 2, 1.6 * CAMERA.fy / np.maximum(rows, 1), 0) * np.ones((1, CAMERA.width))
    road = ground.astype(np.float32)
    still = estimate_motion(road, road, CAMERA, RANGE)
    assert np.linalg.norm(still[:3, 3]) < 1e-3


def test_estimate_is_a_function_of_its_frames():
    old, new = street(np.eye(4)), street(se3_exp(np.array([0.1, 0, 1.0, 0, 0.02, 0])))
    first = estimate_motion(old, new, CAMERA, RANGE)
    assert (first == estimate_motion(old.copy(), new.copy(), CAMERA, RANGE)).all()
    with pytest.raises(ValueError, match=r"new: found shape \(2, 2\)"):
        estimate_motion(old, new[:2, :2], CAMERA, RANGE)
    with pytest.raises(ValueError, match=r"guess: found shape \(3, 3\)"):
        estimate_motion(old, new, CAMERA, RANGE, np.eye(3))


def test_estimates_do_not_depend_on_threads_and_are_continued_as_they_are(monkeypatch):
    old, new = street(np.eye(4)), street(se3_exp(np.array([0.1, 0, 1.0, 0, 0.02, 0])))
    monkeypatch.setattr("nl_env.depth.threads.WORTH", 1)
    interval = IntervalMotion()
    alone = estimate_motion(old, new, CAMERA, RANGE, threads=1)
    for threads in (2, 3):
        np.testing.assert_array_equal(estimate_motion(old, new, CAMERA, RANGE, threads=threads), alone)
    np.testing.assert_array_equal(interval(old, new, CAMERA, RANGE), alone)
    np.testing.assert_array_equal(interval.continued(0.4), continued(alone, 0.4))


def test_warp_with_estimated_motion_beats_repeat_whenever_it_is_triggered():
    speed = np.array([0, 0, 10.0, 0, 0.2, 0])
    frames = [street(se3_exp(speed * t)) for t in (0.0, 0.1)]
    extrapolator = Warp()
    predicted = {}
    # After 20 ms what is left are edges that moved by a fraction of a pixel.
    for gap, share in ((0.02, 0.7), (0.08, 0.25)):
        truth = street(se3_exp(speed * (0.1 + gap)))
        inputs = ExtrapolationInput(100_000 + int(1e6 * gap), CAMERA, RANGE, frames, [0, 100_000], [])
        predicted[gap] = extrapolator(inputs).depth
        warped = full_metrics(predicted[gap], truth, RANGE)
        repeated = full_metrics(frames[1], truth, RANGE)
        assert warped.log_mae < share * repeated.log_mae and warped.imae < share * repeated.imae
    # Triggered for the first time now, or after another trigger: the same bytes.
    extrapolator.reset()
    assert (extrapolator(inputs).depth == predicted[0.08]).all()
