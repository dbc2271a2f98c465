"""Rounding convolutions' weights to bfloat16 so that smooth images keep their values.

Eight bits of mantissa leave every weight up to 0.4 % off. Rounded one by one, the nine weights of a 3x3
kernel then also have another sum, and an even surface comes out nearer or farther, layer after layer. Here
the error of every rounding is carried on to the next smaller weight of its kernel, so that the sum stays.
"""

from __future__ import annotations

import torch
from torch import Tensor, fx

from nl_env.depth.runtime.tracing import add_constant, constant, is_convolution, tidy


def round_kernels(module: fx.GraphModule) -> None:
    """Round the kernels of all convolutions larger than 1x1; a traced module, changed in place."""
    for conv in [node for node in module.graph.nodes if is_convolution(node)]:
        weight = constant(module, conv.args[1])
        if conv.target is torch.conv2d and weight[0, 0].numel() > 1:
            source, _, *rest = conv.args
            conv.args = (source, add_constant(module, conv, rounded(weight)), *rest)
    tidy(module)


def rounded(kernels: Tensor) -> Tensor:
    """Float32 kernels ``(..., K, K)`` with weights that bfloat16 holds and with the sums they had."""
    flat = kernels.flatten(-2)
    largest_first = flat.abs().argsort(dim=-1, descending=True, stable=True)
    wanted = flat.gather(-1, largest_first)
    found = torch.empty_like(wanted)
    carried = torch.zeros_like(wanted[..., 0])
    for k in range(wanted.shape[-1]):
        exact = wanted[..., k] + carried
        found[..., k] = exact.bfloat16().float()
        carried = exact - found[..., k]
    return torch.empty_like(flat).scatter_(-1, largest_first, found).view_as(kernels)
