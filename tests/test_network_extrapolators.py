"""Extrapolators made of files: weights with a card, and folders exported for ONNX Runtime."""

import json
import pickle
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

from nl_env.depth.extrapolators import NETWORKS, WEIGHTS, make_extrapolator
from nl_env.depth.learned import MotionWarpRefine
from nl_env.depth.learned_networks import ARCHITECTURE, LearnedNetworks
from nl_env.depth.unet import UNet, UNetOptions, unet_card
from nl_env.types import BatchExtrapolator
from nl_env.weight_files import Card, write_weights

OURS = {"motion": {"channels": [4, 4, 4]}, "refine": {"channels": [4, 4]}, "threshold": 0.25}


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(params=["paper", "ours"])
def weights(request, tmp_path):
    """A file of small random networks."""
    torch.manual_seed(0)
    path = tmp_path / "small.safetensors"
    if request.param == "paper":
        network = UNet(UNetOptions(channels=2, parallel_kernel=1, inputs="frame"))
        card = unet_card(network, "small")
    else:
        network, card = LearnedNetworks(**OURS), Card("small", ARCHITECTURE, OURS)
        for part in (network.motion, network.refine):
            torch.nn.init.normal_(part.head.weight, std=0.1)  # zero before training: no part would matter
    write_weights(path, network.state_dict(), card)
    return path


@pytest.fixture(scope="module")
def shown():
    from scripts.export_onnx import example

    return example("quarter")


def test_a_card_says_what_is_made_of_weights(weights, shown):
    extrapolator = make_extrapolator(weights, runtime="torch")
    made = extrapolator(shown)
    assert made.depth.shape == shown.camera.shape and made.depth.dtype == np.float32
    assert made.depth_if_return is not None and (made.depth_if_return > 0).all()
    again = pickle.loads(pickle.dumps(extrapolator))(shown)
    np.testing.assert_array_equal(again.depth, made.depth)
    prior = shown.lidar_frames[-1]
    assert np.abs(made.depth_if_return - prior).max() > 0.01  # the networks were asked


def test_several_frames_at_once_are_those_of_single_calls(weights, shown):
    earlier = replace(shown, t=shown.t - 20_000, bins=shown.bins[:-1])
    extrapolator = make_extrapolator(weights)
    assert isinstance(extrapolator, BatchExtrapolator)
    together = extrapolator.batch([earlier, shown, earlier])
    for one, found in zip([earlier, shown, earlier], together, strict=True):
        alone = extrapolator(one)
        np.testing.assert_allclose(found.depth_if_return, alone.depth_if_return, rtol=1e-5)
        assert np.mean(found.depth == 0) == pytest.approx(np.mean(alone.depth == 0), abs=1e-3)
    assert np.abs(together[0].depth_if_return - together[1].depth_if_return).max() > 1e-3


def test_true_poses_replace_the_motion_network(tmp_path, shown):
    torch.manual_seed(0)
    path = tmp_path / "small.safetensors"
    write_weights(path, LearnedNetworks(**OURS).state_dict(), Card("small", ARCHITECTURE, OURS))
    extrapolator = make_extrapolator(path, odometry=True)
    assert isinstance(extrapolator, MotionWarpRefine) and extrapolator.odometry
    assert not make_extrapolator(path).odometry


def test_an_exported_folder_answers_like_its_weights(weights, shown, tmp_path, capsys):
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    from scripts import export_onnx

    folder = tmp_path / "export"
    export_onnx.main(export_onnx.Args(str(weights), folder))
    assert "largest difference from PyTorch" in capsys.readouterr().out
    expected = make_extrapolator(weights, runtime="torch")(shown)
    exported = make_extrapolator(folder)
    found, again = exported.batch([shown, shown])
    np.testing.assert_array_equal(found.depth, again.depth)
    np.testing.assert_allclose(found.depth_if_return, expected.depth_if_return, rtol=1e-3, atol=1e-3)
    with pytest.raises(FileExistsError, match="holds an export"):
        export_onnx.main(export_onnx.Args(str(weights), folder))

    parts = sorted(folder.glob("*.onnx"))
    whole = parts[0].read_bytes()
    parts[0].write_bytes(whole[:-1])
    with pytest.raises(ValueError, match=f"{parts[0].name}.*another file"):
        make_extrapolator(folder)
    parts[0].unlink()
    with pytest.raises(FileNotFoundError, match=parts[0].name):
        make_extrapolator(folder)


@pytest.mark.parametrize("text", ["{", "[]", '{"architecture": "unet"}'])
def test_damaged_descriptions_are_refused(tmp_path, text):
    with pytest.raises(FileNotFoundError, match=r"no extrapolator\.json"):
        make_extrapolator(tmp_path)
    (tmp_path / "extrapolator.json").write_text(text)
    with pytest.raises(ValueError, match=r"extrapolator\.json"):
        make_extrapolator(tmp_path)


def test_parts_of_another_architecture_are_refused(tmp_path):
    from nl_env.depth.exported import Export

    export = Export("unet-paper", {}, [120, 160], "fp32", {"motion": ""}, "w.safetensors")
    (tmp_path / "extrapolator.json").write_text(json.dumps(asdict(export)))
    with pytest.raises(ValueError, match=r"'unet-paper' with \['motion'\]"):
        make_extrapolator(tmp_path)


def test_weights_of_other_networks_are_refused(tmp_path):
    path = tmp_path / "detector.safetensors"
    write_weights(path, {"weight": torch.zeros(1)}, Card("other", "keyframe-cnn"))
    with pytest.raises(ValueError, match=r"'keyframe-cnn'.*motion-warp-refine, unet-paper"):
        make_extrapolator(path)


def test_wrong_runtimes_fail_at_once(weights):
    with pytest.raises(ValueError, match=r"runtime: found 'tensorrt', expected one of auto"):
        make_extrapolator("repeat", runtime="tensorrt")
    with pytest.raises(ValueError, match=r"precision: found 'bf16' with runtime 'torch'"):
        make_extrapolator(weights, runtime="torch", precision="bf16")


@pytest.mark.parametrize("name", NETWORKS)
def test_missing_shipped_weights_are_named(name, monkeypatch, tmp_path):
    monkeypatch.setattr("nl_env.depth.extrapolators.WEIGHTS", tmp_path)
    assert WEIGHTS != tmp_path
    with pytest.raises(FileNotFoundError, match=rf"nl_env/weights/{name}\.safetensors.*repeat, linear"):
        make_extrapolator(name)
