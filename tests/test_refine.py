import numpy as np
import pytest
import torch
from torch.nn import functional

from nl_env.depth.features import CHANNELS, LOG_CENTRE, LOG_SCALE
from nl_env.depth.refine import RETURN, WARPED, RefineNetwork
from nl_env.depth.refine_answer import depth_frames

RANGE = 200.0


def code(metres):
    return (np.log(metres) - LOG_CENTRE) / LOG_SCALE


def stack(batch=1, height=16, width=24, seed=0):
    """Random features whose warped frame has depths from 2 to 90 m and a sky on top."""
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(batch, len(CHANNELS), height, width)).astype(np.float32)
    metres = rng.uniform(2, 90, (batch, height, width))
    metres[:, :4] = RANGE
    features[:, WARPED] = code(metres)
    features[:, RETURN] = metres < RANGE
    return torch.from_numpy(features), np.where(metres < RANGE, metres, 0)


@pytest.mark.parametrize("fine", [0, 8])
@pytest.mark.parametrize("heads", [1, 3])
def test_an_untrained_network_keeps_the_warped_frame(heads, fine):
    features, metres = stack()
    with torch.no_grad():
        answer = RefineNetwork((8, 8), fine=fine, heads=heads).eval()(features)[0].numpy()
    depth, depth_if = depth_frames(answer, RANGE)
    returned = metres[0] > 0
    np.testing.assert_allclose(depth_if[returned], metres[0][returned], rtol=1e-4)
    np.testing.assert_allclose(depth[returned], metres[0][returned], rtol=1e-4)
    np.testing.assert_array_equal(depth > 0, returned)
    if heads == 3:
        assert 10 < depth_if[~returned].min() <= depth_if[~returned].max() < 100


def test_while_training_it_also_tells_gates_and_free_changes():
    features, _ = stack()
    network = RefineNetwork((8, 8))
    torch.nn.init.normal_(network.head.weight, std=0.5)
    depth, _, depth_if, free, gate, free_if, gate_if = network(features)[0]
    base, returned = features[0, WARPED], features[0, RETURN] > 0
    torch.testing.assert_close(depth, base + torch.sigmoid(gate) * (free - base))
    expected = base + torch.sigmoid(gate_if) * (free_if - base)
    torch.testing.assert_close(depth_if[returned], expected[returned])
    torch.testing.assert_close(
        network.eval()(features)[0], torch.stack(list(network.train()(features)[0][:3]))
    )


def test_gates_and_changes_can_be_taught_to_move_depths_and_to_remove_returns():
    torch.manual_seed(0)
    network = RefineNetwork((16, 16))
    features, _ = stack(batch=4)
    base = features[:, WARPED]
    wrong = features[:, 4] > 0
    optimiser = torch.optim.Adam(network.parameters(), 3e-2)
    for _ in range(120):
        answer = network(features)
        gates = functional.binary_cross_entropy_with_logits(answer[:, 4], wrong.float())
        changes = ((answer[:, 3] - 0.5).abs() * wrong).mean()
        loss = gates + changes + torch.relu(1 + answer[:, 1]).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    with torch.no_grad():
        answer = network.eval()(features)
    wanted = torch.where(wrong, 0.5, base)
    assert (answer[:, 0] - wanted).abs().mean() < 0.4 * (base - wanted).abs().mean()
    depth, depth_if = depth_frames(answer[0].numpy(), RANGE)
    assert (depth == 0).mean() > 0.95 and depth_if.min() > 0


def test_depth_frames_read_range_and_threshold():
    answer = np.zeros((3, 1, 4), np.float32)
    answer[0] = code(np.array([10.0, 10.0, 199.9, 300.0]))
    answer[1] = [2.0, 0.5, 2.0, 2.0]
    answer[2] = code(np.array([12.0, 12.0, 250.0, 50.0]))
    depth, depth_if = depth_frames(answer, RANGE, threshold=1.0)
    np.testing.assert_allclose(depth[0], [10, 0, 199.9, 0], rtol=1e-5)
    np.testing.assert_allclose(depth_if[0], [12, 12, 200, 50], rtol=1e-5)
    assert depth.dtype == depth_if.dtype == np.float32


def test_one_head_means_no_return_from_the_range_on():
    features, _ = stack()
    answer = RefineNetwork((8, 8), heads=1).eval()(features)[0].detach().numpy()
    np.testing.assert_array_equal(answer[0], answer[2])
    assert answer[1].min() > 0


def test_any_size_of_multiples_of_eight_and_no_other_heads():
    network = RefineNetwork().eval()
    with torch.no_grad():
        for height, width in ((8, 16), (48, 64)):
            assert network(torch.zeros(2, len(CHANNELS), height, width)).shape == (2, 3, height, width)
    with pytest.raises(ValueError, match="heads"):
        RefineNetwork(heads=2)
    assert sum(parameter.numel() for parameter in network.parameters()) * 4 < 3e6
