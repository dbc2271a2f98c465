"""Exported networks through OpenVINO on the CPU: the fastest runtime here, and the one with bfloat16.

Models come as ONNX, not through ``openvino.convert_model``: that takes three times as long, and reports
its use over the network.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


class OpenVinoNetwork:
    """A network from the bytes of an ``.onnx`` file.

    Args:
        model, threads, names: as for :class:`nl_env.depth.runtime.onnx_file.OnnxNetwork`.
        bf16: compute in bfloat16 where the processor can.

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
            compiled = core.compile_model(core.read_model(model=model), "CPU", settings)
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
