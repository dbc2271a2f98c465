"""Networks on a CUDA device: half precision, channels last, one captured graph of all kernels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from nl_env.depth.runtime.tracing import traced

_WARM_UP = 3


class CudaNetwork:
    """A network captured as a CUDA graph, replayed on fixed memory at every call.

    Raises:
        RuntimeError: no CUDA device.
    """

    def __init__(self, network: nn.Module, examples: Sequence[NDArray[np.float32]], half: bool) -> None:
        if not torch.cuda.is_available():
            raise RuntimeError("runtime 'cuda': found no CUDA device that PyTorch can use")
        dtype = torch.float16 if half else torch.float32
        device = torch.device("cuda")
        source = next((parameter.device for parameter in network.parameters()), torch.device("cpu"))
        module, _ = traced(network, [torch.from_numpy(example).to(source) for example in examples])
        for name, value in list(module.named_buffers()):
            module.register_buffer(name, _placed(value, device, dtype))
        self._inputs = [_placed(torch.from_numpy(example), device, dtype) for example in examples]
        self._outputs: tuple[Tensor, ...] = ()
        with torch.inference_mode():
            stream = torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                for _ in range(_WARM_UP):
                    module(*self._inputs)
            torch.cuda.current_stream().wait_stream(stream)
            self._graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(self._graph):
                self._outputs = module(*self._inputs)

    def __call__(self, inputs: Sequence[NDArray[np.float32]]) -> list[NDArray[np.float32]]:
        with torch.inference_mode():
            for held, array in zip(self._inputs, inputs, strict=True):
                held.copy_(torch.from_numpy(array))
            self._graph.replay()
            return [output.float().cpu().numpy() for output in self._outputs]


def _placed(tensor: Tensor, device: torch.device, dtype: torch.dtype) -> Tensor:
    layout = torch.channels_last if tensor.ndim == 4 else torch.contiguous_format
    return tensor.to(device, dtype).contiguous(memory_format=layout)
