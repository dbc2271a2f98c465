"""Exported networks through ONNX Runtime, and files of them. Nothing here needs PyTorch."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nl_env.depth.runtime.compiled import CompiledNetwork, check_choice, default_threads
from nl_env.depth.runtime.openvino_cpu import OpenVinoNetwork


class OnnxNetwork:
    """A network from the bytes of an ``.onnx`` file.

    Args:
        model: the file's bytes.
        threads: that it may use.
        names: of the inputs in the order of the arrays it will be called with; those that the model has
            no use for may be missing in it. Default: the model's own.

    Attributes:
        shapes: shapes of its inputs.

    Raises:
        ImportError: ONNX Runtime is not installed.
        ValueError: the bytes are no network it can run.
    """

    def __init__(self, model: bytes, threads: int, names: Sequence[str] = ()) -> None:
        try:
            import onnxruntime
            from onnxruntime.capi.onnxruntime_pybind11_state import Fail, InvalidGraph, InvalidProtobuf
        except ImportError as cause:
            raise ImportError("runtime 'onnxruntime' needs pip install 'nl-env[onnx]'") from cause
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        except (Fail, InvalidGraph, InvalidProtobuf) as cause:
            raise ValueError(f"model: found no network ONNX Runtime can run ({cause})") from cause
        inputs = self._session.get_inputs()
        self._names = tuple(names) or tuple(node.name for node in inputs)
        self._used = {node.name for node in inputs}
        self.shapes = [tuple(node.shape) for node in inputs]

    def __call__(self, inputs: Sequence[NDArray[np.float32]]) -> list[NDArray[np.float32]]:
        named = zip(self._names, inputs, strict=True)
        outputs: list[NDArray[np.float32]] = self._session.run(
            None, {name: array for name, array in named if name in self._used}
        )
        return outputs


def load_onnx(
    path: str | os.PathLike[str],
    runtime: str = "onnxruntime",
    *,
    threads: int | None = None,
    precision: str | None = None,
) -> CompiledNetwork:
    """The network of an ``.onnx`` file, such as ``scripts/export_onnx.py`` writes, without PyTorch.

    Args:
        path: a file with fixed shapes.
        runtime: ``"onnxruntime"`` (what ``"auto"`` means here) or ``"openvino"``.
        threads, precision: as in :func:`nl_env.depth.runtime.compile_network`.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file holds no network, or one without fixed shapes; a runtime or precision that
            there is not for files.
        ImportError: the runtime is not installed.
    """
    runtime = "onnxruntime" if runtime == "auto" else runtime
    if runtime not in ("onnxruntime", "openvino"):
        raise ValueError(
            f"runtime: found {runtime!r}, expected onnxruntime or openvino for exported networks"
        )
    runtime, precision = check_choice(runtime, precision)
    threads = default_threads() if threads is None else threads
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"model: found no file {str(path)!r}")
    model = path.read_bytes()
    network: OnnxNetwork | OpenVinoNetwork
    try:
        if runtime == "onnxruntime":
            network = OnnxNetwork(model, threads)
        else:
            network = OpenVinoNetwork(model, threads, bf16=precision == "bf16")
    except ValueError as cause:
        raise ValueError(f"{str(path)!r}: {cause}") from cause
    if not all(isinstance(side, int) for shape in network.shapes for side in shape):
        raise ValueError(f"{str(path)!r}: found input shapes {network.shapes}, expected numbers only")
    return CompiledNetwork(network, network.shapes, runtime, precision, threads)
