from pathlib import Path

import numpy as np
import pytest

from nl_env.depth.extrapolators import make_extrapolator
from nl_env.types import Camera, ExtrapolationInput

torch = pytest.importorskip("torch")
unet = pytest.importorskip("nl_env.depth.unet")

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
    safetensors = pytest.importorskip("safetensors.torch")
    path = tmp_path / "released.safetensors"
    safetensors.save_file(weights, path)
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


def test_wrong_weights_are_explained(weights, tmp_path):
    path = tmp_path / "other.pth"
    other = {"extra.weight": torch.zeros(1), **weights, "head.bias": torch.zeros(2)}
    del other["up1.up.bias"]
    torch.save(other, path)
    message = (
        r"missing: up1\.up\.bias; unexpected: extra\.weight; of another shape: head\.bias \(2,\) instead of"
    )
    with pytest.raises(ValueError, match=message):
        unet.load_released(path)
    torch.save([1, 2], path)
    with pytest.raises(ValueError, match="found list"):
        unet.load_released(path)
    for suffix in (".pth", ".safetensors"):
        broken = tmp_path / f"broken{suffix}"
        broken.write_bytes(b"not weights")
        with pytest.raises(ValueError, match=f"found no .*broken{suffix}"):
            unet.load_released(broken)
    with pytest.raises(FileNotFoundError, match="found no file"):
        unet.load_released(tmp_path / "nowhere.pth")


class Trap:
    def __reduce__(self):
        return (exec, ("raise SystemExit('unpickled')",))


def test_nothing_but_tensors_is_unpickled(tmp_path):
    path = tmp_path / "trap.pth"
    torch.save({"weight": Trap()}, path)
    with pytest.raises(ValueError, match="found no plain state dict"):
        unet.load_released(path)


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
