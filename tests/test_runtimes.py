"""Runtimes give what the network gives, whatever executes it."""

import hashlib
import json
import operator
import pickle
import platform
import subprocess
import sys

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional

from nl_env.depth.runtime import NetworkRunner, compile_network, default_threads
from nl_env.depth.runtime.onnx_file import OnnxNetwork, load_onnx
from nl_env.depth.runtime.torch_cpu import limited_threads
from nl_env.depth.runtime.torch_folding import folded, unfolded
from nl_env.depth.runtime.tracing import traced

RUNTIMES = ("torch", "openvino", "onnxruntime")
REQUIRED = {"torch": ("torch",), "openvino": ("onnx", "openvino"), "onnxruntime": ("onnx", "onnxruntime")}
HEIGHT, WIDTH = 16, 24


class Everything(nn.Module):
    """Each kind of layer our networks have, two inputs and two outputs."""

    def __init__(self):
        super().__init__()
        self.stem = nn.Conv2d(3, 8, 3, padding=1, bias=False)
        self.norm = nn.BatchNorm2d(8)
        self.depthwise = nn.Conv2d(8, 8, 3, padding=1, groups=8, bias=False)
        self.depthwise_norm = nn.BatchNorm2d(8)
        self.pointwise = nn.Conv2d(8, 8, 1)
        self.down = nn.Conv2d(8, 16, 2, stride=2)
        self.up = nn.ConvTranspose2d(16, 8, 2, stride=2)
        self.up_norm = nn.BatchNorm2d(8)
        self.lone_norm = nn.BatchNorm2d(16)
        self.head = nn.Conv2d(16, 4, 3, padding=1)
        self.scale = nn.Parameter(torch.tensor(0.5))

    def forward(self, image, extra):
        if image.shape[-1] % 2:
            raise ValueError("image: expected an even width")
        count, _, height, width = image.shape
        x = functional.relu(self.norm(self.stem(torch.cat([image, extra], dim=1))))
        x = functional.relu(self.pointwise(self.depthwise_norm(self.depthwise(x))) + x)
        deep = functional.leaky_relu(self.down(functional.max_pool2d(x, 1)), 0.2)
        joined = self.lone_norm(torch.cat([self.up_norm(self.up(deep)), x], dim=1))
        first, second = self.head(joined).view(count, 4, height, width).split(2, dim=1)
        second = functional.pixel_shuffle(torch.cat([second] * 2, dim=1), 2)
        return functional.softplus(first) * self.scale.exp(), second


class StillRead(nn.Module):
    """Sums onto results that are read again afterwards."""

    def __init__(self):
        super().__init__()
        self.first, self.second, self.third = (nn.Conv2d(4, 4, 3, padding=1) for _ in range(3))

    def forward(self, x):
        a = self.first(x)
        b = self.second(x)
        total = functional.relu(self.third(a) + a)
        return total, a, b + a, b + b, functional.relu(b), x + self.first(b)


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def randomised(network):
    """The network with batch norms that do something."""
    generator = torch.Generator().manual_seed(1)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            for tensor in (module.weight.data, module.running_var):
                tensor.uniform_(0.5, 2.0, generator=generator)
            for tensor in (module.bias.data, module.running_mean):
                tensor.normal_(generator=generator)
    return network.eval()


@pytest.fixture
def network():
    torch.manual_seed(0)
    return randomised(Everything())


@pytest.fixture(scope="module")
def running():
    """The network by runtime, compiled once: the conversions take their time."""
    torch.manual_seed(0)
    network, made = randomised(Everything()), {}

    def run(runtime):
        if runtime not in made:
            made[runtime] = compiled(network, images(), runtime)
        return made[runtime]

    return run


def images(seed=0, height=HEIGHT):
    rng = np.random.default_rng(seed)
    return tuple(rng.standard_normal((1, channels, height, WIDTH)).astype(np.float32) for channels in (2, 1))


def eager(network, inputs):
    with torch.no_grad():
        outputs = network(*[torch.from_numpy(array) for array in inputs])
    return [output.numpy() for output in outputs]


def compiled(network, inputs, runtime, **options):
    for module in REQUIRED[runtime]:
        pytest.importorskip(module)
    return compile_network(network, inputs, runtime, threads=1, **options)


@pytest.mark.parametrize("runtime", RUNTIMES)
def test_every_runtime_gives_what_the_network_gives(network, running, runtime):
    run = running(runtime)
    for seed in (0, 1):
        found, expected = run(*images(seed)), eager(network, images(seed))
        assert [array.shape for array in found] == [(1, 2, HEIGHT, WIDTH), (1, 1, 2 * HEIGHT, 2 * WIDTH)]
        for one, other in zip(found, expected, strict=True):
            assert one.dtype == np.float32 and one.flags.c_contiguous
            np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("runtime", RUNTIMES)
def test_results_belong_to_the_caller(running, runtime):
    run = running(runtime)
    inputs = images()
    for array in inputs:
        array.flags.writeable = False
    first = run(*inputs)
    kept = [array.copy() for array in first]
    run(*images(1))
    for array, copy in zip(first, kept, strict=True):
        np.testing.assert_array_equal(array, copy)
        array[...] = np.nan
    for again, copy in zip(run(*inputs), kept, strict=True):
        np.testing.assert_array_equal(again, copy)


def test_an_input_handed_through_is_copied():
    class Through(nn.Module):
        def forward(self, x):
            return x, x[:, :1]

    (image, _) = images()
    whole, part = compiled(Through(), (image,), "torch")(image)
    np.testing.assert_array_equal(whole, image)
    np.testing.assert_array_equal(part, image[:, :1])
    assert not np.shares_memory(whole, image) and not np.shares_memory(part, image)


def test_sums_do_not_overwrite_what_is_read_later():
    torch.manual_seed(0)
    network = StillRead().eval()
    image = np.random.default_rng(0).standard_normal((1, 4, 8, 8)).astype(np.float32)
    for one, other in zip(compiled(network, (image,), "torch")(image), eager(network, (image,)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)


def test_without_fused_operators_results_are_the_same(network, running, monkeypatch):
    expected = running("torch")(*images())
    monkeypatch.setattr("nl_env.depth.runtime.torch_cpu.fusible", lambda: False)
    for one, other in zip(compiled(network, images(), "torch")(*images()), expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5)


def test_tracing_folds_the_batch_norms_behind_convolutions(network):
    network.train()
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    module, outputs = traced(network, [torch.from_numpy(array) for array in images()])
    norms = [node for node in module.graph.nodes if node.target is functional.batch_norm]
    assert len(norms) == 1  # the one behind a concatenation
    assert all(child.training for child in network.modules())
    assert all(torch.equal(tensor, before[name]) for name, tensor in network.state_dict().items())
    for one, other in zip(outputs, eager(network.eval(), images()), strict=True):
        np.testing.assert_array_equal(one.numpy(), other)
    network.head.weight.data.zero_()
    for one, other in zip(module(*map(torch.from_numpy, images())), outputs, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


class Folding(nn.Module):
    """A network that works on blocks of pixels, whose output is scaled, between full-resolution images."""

    def __init__(self, factor):
        super().__init__()
        self.factor = factor
        self.inner = nn.Conv2d(3 * factor**2, 8, 3, padding=1)
        self.outer = nn.Conv2d(8, 2 * factor**2, 3, padding=1)

    def forward(self, image):
        x = functional.relu(self.inner(functional.pixel_unshuffle(image, self.factor)))
        return functional.pixel_shuffle(0.1 * self.outer(x), self.factor) + image[:, :2]


@pytest.mark.parametrize("runtime", RUNTIMES)
@pytest.mark.parametrize(("factor", "width"), [(2, 48), (3, 57)])
def test_blocks_of_pixels_become_channels_and_pixels_again(runtime, factor, width):
    torch.manual_seed(0)
    network = Folding(factor).eval()
    image = np.random.default_rng(0).standard_normal((2, 3, 12, width)).astype(np.float32)
    (found,), expected = compiled(network, (image,), runtime)(image), np.stack(eager(network, (image,)))
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("factor", [1, 2, 3, 4])
def test_folding_is_what_pytorch_does_with_the_channels_of_a_pixel_side_by_side(factor):
    image = torch.randn(2, 3, 6 * factor, 19 * factor)
    there = folded(image, factor)
    assert torch.equal(there, functional.pixel_unshuffle(image, factor))
    assert there.is_contiguous(memory_format=torch.channels_last)
    back = unfolded(there, factor)
    assert torch.equal(back, image) and back.is_contiguous()


def test_tracing_folds_constant_factors_into_convolutions_that_nothing_else_reads():
    class Scaled(nn.Module):
        def __init__(self):
            super().__init__()
            self.first, self.second = nn.Conv2d(2, 4, 3), nn.Conv2d(4, 2, 1, bias=False)

        def forward(self, x):
            x = self.first(x)
            return 0.5 * x + x, self.second(x) * 3

    network, image = Scaled().eval(), torch.randn(1, 2, 8, 8)
    module, outputs = traced(network, [image])
    assert sum(node.target is operator.mul for node in module.graph.nodes) == 1
    for one, other in zip(module(image), network(image), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)
    assert torch.equal(outputs[1], network(image)[1])


def test_bf16_is_close_and_not_the_same(network):
    expected = eager(network, images())[0]
    (found, _) = compiled(network, images(), "openvino", precision="bf16")(*images())
    np.testing.assert_allclose(found, expected, rtol=0.1, atol=0.1)


def test_bf16_keeps_float32_before_the_first_costly_convolution_and_on_small_images():
    class Network(nn.Module):
        def __init__(self):
            super().__init__()
            self.enter = nn.Conv2d(1, 4, 1)
            self.wide = nn.Conv2d(4, 16, 3, padding=1)
            self.small = nn.Conv2d(16, 1, 1)
            self.up = nn.ConvTranspose2d(1, 1, 2, stride=2)
            self.leave = nn.Conv2d(1, 1, 1)

        def forward(self, x):
            small = self.small(functional.max_pool2d(functional.relu(self.wide(self.enter(x))), 2))
            return self.leave(self.up(small))

    openvino = pytest.importorskip("openvino")
    pytest.importorskip("onnx")
    from nl_env.depth.runtime.onnx_export import export_onnx
    from nl_env.depth.runtime.openvino_cpu import _keep_precise

    core = openvino.Core()
    image = np.zeros((1, 1, 16, 16), np.float32)
    model = core.read_model(model=export_onnx(Network().eval(), (image,)))
    marked = _keep_precise(core, model).get_ordered_ops()
    precise = [
        any("PrecisionConversion" in mark for mark in op.get_rt_info())
        for op in marked
        if "Convolution" in op.get_type_name()
    ]
    assert precise == [True, False, True, False, False]


def test_bf16_of_a_network_without_convolutions():
    class Sum(nn.Module):
        def forward(self, x):
            return x + 1

    image = np.ones((1, 1, 4, 4), np.float32)
    (found,) = compiled(Sum(), (image,), "openvino", precision="bf16")(image)
    np.testing.assert_array_equal(found, 2)


def test_a_runner_compiles_for_every_shape_and_pickles(network):
    runner = NetworkRunner(network, "torch", threads=1)
    first = runner(*images())
    taller = runner(*images(height=32))
    assert taller[0].shape == (1, 2, 32, WIDTH)
    for one, other in zip(pickle.loads(pickle.dumps(runner))(*images()), first, strict=True):
        np.testing.assert_array_equal(one, other)


def test_threads_are_capped_and_never_raised(monkeypatch):
    torch.set_num_threads(3)
    with limited_threads(2):
        assert torch.get_num_threads() == 2
    assert torch.get_num_threads() == 3
    torch.set_num_threads(1)
    with limited_threads(2):
        assert torch.get_num_threads() == 1
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert default_threads() == 1
    monkeypatch.setenv("OMP_NUM_THREADS", "many")
    assert default_threads() in (1, 2)


class Undecided(nn.Module):
    def forward(self, x):
        return x if x.sum() > 0 else -x


class Named(nn.Module):
    def forward(self, x):
        return {"depth": x}


@pytest.mark.parametrize("network", [Undecided(), Named()])
def test_networks_that_cannot_be_traced_are_refused(network):
    with pytest.raises(ValueError, match="network: "):
        compile_network(network, images()[:1], "torch")


def test_wrong_arguments_are_explained(network):
    with pytest.raises(ValueError, match=r"runtime: found 'tensorflow', expected one of auto, torch"):
        compile_network(network, images(), "tensorflow")
    with pytest.raises(ValueError, match=r"precision: found 'fp8' with runtime 'torch', expected fp32"):
        NetworkRunner(network, "torch", precision="fp8")
    with pytest.raises(ValueError, match=r"threads: found 0"):
        compile_network(network, images(), "torch", threads=0)
    with pytest.raises(ValueError, match=r"input 1: found float64"):
        compile_network(network, (images()[0], np.zeros(3)), "torch")
    run = compile_network(network, images(), "torch", threads=1)
    with pytest.raises(ValueError, match=r"inputs: found 1 arrays, expected 2"):
        run(images()[0])
    with pytest.raises(ValueError, match=r"input 0: found .*\(1, 2, 32, 24\), expected .*\(1, 2, 16, 24\)"):
        run(*images(height=32))
    with pytest.raises(ValueError, match=r"input 0: found float64"):
        run(*[array.astype(np.float64) for array in images()])


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_cuda_without_a_device_says_so(network):
    with pytest.raises(RuntimeError, match="no CUDA device"):
        compile_network(network, images(), "cuda")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize(("precision", "tolerance"), [("fp32", 1e-3), ("fp16", 3e-2)])
def test_cuda_gives_what_the_network_gives(network, precision, tolerance):
    run = compile_network(network, images(), "cuda", precision=precision)
    for seed in (0, 1):
        for one, other in zip(run(*images(seed)), eager(network, images(seed)), strict=True):
            np.testing.assert_allclose(one, other, rtol=tolerance, atol=tolerance)


@pytest.fixture
def exported(network, tmp_path):
    pytest.importorskip("openvino")
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    from nl_env.depth.runtime.onnx_export import export_onnx

    path = tmp_path / "network.onnx"
    path.write_bytes(export_onnx(network, images()))
    return path


def test_exported_networks_run_without_pytorch(network, exported, tmp_path):
    np.savez(tmp_path / "images.npz", *images())
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "import numpy as np; from nl_env.depth.runtime.onnx_file import load_onnx\n"
        "import nl_env.depth.extrapolators\n"
        "arrays = np.load('images.npz')\n"
        "for runtime in ('onnxruntime', 'openvino'):\n"
        "    run = load_onnx('network.onnx', runtime, threads=1)\n"
        "    np.savez(runtime, *run(*arrays.values()))\n"
    )
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True)
    for runtime in ("onnxruntime", "openvino"):
        with np.load(tmp_path / f"{runtime}.npz") as outputs:
            for one, other in zip(outputs.values(), eager(network, images()), strict=True):
                np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5)


def test_half_precision_stays_inside(network):
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    from nl_env.depth.runtime.onnx_export import export_onnx

    model = export_onnx(network, images(), half=True)
    assert len(model) < len(export_onnx(network, images()))
    for one, other in zip(OnnxNetwork(model, 1)(images()), eager(network, images()), strict=True):
        assert one.dtype == np.float32
        np.testing.assert_allclose(one, other, rtol=3e-2, atol=3e-2)


def test_inputs_the_network_ignores_may_be_given():
    class First(nn.Module):
        def forward(self, image, ignored):
            return 2 * image

    for runtime in RUNTIMES:
        (found,) = compiled(First(), images(), runtime)(*images())
        np.testing.assert_array_equal(found, 2 * images()[0])


def test_files_that_are_no_networks_are_refused(tmp_path):
    pytest.importorskip("onnxruntime")
    pytest.importorskip("openvino")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        load_onnx(tmp_path / "nowhere.onnx")
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"not a network")
    for runtime in ("onnxruntime", "openvino"):
        with pytest.raises(ValueError, match=r"broken\.onnx.*no network"):
            load_onnx(broken, runtime)
    with pytest.raises(ValueError, match="runtime: found 'torch', expected onnxruntime or openvino"):
        load_onnx(broken, "torch")


FAULTS = """
import json, resource, sys
from nl_env.depth.runtime.allocator import keep_large_blocks

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(4):
        b"x" * (40 << 20)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

before = faults()
told = keep_large_blocks()
b"x" * (40 << 20)
print(json.dumps([told, before, faults(), "torch" in sys.modules]))
"""


def faults(**environment):
    result = subprocess.run(
        [sys.executable, "-c", FAULTS], capture_output=True, text=True, check=True, env=environment
    )
    return json.loads(result.stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc's allocator alone is told anything")
def test_large_blocks_are_kept_unless_forbidden(monkeypatch):
    told, before, after, with_torch = faults()
    assert told and not with_torch
    if tuple(map(int, platform.libc_ver()[1].split("."))) >= (2, 35):
        assert after < before / 10
    told, _, _, _ = faults(NL_ENV_MALLOPT="0")
    assert not told


def test_processes_agree_to_the_byte(network, tmp_path):
    torch.save(network.state_dict(), tmp_path / "weights.pth")
    code = (
        "import hashlib, sys, torch; sys.path[:0] = sys.argv[2:]\n"
        "from test_runtimes import Everything, images\n"
        "from nl_env.depth.runtime import compile_network\n"
        "torch.set_num_threads(1); network = Everything()\n"
        "network.load_state_dict(torch.load(sys.argv[1], weights_only=True))\n"
        "outputs = compile_network(network.eval(), images(), 'torch')(*images())\n"
        "print(hashlib.sha256(b''.join(output.tobytes() for output in outputs)).hexdigest())\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "weights.pth"), *sys.path]
    digest = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    here = b"".join(output.tobytes() for output in compiled(network, images(), "torch")(*images()))
    assert digest == hashlib.sha256(here).hexdigest()
