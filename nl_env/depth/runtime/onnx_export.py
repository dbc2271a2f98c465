"""Networks as ONNX models, for ONNX Runtime without PyTorch, for TensorRT and for others."""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, fx, nn

from nl_env.depth.runtime.tracing import traced

OPSET = 17


def export_onnx(
    network: nn.Module,
    example_inputs: Sequence[NDArray[np.float32]],
    input_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
    *,
    half: bool = False,
) -> bytes:
    """The network with its batch norms folded as an ONNX model of fixed shapes.

    Args:
        network, example_inputs: as in :func:`nl_env.depth.runtime.compile_network`.
        input_names, output_names: default ``input_0``, ... and ``output_0``, ...
        half: weights and arithmetic in float16; inputs and outputs stay float32.

    Raises:
        ImportError: the ``onnx`` package is not installed.
        ValueError: see :func:`nl_env.depth.runtime.tracing.traced`.
    """
    try:
        import onnx  # noqa: F401, the exporter's own message does not say how to get it
    except ImportError as cause:
        raise ImportError("exporting to ONNX needs 'onnx', pip install 'nl-env[onnx]'") from cause
    inputs = tuple(torch.from_numpy(np.array(example, order="C")) for example in example_inputs)
    module, outputs = traced(network, inputs)
    exported: nn.Module = _HalfInside(module) if half else module
    file = io.BytesIO()
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporter about its own future
        torch.onnx.export(
            exported,
            inputs,
            file,  # type: ignore[arg-type]  # the annotation forgets files that are open
            input_names=list(input_names or (f"input_{k}" for k in range(len(inputs)))),
            output_names=list(output_names or (f"output_{k}" for k in range(len(outputs)))),
            opset_version=OPSET,
            dynamo=False,
        )
    return file.getvalue()


class _HalfInside(nn.Module):
    """Computes in float16 between float32 inputs and outputs."""

    def __init__(self, module: fx.GraphModule) -> None:
        super().__init__()
        self.module = module.half()

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        return tuple(output.float() for output in self.module(*[x.half() for x in inputs]))
