"""A network as a flat list of tensor operations for one set of input shapes, batch norms folded.

Every runtime starts from this form: shape checks and Python branches are gone, and so are the batch norm
and the constant factor behind every convolution. The network given is never changed.
"""

from __future__ import annotations

import operator
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, fx, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_weights

_ARGUMENTS: dict[Any, dict[str, Any]] = {
    torch.conv2d: {"bias": None, "stride": 1, "padding": 0, "dilation": 1, "groups": 1},
    torch.conv_transpose2d: {
        "bias": None,
        "stride": 1,
        "padding": 0,
        "output_padding": 0,
        "groups": 1,
        "dilation": 1,
    },
    functional.batch_norm: {"weight": None, "bias": None, "training": False, "momentum": 0.1, "eps": 1e-5},
}
"""Optional arguments of the operations that are rewritten, in order, with their defaults."""


def traced(network: nn.Module, inputs: Sequence[Tensor]) -> tuple[fx.GraphModule, tuple[Tensor, ...]]:
    """The operations of ``network`` at the shapes of ``inputs``, and its outputs for them.

    Args:
        network: its ``forward`` takes tensors and returns a tensor or a tuple of tensors. It is run
            once, in evaluation mode.
        inputs: float32 tensors.

    Returns:
        A module of its own parameters, in evaluation mode, whose ``forward`` always returns a tuple and
        whose nodes have their results' shapes in ``meta["shape"]``; and the network's outputs.

    Raises:
        ValueError: the network branches on the values of a tensor or returns something else.
    """
    was_training = [module for module in network.modules() if module.training]
    network.eval()
    try:
        with torch.no_grad():
            tracer = _KnownShapes(inputs)
            graph = tracer.trace(network)
    except fx.proxy.TraceError as cause:
        raise ValueError(
            f"network: {type(network).__name__} looks at the values of its tensors, which no runtime can fix"
        ) from cause
    finally:
        for module in was_training:
            module.training = True
    values = tuple(tracer.values[node] for node in _returned(graph))
    graph_module = fx.GraphModule(tracer.constants, graph, type(network).__name__)
    fold_batch_norms(graph_module)
    fold_factors(graph_module)
    return graph_module.eval(), values


class _KnownShapes(fx.Tracer):
    """Traces with example values beside the proxies, so that shapes are numbers while tracing."""

    def __init__(self, inputs: Sequence[Tensor]) -> None:
        super().__init__()
        self.values: dict[fx.Node, Any] = {}
        self.constants: dict[str, Tensor] = {}
        self._readers: dict[int, tuple[Tensor, fx.Node]] = {}
        self._inputs = iter(inputs)

    def is_leaf_module(self, m: nn.Module, module_qualified_name: str) -> bool:
        """No module is kept whole: runtimes want to see every operation."""
        return False

    def getattr(self, attr: str, attr_val: Any, parameter_proxy_cache: dict[str, Any]) -> Any:
        """Parameters are plain tensors while tracing: what is computed from them alone is a constant."""
        return attr_val

    def create_arg(self, a: Any) -> Any:
        """A copy of every tensor that is no result of the graph becomes one of its constants."""
        if not isinstance(a, Tensor):
            return super().create_arg(a)
        if id(a) not in self._readers:
            name = f"constant_{len(self.constants)}"
            self.constants[name] = a.detach().clone()
            node = self.create_node("get_attr", name, (), {})
            self.values[node] = a
            self._readers[id(a)] = a, node
        return self._readers[id(a)][1]

    def proxy(self, node: fx.Node) -> fx.Proxy:
        """A proxy with the node's value for the example at hand."""
        if node.op == "placeholder":
            self.values[node] = next(self._inputs)
        else:
            args, kwargs = fx.node.map_arg((node.args, node.kwargs), self.values.__getitem__)
            if node.op == "call_method":
                self.values[node] = getattr(args[0], str(node.target))(*args[1:], **kwargs)
            else:
                assert callable(node.target)
                self.values[node] = node.target(*args, **kwargs)
        if isinstance(self.values[node], Tensor):
            node.meta["shape"] = tuple(self.values[node].shape)
        return _KnownProxy(node, self)


class _KnownProxy(fx.Proxy):
    """Answers everything about its shape and type with the example's."""

    def __getattr__(self, name: str) -> Any:
        value = self.tracer.values[self.node]  # type: ignore[attr-defined]
        if isinstance(value, Tensor):
            if name in ("shape", "ndim", "dtype", "device", "is_cuda", "requires_grad"):
                return getattr(value, name)
            if name in ("size", "dim", "numel"):
                return getattr(value, name)
        return super().__getattr__(name)

    def __len__(self) -> int:
        return len(self.tracer.values[self.node])  # type: ignore[attr-defined]

    def __iter__(self) -> Iterator[fx.Proxy]:
        parts: list[Any] = [operator.getitem(self, index) for index in range(len(self))]  # type: ignore[call-overload]
        return iter(parts)


def _returned(graph: fx.Graph) -> tuple[fx.Node, ...]:
    """Make the graph return a tuple of nodes, whatever it returned, and give these nodes."""
    end = list(graph.nodes)[-1]
    found = end.args[0]
    nodes = (found,) if isinstance(found, fx.Node) else found
    if not isinstance(nodes, (tuple, list)) or not all(isinstance(node, fx.Node) for node in nodes):
        raise ValueError(f"network: returned {found!r}, expected a tensor or a tuple of tensors")
    end.args = (tuple(nodes),)
    return tuple(nodes)


def constant(graph_module: fx.GraphModule, node: Any) -> Tensor:
    """The value that a node reads.

    Raises:
        ValueError: the node computes something.
    """
    if not isinstance(node, fx.Node) or node.op != "get_attr":
        raise ValueError(f"network: found {node!r}, expected constant weights")
    return graph_module.get_buffer(str(node.target))


def optional_constant(graph_module: fx.GraphModule, node: Any) -> Tensor | None:
    """As :func:`constant`, and None for None."""
    return None if node is None else constant(graph_module, node)


def add_constant(graph_module: fx.GraphModule, before: fx.Node, value: Tensor) -> fx.Node:
    """A new node in front of ``before`` that reads ``value``."""
    taken = [int(name.split("_")[1]) for name, _ in graph_module.named_buffers()]
    name = f"constant_{max(taken, default=-1) + 1}"
    graph_module.register_buffer(name, value.detach())
    with graph_module.graph.inserting_before(before):
        return graph_module.graph.get_attr(name)


def options(node: fx.Node) -> dict[str, Any]:
    """Optional arguments of a convolution or batch norm by name, however they were passed."""
    defaults = _ARGUMENTS[node.target]
    required = 3 if node.target is functional.batch_norm else 2
    return defaults | dict(zip(defaults, node.args[required:], strict=False)) | node.kwargs


def fold_batch_norms(graph_module: fx.GraphModule) -> None:
    """Fold every batch norm whose input is a convolution that nothing else reads into that convolution."""
    for node in [node for node in graph_module.graph.nodes if node.target is functional.batch_norm]:
        conv, mean, variance = node.args[:3]
        norm = options(node)
        if not is_convolution(conv) or len(conv.users) > 1 or norm["training"]:
            continue
        source, weight = conv.args[:2]
        folded = options(conv)
        new_weight, new_bias = fuse_conv_bn_weights(
            constant(graph_module, weight),
            optional_constant(graph_module, folded["bias"]),
            constant(graph_module, mean),
            constant(graph_module, variance),
            norm["eps"],
            optional_constant(graph_module, norm["weight"]),
            optional_constant(graph_module, norm["bias"]),
            transpose=conv.target is torch.conv_transpose2d,
        )
        folded["bias"] = add_constant(graph_module, conv, new_bias)
        conv.args = source, add_constant(graph_module, conv, new_weight), *folded.values()
        conv.kwargs = {}
        node.replace_all_uses_with(conv)
        graph_module.graph.erase_node(node)
    tidy(graph_module)


def fold_factors(graph_module: fx.GraphModule) -> None:
    """Fold every number that a convolution, which nothing else reads, is multiplied by into its weights."""
    for node in [node for node in graph_module.graph.nodes if node.target is operator.mul]:
        factors = [factor for factor in node.args if isinstance(factor, (int, float))]
        convolutions = [conv for conv in node.args if is_convolution(conv) and len(conv.users) == 1]
        if len(factors) != 1 or len(convolutions) != 1:
            continue
        ((factor,), (conv,)) = factors, convolutions
        source, weight = conv.args[:2]
        scaled = options(conv)
        bias = optional_constant(graph_module, scaled["bias"])
        scaled["bias"] = None if bias is None else add_constant(graph_module, conv, factor * bias)
        scaled_weight = add_constant(graph_module, conv, factor * constant(graph_module, weight))
        conv.args, conv.kwargs = (source, scaled_weight, *scaled.values()), {}
        node.replace_all_uses_with(conv)
        graph_module.graph.erase_node(node)
    tidy(graph_module)


def is_convolution(node: Any) -> bool:
    """Whether the node is a 2-D convolution, transposed ones included."""
    return isinstance(node, fx.Node) and node.target in (torch.conv2d, torch.conv_transpose2d)


def tidy(graph_module: fx.GraphModule) -> None:
    """Drop what nothing reads any more, nodes and constants, and compile the rest."""
    graph_module.graph.eliminate_dead_code()
    read = {node.target for node in graph_module.graph.nodes if node.op == "get_attr"}
    for name in [name for name, _ in graph_module.named_buffers() if name not in read]:
        delattr(graph_module, name)
    graph_module.recompile()
