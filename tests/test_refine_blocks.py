"""The refinement network's convolutions in a runtime, and compiled loops around them, answer as it does."""

import pickle

import numpy as np
import pytest
import torch
from torch import nn

from nl_env.depth.features import CHANNELS
from nl_env.depth.learned_networks import run_refinement
from nl_env.depth.refine import RETURN, WARPED, BlockConvolutions, RefineNetwork
from nl_env.depth.refine_blocks import RefinementInBlocks
from nl_env.depth.runtime import NetworkRunner


def network(**options):
    torch.manual_seed(0)
    made = RefineNetwork((8, 8), **options).eval()
    nn.init.normal_(made.head.weight, std=0.5)
    nn.init.normal_(made.head.bias, std=0.5)
    return made


def stack(count=1, height=24, width=40, missing=0.3):
    """Random features of images with holes, one of them larger than the window around a pixel."""
    rng = np.random.default_rng(0)
    features = rng.normal(size=(count, len(CHANNELS), height, width)).astype(np.float32)
    features[:, RETURN] = rng.random((count, height, width)) >= missing
    features[:, RETURN, :14, :16] = 0
    return features


def expected(made, features):
    with torch.no_grad():
        return made(torch.from_numpy(features)).numpy()


def convolutions(made):
    def run(blocks):
        with torch.no_grad():
            return (BlockConvolutions(made)(torch.from_numpy(blocks)).numpy(),)

    return run


@pytest.mark.parametrize("missing", [0.0, 0.3, 1.0])
def test_the_answer_is_the_networks(missing):
    made, features = network(), stack(2, missing=missing)
    before = features.copy()
    (found,) = RefinementInBlocks(convolutions(made), 1)(features)
    np.testing.assert_allclose(found, expected(made, features), rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(features, before)
    assert found.dtype == np.float32 and found.flags.c_contiguous


def test_gates_may_be_wide_open_and_shut():
    made, features = network(), stack()
    with torch.no_grad():
        made.head.bias[4:8] = 5000  # of four pixels' first gate, and of their second
        made.head.bias[12:16] = -5000
    (found,) = RefinementInBlocks(convolutions(made), 1)(features)
    answer = expected(made, features)
    np.testing.assert_allclose(found, answer, rtol=1e-4, atol=1e-4)
    there = features[0, RETURN] > 0
    np.testing.assert_array_equal(found[0, 2][there], features[0, WARPED][there])


def test_the_answer_does_not_depend_on_threads(monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 8)
    monkeypatch.setattr("nl_env.depth.threads.WORTH", 1)
    run, features = convolutions(network()), stack(2)
    (alone,) = RefinementInBlocks(run, 1)(features)
    for threads in (2, 5):
        np.testing.assert_array_equal(RefinementInBlocks(run, threads)(features)[0], alone)


@pytest.mark.parametrize("runtime", ["openvino", "onnxruntime"])
def test_runtimes_are_given_the_convolutions_alone(runtime):
    pytest.importorskip(runtime)
    pytest.importorskip("onnx")
    made, features = network(), stack(2)
    run = run_refinement(made, runtime, threads=1)
    assert isinstance(run, RefinementInBlocks)
    (found,) = run(features)
    np.testing.assert_allclose(found, expected(made, features), rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(run))(features)[0], found)


@pytest.mark.parametrize(
    ("runtime", "options"), [("torch", {}), ("openvino", {"heads": 1}), ("openvino", {"fine": 8})]
)
def test_other_networks_run_whole(runtime, options):
    made, features = network(**options), stack()
    run = run_refinement(made, runtime, threads=1)
    assert isinstance(run, NetworkRunner)
    if runtime == "torch":
        np.testing.assert_allclose(run(features)[0], expected(made, features), rtol=1e-4, atol=1e-4)
