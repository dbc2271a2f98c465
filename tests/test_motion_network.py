import numpy as np
import pytest
import torch

from nl_env.depth import motion_network, twist
from nl_env.depth.features import CHANNELS, EVENTS, INVERSE_SCALE
from nl_env.depth.motion import se3_exp
from nl_env.depth.motion_network import MotionNetwork
from nl_env.types import Camera

CAMERA = Camera.from_fov(48, 64, 70.0)
SMALL = np.array([0.002, -0.001, 0.03, 3e-4, -1e-4, 2e-4])


def stack(seed=0):
    """Features of a slanted ground below a sky; only the inverse depth is read here."""
    rows = np.arange(CAMERA.height)[:, None] + np.zeros(CAMERA.shape)
    features = np.random.default_rng(seed).normal(size=(len(CHANNELS), *CAMERA.shape)).astype(np.float32)
    features[twist.WARPED_INVERSE] = INVERSE_SCALE * np.maximum(rows - 15, 0) * 0.004
    return features


def test_the_jacobian_is_the_flow_of_a_small_motion():
    inverse = twist.cell_inverse(stack())
    jacobian = twist.flow_jacobian(CAMERA, inverse)
    step = 1e-5
    for place in ((2, 3), (7, 12), (11, 0)):
        x = (place[1] * 4 + 1.5 - CAMERA.cx) / CAMERA.fx
        y = (place[0] * 4 + 1.5 - CAMERA.cy) / CAMERA.fy
        w = max(inverse[place], 1e-9)
        for k in range(6):
            moved = se3_exp(step * np.eye(6)[k]) @ np.array([x / w, y / w, 1 / w, 1])
            flow = (moved[:2] / moved[2] - (x, y)) * (CAMERA.fx, CAMERA.fy) / step
            np.testing.assert_allclose(jacobian[(*place, slice(None), k)], flow, rtol=1e-3, atol=1e-3)


def drifts_of(jacobian, wanted, sharp=50.0):
    """Cells with edges in all directions whose bins drift exactly as the motion ``wanted`` makes them."""
    flow = jacobian @ wanted
    sums = np.zeros((5, *flow.shape[:2]), np.float32)
    sums[0] = sums[2] = sharp
    sums[3], sums[4] = sharp * flow[..., 0], sharp * flow[..., 1]
    return sums


def answers(weight, scale=1.0, shape=(12, 16)):
    return np.stack([np.full(shape, weight), np.full(shape, scale)]).astype(np.float32)


@pytest.mark.parametrize("gap", [0.02, 0.1, 0.5])
def test_drifts_give_the_motion_that_makes_them(gap):
    jacobian = twist.flow_jacobian(CAMERA, twist.cell_inverse(stack()))
    found = twist.solve_twist(answers(1e9), drifts_of(jacobian, SMALL), jacobian, gap)
    np.testing.assert_allclose(found, SMALL, rtol=1e-2, atol=1e-6)
    twice = twist.solve_twist(answers(1e9, 2.0), drifts_of(jacobian, SMALL), jacobian, gap)
    np.testing.assert_allclose(twice, 2 * SMALL, rtol=1e-2, atol=1e-6)


def test_without_weight_or_edges_nothing_changes_and_what_moves_by_itself_can_be_left_out():
    jacobian = twist.flow_jacobian(CAMERA, twist.cell_inverse(stack()))
    drifts = drifts_of(jacobian, SMALL)
    np.testing.assert_array_equal(twist.solve_twist(answers(0.0), drifts, jacobian, 0.1), 0)
    np.testing.assert_array_equal(twist.solve_twist(answers(1e9), 0 * drifts, jacobian, 0.1), 0)
    drifts[3:, 5:8, 5:8] = 1000.0
    believed = answers(1e9)
    assert np.abs(twist.solve_twist(believed, drifts, jacobian, 0.1) - SMALL).max() > 1e-2
    believed[0, 5:8, 5:8] = 0.0
    np.testing.assert_allclose(
        twist.solve_twist(believed, drifts, jacobian, 0.1), SMALL, rtol=1e-2, atol=1e-6
    )


def test_drift_is_the_flow_of_a_pattern_across_the_bins():
    """A smooth pattern shifts by a tenth of a pixel per bin: half a pixel over the gap."""
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
    seen = stack()
    for k in range(5):
        shift = 0.1 * (k - 2)
        seen[EVENTS.start + k] = np.sin((x - shift) / 3) + np.cos((y + 2 * shift) / 4)
    xx, xy, yy, xd, yd = twist.drift(seen)[:, 2:-2, 2:-2].sum((1, 2))
    found = np.linalg.solve([[xx, xy], [xy, yy]], [xd, yd])
    np.testing.assert_allclose(found, [0.5, -1.0], rtol=0.05)


def test_batches_are_solved_as_single_images_are():
    stacks = np.stack([stack(0), stack(1)])
    stacks[1, twist.WARPED_INVERSE] *= 0.5
    gaps = np.array([0.05, 0.5], np.float32)
    said = np.random.default_rng(2).uniform(0.1, 2, (2, 2, 12, 16)).astype(np.float32)
    inverse = motion_network.cell_inverse(torch.from_numpy(stacks))
    jacobian = motion_network.flow_jacobian(CAMERA, inverse)
    drifts = np.stack([twist.drift(each) for each in stacks])
    solved = motion_network.solve_twist(
        torch.from_numpy(said), torch.from_numpy(drifts), jacobian, torch.from_numpy(gaps)
    )
    for image in range(2):
        single = twist.flow_jacobian(CAMERA, twist.cell_inverse(stacks[image]))
        np.testing.assert_allclose(jacobian[image], single, rtol=1e-4, atol=1e-4)
        found = twist.solve_twist(said[image], drifts[image], single, float(gaps[image]))
        np.testing.assert_allclose(solved[image], found, rtol=1e-3, atol=1e-6)
        motion = np.eye(4)
        motion[2, 3] = -1.0
        corrected = twist.corrected(motion, said[image], stacks[image], CAMERA, float(gaps[image]))
        np.testing.assert_allclose(corrected, se3_exp(found) @ motion)


def test_an_untrained_network_believes_all_cells_alike():
    network = MotionNetwork((8, 8, 8)).eval()
    with torch.no_grad():
        answer = network(torch.from_numpy(stack())[None])[0].numpy()
    assert answer.shape == (2, 12, 16) and np.ptp(answer[0]) == 0 and (answer[1] == 1).all()
