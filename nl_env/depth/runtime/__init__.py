"""Networks in use: one image at a time, NumPy in and out, through PyTorch, CUDA, OpenVINO or ONNX Runtime.

Importing this package imports none of them; ``docs/runtimes.md`` says which is for what.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nl_env.depth.runtime.allocator import keep_large_blocks
from nl_env.depth.runtime.compiled import (
    PRECISIONS,
    RUNTIMES,
    Arrays,
    CompiledNetwork,
    Run,
    check_choice,
    default_threads,
)
from nl_env.depth.runtime.onnx_file import OnnxNetwork
from nl_env.depth.runtime.openvino_cpu import OpenVinoNetwork

if TYPE_CHECKING:
    from torch import nn

__all__ = [
    "PRECISIONS",
    "RUNTIMES",
    "CompiledNetwork",
    "NetworkRunner",
    "check_choice",
    "compile_network",
    "default_threads",
]


class NetworkRunner:
    """A network that is compiled when it is first called, once for each set of input shapes.

    Unlike :class:`CompiledNetwork` it pickles (what was compiled stays behind) and takes any shapes.

    Args: as :func:`compile_network`.
    """

    def __init__(
        self,
        network: nn.Module,
        runtime: str = "auto",
        *,
        threads: int | None = None,
        precision: str | None = None,
        keep_memory: bool = True,
    ) -> None:
        check_choice(runtime, precision)
        self.network = network
        self._options: dict[str, Any] = {
            "runtime": runtime,
            "threads": threads,
            "precision": precision,
            "keep_memory": keep_memory,
        }
        self._compiled: dict[tuple[tuple[int, ...], ...], CompiledNetwork] = {}

    def __call__(self, *inputs: NDArray[np.float32]) -> Arrays:
        """The network's outputs as float32 arrays that are the caller's."""
        shapes = tuple(array.shape for array in inputs)
        if shapes not in self._compiled:
            self._compiled[shapes] = compile_network(self.network, inputs, **self._options)
        return self._compiled[shapes](*inputs)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_compiled": {}}


def compile_network(
    network: nn.Module,
    example_inputs: Sequence[NDArray[np.float32]],
    runtime: str = "auto",
    *,
    threads: int | None = None,
    precision: str | None = None,
    keep_memory: bool = True,
) -> CompiledNetwork:
    """Prepare a network to be called on one kind of input, batch norms folded.

    Args:
        network: evaluated as it is now; later changes of its weights have no effect. Takes and returns
            tensors (one or a tuple of them).
        example_inputs: arrays of the shapes it will be called with; their values do not matter.
        runtime: ``"torch"``, ``"cuda"``, ``"openvino"``, ``"onnxruntime"``; ``"auto"`` is CUDA where there
            is a device and PyTorch's CPU code elsewhere.
        threads: at most this many; default :func:`default_threads`. PyTorch's own setting is never
            raised, so ``torch.set_num_threads(1)`` still holds.
        precision: ``"fp32"``; ``"bf16"`` with OpenVINO; CUDA computes in ``"fp16"`` unless told otherwise.
        keep_memory: on a CPU, have glibc keep freed blocks in this process
            (:func:`nl_env.depth.runtime.allocator.keep_large_blocks`).

    Raises:
        ValueError: unknown runtime, a precision the runtime does not have, inputs that are not float32
            or that the network refuses, or fewer than one thread.
        ImportError: the runtime is not installed.
        RuntimeError: ``"cuda"`` without a device.
    """
    runtime, precision = check_choice(runtime, precision)
    threads = default_threads() if threads is None else threads
    if threads < 1:
        raise ValueError(f"threads: found {threads}, expected at least 1")
    for k, example in enumerate(example_inputs):
        if example.dtype != np.float32:
            raise ValueError(f"input {k}: found {example.dtype}, expected float32")
    examples = [np.array(example, order="C") for example in example_inputs]
    shapes = [example.shape for example in examples]
    run: Run
    if keep_memory and runtime != "cuda":
        keep_large_blocks()
    if runtime == "torch":
        from nl_env.depth.runtime.torch_cpu import TorchNetwork

        run = TorchNetwork(network, examples, threads)
    elif runtime == "cuda":
        from nl_env.depth.runtime.cuda import CudaNetwork

        run = CudaNetwork(network, examples, half=precision == "fp16")
    else:
        from nl_env.depth.runtime.onnx_export import export_onnx

        names = [f"input_{k}" for k in range(len(examples))]
        model = export_onnx(network, examples, names)
        if runtime == "openvino":
            run = OpenVinoNetwork(model, threads, precision == "bf16", names)
        else:
            run = OnnxNetwork(model, threads, names)
    return CompiledNetwork(run, shapes, runtime, precision, threads)
