import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch.nn import functional

from nl_env.depth import import_weights, unet
from nl_env.depth.extrapolators import make_extrapolator
from nl_env.types import Camera, ExtrapolationInput
from nl_env.weight_files import read_card, write_weights

RELEASED = Path(__file__).parents[2] / "shared" / "elidar" / "sunet2enresconv_best_model.pth"


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def weights():
    """A state dict with the released one's names and shapes, written out from the architecture's table."""
    generator = torch.Generator().manual_seed(0)
    tensors = {}

    def conv(name, *shape):
        tensors[f"{name}.weight"] = 0.1 * torch.randn(*shape, generator=generator)

    def norm(name, channels):
        tensors[f"{name}.weight"] = torch.ones(channels)
        tensors[f"{name}.bias"] = torch.zeros(channels)
        tensors[f"{name}.running_mean"] = torch.zeros(channels)
        tensors[f"{name}.running_var"] = torch.ones(channels)
        tensors[f"{name}.num_batches_tracked"] = torch.tensor(1)

    def separable(name, inputs, outputs):
        conv(f"{name}.depthwise", inputs, 1, 3, 3)
        norm(f"{name}.bn1", inputs)
        conv(f"{name}.pointwise", outputs, inputs, 1, 1)
        norm(f"{name}.bn2", outputs)

    def plain(name, inputs, outputs):
        conv(f"{name}.conv", outputs, inputs, 3, 3)
        norm(f"{name}.bn", outputs)

    def residual(name, inputs, outputs):
        plain(f"{name}.conv1", inputs, outputs)
        separable(f"{name}.conv2", outputs, outputs)
        plain(f"{name}.conv3", inputs, outputs)

    separable("event_stem", 5, 16)
    plain("depth_stem", 1, 16)
    encoder = ("down1", 32, 16), ("down2", 16, 32), ("down3", 32, 64), ("bottleneck", 64, 128)
    for name, inputs, outputs in encoder:
        residual(name, inputs, outputs)
    for name, inputs, outputs in (("up1", 128, 64), ("up2", 64, 32), ("up3", 32, 16)):
        conv(f"{name}.up", inputs, outputs, 2, 2)
        tensors[f"{name}.up.bias"] = torch.zeros(outputs)
        residual(f"{name}.conv", inputs, outputs)
    conv("head", 1, 16, 1, 1)
    tensors["head.bias"] = torch.zeros(1)
    return tensors


@pytest.fixture
def checkpoint(weights, tmp_path):
    path = tmp_path / "released.pth"
    torch.save(weights, path)
    return path


def test_released_state_dict_fits_strictly(weights, checkpoint):
    assert len(weights) == 194
    network = unet.load_released(checkpoint)
    assert not network.training
    loaded = network.state_dict()
    assert all(torch.equal(loaded[name], tensor) for name, tensor in weights.items())


def test_safetensors_load_the_same(weights, checkpoint, tmp_path):
    path = tmp_path / "released.safetensors"
    save_file(weights, path)
    depth, voxel = torch.rand(1, 1, 16, 24) * 50, torch.rand(1, 5, 16, 24)
    with torch.inference_mode():
        first, second = (unet.load_released(p)(depth, voxel) for p in (checkpoint, path))
    assert first.shape == (1, 1, 16, 24) and (first > 0).all()
    assert torch.equal(first, second)


def test_thirty_one_batch_norms_in_order(checkpoint):
    names = [name for name, _ in unet.batch_norms(unet.load_released(checkpoint))]
    assert len(names) == 31
    assert names[:3] == ["event_stem.bn1", "event_stem.bn2", "depth_stem.bn"]


def test_forward_joins_the_stems_and_the_skips(weights, checkpoint):
    # With every weight of the decoder's inputs from below zero, only the skip of full size is left, so
    # the output cannot see further than the first level's 3x3 convolutions reach (four pixels).
    tensors = dict(weights)
    tensors["up3.up.weight"] = torch.zeros_like(tensors["up3.up.weight"])
    torch.save(tensors, checkpoint)
    network = unet.load_released(checkpoint)
    depth, voxel = torch.zeros(1, 1, 32, 32), torch.zeros(1, 5, 32, 32)
    spot = depth.clone()
    spot[..., 16, 16] = 50
    for changed in ((spot, voxel), (depth, voxel + spot)):
        with torch.inference_mode():
            difference = (network(*changed) - network(depth, voxel)).abs()[0, 0]
        rows, columns = torch.nonzero(difference > 0, as_tuple=True)
        assert len(rows) > 9
        assert max((rows - 16).abs().max(), (columns - 16).abs().max()) <= 5


def test_extrapolator_reads_returns_out_of_the_depth(checkpoint, weights):
    camera = Camera.from_fov(16, 24, 70.0)
    prior = np.full(camera.shape, 20, np.float32)
    prior[:4] = 0
    bins = [np.ones((5, *camera.shape), np.int16)] * 2
    inputs = ExtrapolationInput(140_000, camera, 200.0, [prior], [100_000], bins)
    produced = make_extrapolator(checkpoint)(inputs)
    raw = produced.depth_if_return
    assert produced.depth.dtype == raw.dtype == np.float32 and produced.depth.shape == camera.shape
    assert (raw > 0).all() and (raw < 1).any()
    assert (produced.depth == np.where(raw < 1, 0, raw)).all()


def written_out(weights, depth, voxel):
    """The released network, straight from its tensors."""

    def norm(x, name):
        mean, variance = weights[f"{name}.running_mean"], weights[f"{name}.running_var"]
        scale = weights[f"{name}.weight"] / (variance + 1e-5).sqrt()
        return (x - mean[:, None, None]) * scale[:, None, None] + weights[f"{name}.bias"][:, None, None]

    def plain(x, name):
        return norm(functional.conv2d(x, weights[f"{name}.conv.weight"], padding=1), f"{name}.bn")

    def separable(x, name):
        x = functional.conv2d(x, weights[f"{name}.depthwise.weight"], padding=1, groups=x.shape[1])
        x = functional.conv2d(norm(x, f"{name}.bn1"), weights[f"{name}.pointwise.weight"])
        return norm(x, f"{name}.bn2")

    def residual(x, name):
        first = plain(x, f"{name}.conv1").relu()
        return (separable(first, f"{name}.conv2") + plain(x, f"{name}.conv3")).relu()

    def up(x, skip, name):
        x = functional.conv_transpose2d(x, weights[f"{name}.up.weight"], weights[f"{name}.up.bias"], stride=2)
        return residual(torch.cat([x, skip], 1), f"{name}.conv")

    x = torch.cat([separable(voxel, "event_stem").relu(), plain(depth, "depth_stem").relu()], 1)
    levels = []
    for name in ("down1", "down2", "down3"):
        levels.append(residual(x, name))
        x = functional.max_pool2d(levels[-1], 2)
    x = residual(x, "bottleneck")
    for name in ("up1", "up2", "up3"):
        x = up(x, levels.pop(), name)
    return functional.softplus(functional.conv2d(x, weights["head.weight"], weights["head.bias"]))


def test_output_is_that_of_the_architecture_written_out(weights, checkpoint):
    generator = torch.Generator().manual_seed(1)
    tensors = {
        name: tensor + 0.3 * torch.rand(tensor.shape, generator=generator)
        if tensor.is_floating_point() and tensor.dim() == 1
        else tensor
        for name, tensor in weights.items()
    }
    torch.save(tensors, checkpoint)
    depth = 60 * torch.rand(2, 1, 16, 24, generator=generator)
    voxel = torch.randn(2, 5, 16, 24, generator=generator)
    with torch.inference_mode():
        found = unet.load_released(checkpoint)(depth, voxel)
        expected = written_out(tensors, depth, voxel)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)


def outputs(network, depth, voxel):
    with torch.inference_mode():
        return network.eval()(depth, voxel)


@pytest.mark.parametrize("name", unet.VARIANTS)
def test_variants(name, tmp_path):
    options = unet.VARIANTS[name]
    torch.manual_seed(0)
    network = unet.UNet(options)
    path = tmp_path / "variant.safetensors"
    write_weights(path, network.state_dict(), unet.unet_card(network, name))
    again = unet.load_unet(path)
    assert again.options == options
    depth, voxel = 50 * torch.rand(1, 1, 16, 16), torch.randn(1, 5, 16, 16)
    expected = outputs(network, depth, voxel)
    assert torch.equal(outputs(again, depth, voxel), expected)
    # What a variant does not see changes nothing; what it sees does.
    moved = voxel.roll(1, dims=1)  # other bins, the same sum
    assert torch.allclose(outputs(network, depth, moved), expected, atol=1e-5) == (options.inputs != "voxel")
    assert torch.equal(outputs(network, depth, voxel + 1), expected) == (options.inputs == "none")
    assert not torch.equal(outputs(network, depth + 1, voxel), expected)


def test_variants_differ_where_they_should():
    sizes = {name: unet.UNet(options).state_dict() for name, options in unet.VARIANTS.items()}
    assert len(sizes["released"]) == len(sizes["paper"]) == 194
    assert sizes["paper"]["down2.conv3.conv.weight"].shape == (32, 16, 1, 1)
    assert sizes["event-frame"]["event_stem.depthwise.weight"].shape == (1, 1, 3, 3)
    assert sizes["data-concat"]["down1.conv1.conv.weight"].shape == (16, 6, 3, 3)
    assert sizes["without-events"]["down1.conv1.conv.weight"].shape == (16, 16, 3, 3)
    assert not [name for name in sizes["without-skip"] if "conv3" in name]


@pytest.mark.parametrize("change", [{"parallel_kernel": 5}, {"inputs": "images"}, {"fusion": "late"}])
def test_options_are_checked(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        unet.make_unet(**change)


def test_import_writes_a_card_and_the_same_network(checkpoint, tmp_path, monkeypatch, capsys):
    out = tmp_path / "new" / "imported.safetensors"
    monkeypatch.setattr(sys, "argv", ["import_weights", str(checkpoint), str(out)])
    import_weights.main()
    assert "largest difference in depth 0.0e+00 m" in capsys.readouterr().out
    depth, voxel = 50 * torch.rand(1, 1, 16, 24), torch.randn(1, 5, 16, 24)
    imported, original = unet.load_unet(out), unet.load_released(checkpoint)
    assert torch.equal(outputs(imported, depth, voxel), outputs(original, depth, voxel))
    assert read_card(out).training["imported_from"]["name"] == checkpoint.name
    with pytest.raises(SystemExit):
        import_weights.main()
    assert "is there already" in capsys.readouterr().err


def test_without_a_card_the_released_layout_is_assumed(weights, checkpoint):
    assert unet.load_unet(checkpoint).options == unet.RELEASED
    tensors = {name.replace("conv3", "conv4"): tensor for name, tensor in weights.items()}
    torch.save(tensors, checkpoint)
    with pytest.raises(ValueError, match=r"missing: bottleneck\.conv3.* and 34 more; unexpected"):
        unet.load_unet(checkpoint)


def test_shapes_are_checked(checkpoint):
    network = unet.load_released(checkpoint)
    with pytest.raises(ValueError, match=r"depth: found shape .*multiples of 8"):
        network(torch.zeros(1, 1, 20, 24), torch.zeros(1, 5, 20, 24))
    with pytest.raises(ValueError, match=r"voxel: found shape \(1, 4, 16, 24\)"):
        network(torch.zeros(1, 1, 16, 24), torch.zeros(1, 4, 16, 24))


@pytest.mark.skipif(not RELEASED.is_file(), reason="the released checkpoint is not beside this checkout")
def test_released_checkpoint_returns_its_prior_without_events():
    camera = Camera.from_fov(120, 160, 70.0)
    rows = np.arange(camera.height)[:, None] - camera.cy
    prior = np.where(rows > 10, 2.4 * camera.fy / np.maximum(rows, 1), 20) * np.ones((1, camera.width))
    prior = prior.astype(np.float32)
    network = unet.load_released(RELEASED)
    with torch.inference_mode():
        predicted = network(torch.from_numpy(prior)[None, None], torch.zeros(1, 5, *camera.shape))[
            0, 0
        ].numpy()
    off_edges = np.s_[10:-10, 10:-10]
    assert np.median(np.abs(predicted - prior)[off_edges]) < 0.5


@pytest.mark.skipif(not RELEASED.is_file(), reason="the released checkpoint is not beside this checkout")
def test_released_checkpoint_is_imported(tmp_path):
    out = tmp_path / "released.safetensors"
    assert import_weights.import_weights(RELEASED, out) <= 1e-5
    tensors = torch.load(RELEASED, map_location="cpu", weights_only=True)
    depth, voxel = 50 * torch.rand(1, 1, 32, 40), torch.randn(1, 5, 32, 40)
    with torch.inference_mode():
        expected = written_out(tensors, depth, voxel)
    torch.testing.assert_close(outputs(unet.load_unet(out), depth, voxel), expected, rtol=1e-5, atol=1e-5)
