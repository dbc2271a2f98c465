"""Exported networks through OpenVINO on the CPU: the fastest runtime here, and the one with bfloat16.

Models come as ONNX, not through ``openvino.convert_model``: that takes three times as long, and reports
its use over the network.
"""

from __future__ import annotations

import math
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import openvino

_COSTLY = 0.011
"""Share of a network's multiplications from which a convolution computes in bfloat16."""


class OpenVinoNetwork:
    """A network from the bytes of an ``.onnx`` file.

    Args:
        model, threads, names: as for :class:`nl_env.depth.runtime.onnx_file.OnnxNetwork`.
        bf16: compute in bfloat16 where the processor can, but for what gains little time by it.

    Attributes:
        shapes: shapes of its inputs.

    Raises:
        ImportError: OpenVINO is not installed.
        ValueError: the bytes are no network it can run.
    """

    def __init__(self, model: bytes, threads: int, bf16: bool, names: Sequence[str] = ()) -> None:
        try:
            import openvino
        except ImportError as cause:
            raise ImportError("runtime 'openvino' needs pip install 'nl-env[openvino]'") from cause
        settings = {
            "INFERENCE_NUM_THREADS": threads,
            "INFERENCE_PRECISION_HINT": "bf16" if bf16 else "f32",
            "PERFORMANCE_HINT": "LATENCY",
        }
        core = openvino.Core()
        try:
            network = core.read_model(model=model)
            if bf16:
                network = _keep_precise(core, network)
            compiled = core.compile_model(network, "CPU", settings)
        except RuntimeError as cause:
            raise ValueError(f"model: found no network OpenVINO can run ({cause})") from cause
        self._request = compiled.create_infer_request()
        self._used = {port.any_name for port in compiled.inputs}
        self._names = tuple(names) or tuple(port.any_name for port in compiled.inputs)
        self._outputs = len(compiled.outputs)
        self.shapes = [tuple(port.partial_shape.to_shape()) for port in compiled.inputs]

    def __call__(self, inputs: Sequence[NDArray[np.float32]]) -> list[NDArray[np.float32]]:
        named = zip(self._names, inputs, strict=True)
        results = self._request.infer(
            {name: array for name, array in named if name in self._used}, share_inputs=True
        )
        return [results[k] for k in range(self._outputs)]


def _keep_precise(core: openvino.Core, model: openvino.Model) -> openvino.Model:
    """``model`` with the mark "precise" on what stays in float32.

    That is everything but costly convolutions on images smaller than the largest that is convolved, and
    everything before the first costly convolution: little of the work, and much of the error in metres.
    Only files can hold such marks; Python has no other way to set them.
    """
    import openvino

    ops = model.get_ordered_ops()
    work = [_multiplications(op) for op in ops]
    if not any(work):
        return model
    costly = [each > _COSTLY * sum(work) for each in work]
    places = [_places(op) for op in ops]
    full = max(size for size, each in zip(places, work, strict=True) if each)
    smaller = [k for k, size in enumerate(places) if 1 < size < full]
    first, last = (smaller[0], smaller[-1]) if smaller else (0, -1)
    precise = {
        op.get_friendly_name()
        for k, op in enumerate(ops)
        if not costly[k] and op.get_type_name() != "Concat" and (k < costly.index(True) or first <= k <= last)
    }
    with tempfile.TemporaryDirectory() as folder:
        description, weights = Path(folder) / "model.xml", Path(folder) / "model.bin"
        openvino.serialize(model, description, weights)
        root = ET.parse(description).getroot()
        for layer in root.iter("layer"):
            if layer.get("name") not in precise or layer.get("type") in ("Const", "Parameter", "Result"):
                continue
            marks = layer.find("rt_info")
            if marks is None:
                marks = ET.Element("rt_info")
                layer.insert(0 if layer.find("data") is None else 1, marks)
            ET.SubElement(marks, "attribute", name="precise", version="0")
        return core.read_model(model=ET.tostring(root), weights=weights.read_bytes())


def _places(op: openvino.Node) -> int:
    """Pixels of a result that is images ``(N, C, H, W)``; 0 for anything else."""
    if op.get_type_name() in ("Constant", "Parameter", "Transpose", "Result") or not op.outputs():
        return 0
    shape = op.output(0).get_partial_shape()
    return math.prod(list(shape.to_shape())[2:]) if shape.is_static and len(shape) == 4 else 0


def _multiplications(op: openvino.Node) -> int:
    """Of a convolution for one image; 0 for other operations."""
    kind = op.get_type_name()
    if kind not in (
        "Convolution",
        "GroupConvolution",
        "ConvolutionBackpropData",
        "GroupConvolutionBackpropData",
    ):
        return 0
    image = op.input(0) if "Backprop" in kind else op.output(0)
    weights, places = (port.get_partial_shape().to_shape() for port in (op.input(1), image))
    return math.prod(weights) * math.prod(places[2:])
