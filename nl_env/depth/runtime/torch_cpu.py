"""Networks on the CPU with PyTorch alone: channels last, and what follows a convolution done inside it.

Convolutions become calls of the oneDNN operators PyTorch's own compiler uses: weights are reordered once,
and a ReLU, or a sum and its ReLU, is applied while the result is still in registers. Results differ from
the network's own by rounding only (about 1e-4 m).
"""

from __future__ import annotations

import operator
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, fx, nn
from torch.nn import functional

from nl_env.depth.runtime.torch_folding import folded, replace_foldings
from nl_env.depth.runtime.tracing import add_constant, constant, options, tidy, traced

_RELUS = (functional.relu, torch.relu, "relu")
_SUMS = (operator.add, torch.add, "add")


class TorchNetwork:
    """A traced and fused network; see :func:`nl_env.depth.runtime.compile_network`."""

    def __init__(self, network: nn.Module, examples: Sequence[NDArray[np.float32]], threads: int) -> None:
        with limited_threads(threads):
            self._module, _ = traced(network, [torch.from_numpy(example) for example in examples])
            replace_foldings(self._module)
            if fusible():
                fuse(self._module)
        self._dense = [_is_folded(node) for node in self._module.graph.find_nodes(op="placeholder")]
        self._threads = threads

    def __call__(self, inputs: Sequence[NDArray[np.float32]]) -> list[NDArray[np.float32]]:
        with limited_threads(self._threads), torch.inference_mode():
            tensors = [torch.from_numpy(array) for array in inputs]
            placed = [
                tensor if dense else _channels_last(tensor)
                for tensor, dense in zip(tensors, self._dense, strict=True)
            ]
            return [output.numpy() for output in self._module(*placed)]


@contextmanager
def limited_threads(threads: int) -> Iterator[None]:
    """PyTorch uses at most this many threads meanwhile; fewer if it was set to fewer."""
    before = torch.get_num_threads()
    if before <= threads:
        yield
        return
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def fusible() -> bool:
    """Whether this PyTorch has the fused oneDNN operators."""
    return torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_convolution_pointwise")


def fuse(module: fx.GraphModule) -> None:
    """Replace every 2-D convolution, with what directly follows it, by one call.

    What follows is fused if nothing else reads the convolution: a ReLU, a leaky ReLU, or the sum with
    something of the same shape, and its ReLU.

    Args:
        module: from :func:`nl_env.depth.runtime.tracing.traced`; changed in place.
    """
    graph = module.graph
    for conv in [node for node in graph.nodes if node.target is torch.conv2d]:
        option = options(conv)
        if isinstance(option["padding"], str) or len(conv.meta["shape"]) != 4:
            continue
        source, weight = conv.args[:2]
        geometry = [*(_pair(option[name]) for name in ("padding", "stride", "dilation")), option["groups"]]
        packed = torch.ops.mkldnn._reorder_convolution_weight(
            constant(module, weight).to(memory_format=torch.channels_last),
            *geometry,
            list(source.meta["shape"]),
        )
        call = [source, add_constant(module, conv, packed), option["bias"], *geometry]
        follower = _only_reader(conv)
        if follower is not None and _sums_same_shapes(follower):
            _fuse_sum(graph, conv, follower, call)
        else:
            _fuse_activation(graph, conv, follower, call)
    tidy(module)


def _fuse_activation(graph: fx.Graph, conv: fx.Node, follower: fx.Node | None, call: list[Any]) -> None:
    name, scalars, replaced = "none", [], [conv]
    if follower is not None and follower.target in _RELUS:
        name, replaced = "relu", [follower, conv]
    elif follower is not None and follower.target is functional.leaky_relu:
        slope = [*follower.args[1:2], follower.kwargs.get("negative_slope", 0.01)][0]
        name, scalars, replaced = "leaky_relu", [slope], [follower, conv]
    _replace(graph, replaced, torch.ops.mkldnn._convolution_pointwise.default, (*call, name, scalars, ""))


def _fuse_sum(graph: fx.Graph, conv: fx.Node, total: fx.Node, call: list[Any]) -> None:
    """The convolution added to the other summand, in place where nothing else reads that."""
    (other,) = [summand for summand in total.args if summand is not conv]
    assert isinstance(other, fx.Node)
    follower = _only_reader(total)
    relu = follower is not None and follower.target in _RELUS
    replaced = [follower, total, conv] if follower is not None and relu else [total, conv]
    how: tuple[Any, ...] = ("add", 1.0, "relu" if relu else None, [], "")
    if _only_reader(other) is total and _is_fresh(other):
        _replace(graph, replaced, torch.ops.mkldnn._convolution_pointwise_.binary, (other, *call, *how))
    else:
        source, *rest = call
        arguments = (source, other, *rest, *how)
        _replace(graph, replaced, torch.ops.mkldnn._convolution_pointwise.binary, arguments)


def _replace(graph: fx.Graph, nodes: list[fx.Node], target: Any, arguments: tuple[Any, ...]) -> None:
    """Put one call where the first of ``nodes`` (last in the graph) was; the others had no other reader."""
    with graph.inserting_before(nodes[0]):
        fused = graph.call_function(target, arguments)
    fused.meta = dict(nodes[0].meta)
    nodes[0].replace_all_uses_with(fused)
    for node in nodes:
        graph.erase_node(node)


def _sums_same_shapes(node: fx.Node) -> bool:
    """Whether the node is a plain sum of two different results of the same four-dimensional shape."""
    summands = node.args
    return (
        node.target in _SUMS
        and not node.kwargs
        and len(summands) == 2
        and summands[0] is not summands[1]
        and all(
            isinstance(summand, fx.Node) and summand.meta.get("shape") == node.meta["shape"]
            for summand in summands
        )
    )


def _is_fresh(node: fx.Node) -> bool:
    """Whether the node's result is memory of its own."""
    fused = torch.ops.mkldnn._convolution_pointwise.default
    return node.target in (torch.conv2d, torch.conv_transpose2d, fused)


def _only_reader(node: fx.Node) -> fx.Node | None:
    """The node that alone reads this one."""
    readers = list(node.users)
    return readers[0] if len(readers) == 1 else None


def _is_folded(node: fx.Node) -> bool:
    """Whether the node is an image that is folded before any convolution sees it."""
    return any(reader.target is folded for reader in node.users)


def _pair(value: Any) -> list[int]:
    return [value, value] if isinstance(value, int) else list(value)


def _channels_last(tensor: Tensor) -> Tensor:
    return tensor.contiguous(memory_format=torch.channels_last) if tensor.ndim == 4 else tensor
