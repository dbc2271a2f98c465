from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_stream import WallStream

from nl_env.depth.features import CHANNELS, EVENTS
from nl_env.depth.learned import MotionWarpRefine
from nl_env.depth.learned_networks import ARCHITECTURE, LearnedNetworks, load_learned
from nl_env.depth.warp import warp
from nl_env.types import ExtrapolationInput
from nl_env.weight_files import Card, write_weights


class Spy:
    """A network that says ``answer`` and remembers what it was shown."""

    def __init__(self, answer):
        self.answer, self.seen = answer, []

    def __call__(self, stack):
        self.seen.append(stack.copy())
        return (self.answer,)


def inputs(frames=2, t=5, odometry=False):
    """The wall's LiDAR frames at slices 5 and 10, wanted ``t`` slices later."""
    stream = WallStream(speed=15.0)
    samples = [stream.reset(0)] + [stream.advance() for _ in range(stream.slices)]
    times = (5, 10)[-frames:]
    return ExtrapolationInput(
        samples[10 + t].t,
        stream.camera,
        stream.max_depth,
        tuple(samples[k].depth for k in times),
        tuple(samples[k].t for k in times),
        tuple(sample.bins for sample in samples[11 : 11 + t]),
        tuple(samples[k].state.pose for k in (*times, 10 + t)) if odometry else (),
    ), samples[10 + t].depth


def true_motion(given):
    return np.linalg.inv(given.poses[-1]) @ given.poses[-2]


def test_without_networks_it_warps_by_what_is_known():
    given, _ = inputs(odometry=True)
    expected = warp(given.lidar_frames[-1], given.camera, true_motion(given), given.max_depth)
    np.testing.assert_array_equal(MotionWarpRefine(None, None, odometry=True)(given).depth, expected)
    estimated = MotionWarpRefine(None, None)(replace(given, poses=())).depth
    assert np.mean(np.abs(estimated - expected) < 0.05) > 0.9


def test_the_motion_network_corrects_the_motion():
    given, _ = inputs()
    silent = Spy(np.zeros((1, 2, 12, 16), np.float32))
    same = MotionWarpRefine(silent, None)(given).depth
    np.testing.assert_array_equal(same, MotionWarpRefine(None, None)(given).depth)
    believing = Spy(np.ones((1, 2, 12, 16), np.float32))
    assert (MotionWarpRefine(believing, None)(given).depth != same).mean() > 0.05
    assert silent.seen[0].shape == (1, len(CHANNELS), 48, 64)


def test_true_poses_need_no_motion_network():
    given, _ = inputs(odometry=True)
    spy = Spy(np.zeros((1, 2, 12, 16), np.float32))
    MotionWarpRefine(spy, None, odometry=True)(given)
    assert not spy.seen


def test_the_refinement_answers_with_depth_and_depth_if_there_were_a_return():
    answer = np.zeros((1, 3, 48, 64), np.float32)
    answer[0, 1, 24:] = 3.0
    answer[0, 1, :24] = -3.0
    result = MotionWarpRefine(None, Spy(answer), threshold=1.0)(inputs()[0])
    assert (result.depth[:24] == 0).all() and (result.depth[24:] > 0).all()
    assert (result.depth_if_return > 0).all()


def test_a_sequence_may_begin_with_one_frame():
    spy = Spy(np.zeros((1, 3, 48, 64), np.float32))
    given, _ = inputs(frames=1)
    MotionWarpRefine(None, spy)(given)
    stack = spy.seen[0][0]
    np.testing.assert_array_equal(
        stack[CHANNELS.index("warped log depth")], stack[CHANNELS.index("prior log depth")]
    )
    assert stack[CHANNELS.index("previous hit")].max() == 0


def test_hidden_events_and_unwarped_frames_are_what_the_network_sees():
    given, _ = inputs()
    blind, still = (Spy(np.zeros((1, 3, 48, 64), np.float32)) for _ in range(2))
    MotionWarpRefine(None, blind, events=False)(given)
    MotionWarpRefine(None, still, warped=False)(given)
    assert np.abs(blind.seen[0][0, EVENTS]).max() == 0 < np.abs(still.seen[0][0, EVENTS]).max()
    stack = still.seen[0][0]
    np.testing.assert_array_equal(
        stack[CHANNELS.index("warped log depth")], stack[CHANNELS.index("prior log depth")]
    )


def test_answers_do_not_depend_on_earlier_calls():
    given, _ = inputs()
    other, _ = inputs(t=2)
    extrapolator = MotionWarpRefine(None, None)
    first = extrapolator(given).depth
    extrapolator(other)
    np.testing.assert_array_equal(extrapolator(given).depth, first)
    extrapolator.reset()
    np.testing.assert_array_equal(extrapolator(given).depth, first)


def test_images_of_other_sides_are_refused():
    given, _ = inputs()
    with pytest.raises(ValueError, match="multiples of 8"):
        MotionWarpRefine(None, None)(replace(given, camera=replace(given.camera, width=60)))


OPTIONS = {"motion": {"channels": [8, 8, 8]}, "refine": {"channels": [8, 8]}, "threshold": 0.5}


def test_both_networks_come_back_from_one_file(tmp_path):
    torch.manual_seed(0)
    networks = LearnedNetworks(**OPTIONS).eval()
    path = tmp_path / "ours.safetensors"
    write_weights(path, networks.state_dict(), Card("ours", ARCHITECTURE, OPTIONS))
    loaded = load_learned(path)
    assert loaded.threshold == 0.5 and loaded.events and loaded.warped and not loaded.training
    image = torch.randn(1, len(CHANNELS), 16, 16)
    with torch.no_grad():
        for name in ("motion", "refine"):
            torch.testing.assert_close(
                getattr(loaded, name)(image), getattr(networks, name)(image), rtol=0, atol=0
            )


def test_weights_of_another_shape_are_refused(tmp_path):
    path = tmp_path / "ours.safetensors"
    tensors = LearnedNetworks(**OPTIONS).state_dict()
    write_weights(path, tensors, Card("ours", ARCHITECTURE, {**OPTIONS, "refine": None}))
    with pytest.raises(ValueError, match=r"ours\.safetensors.*unexpected"):
        load_learned(path)
