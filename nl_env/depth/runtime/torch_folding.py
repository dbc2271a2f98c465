"""``pixel_unshuffle`` and ``pixel_shuffle`` for PyTorch on the CPU, by :mod:`nl_env.depth.blocks`."""

from __future__ import annotations

import torch
from torch import Tensor, fx
from torch.nn import functional

from nl_env.depth.blocks import folded_blocks, unfolded_blocks
from nl_env.depth.threads import usable_threads


def folded(image: Tensor, factor: int) -> Tensor:
    """``pixel_unshuffle`` of a float32 image ``(N, C, H, W)``, channels last."""
    height, width = image.shape[2] // factor, image.shape[3] // factor
    threads = usable_threads((height, width), torch.get_num_threads())
    places = folded_blocks(image.contiguous().numpy(), factor, threads)
    return torch.from_numpy(places).permute(0, 3, 1, 2)


def unfolded(image: Tensor, factor: int) -> Tensor:
    """``pixel_shuffle`` of a float32 image ``(N, C, H, W)`` with channels last, dense."""
    places = image.permute(0, 2, 3, 1).contiguous().numpy()
    threads = usable_threads((places.shape[1], places.shape[2]), torch.get_num_threads())
    return torch.from_numpy(unfolded_blocks(places, factor, threads))


def replace_foldings(module: fx.GraphModule) -> None:
    """Have ``module``, from :func:`nl_env.depth.runtime.tracing.traced`, fold with the functions above."""
    replaced = {
        functional.pixel_unshuffle: folded,
        torch.pixel_unshuffle: folded,
        functional.pixel_shuffle: unfolded,
        torch.pixel_shuffle: unfolded,
    }
    for node in module.graph.nodes:
        if node.op == "call_function" and node.target in replaced and len(node.meta["shape"]) == 4:
            node.args, node.kwargs = (*node.args, *node.kwargs.values()), {}
            node.target = replaced[node.target]
    module.recompile()
