"""Blocks of pixels to channels and back, for PyTorch on the CPU.

``pixel_unshuffle`` and ``pixel_shuffle`` stand between full-resolution images, whose channels lie one after
the other, and convolutions, which want the channels of a pixel side by side. PyTorch's own do one step of
that with strides, and somebody else has to do the other; here both happen in one pass over the memory.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise

import numpy as np
import torch
from numba import njit
from torch import Tensor, fx
from torch.nn import functional

from nl_env.depth.threads import together, usable_threads

_BLOCK = 16
"""Folded pixels that are filled together: few enough for the fastest cache, enough to read whole lines."""


def folded(image: Tensor, factor: int) -> Tensor:
    """``pixel_unshuffle`` of a dense float32 image ``(N, C, H, W)``, channels last."""
    count, channels, height, width = image.shape
    size = count, height // factor, width // factor, channels * factor**2
    dense, out = image.contiguous().numpy(), np.empty(size, np.float32)
    _in_bands(lambda first, last: _fold(dense, factor, first, last, out), size[1:3])
    return torch.from_numpy(out).permute(0, 3, 1, 2)


def unfolded(image: Tensor, factor: int) -> Tensor:
    """``pixel_shuffle`` of a float32 image ``(N, C, H, W)`` with channels last, dense."""
    count, channels, height, width = image.shape
    out = np.empty((count, channels // factor**2, height * factor, width * factor), np.float32)
    places = image.permute(0, 2, 3, 1).contiguous().numpy()
    _in_bands(lambda first, last: _unfold(places, factor, first, last, out), (height, width))
    return torch.from_numpy(out)


def _in_bands(work: Callable[[int, int], None], shape: tuple[int, int]) -> None:
    """``work`` on all rows, from a first one to before a last one, in as many threads as PyTorch has."""
    threads = usable_threads(shape, torch.get_num_threads())
    edges = [k * shape[0] // threads for k in range(threads + 1)]
    together([partial(work, first, last) for first, last in pairwise(edges)], threads)


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


@njit(cache=True, error_model="numpy", nogil=True)
def _fold(image, factor, first_row, last_row, out):  # type: ignore[no-untyped-def]
    """``(N, C, H, W)`` to some rows of ``(N, H/f, W/f, C f f)``."""
    channels = image.shape[1]
    for n in range(image.shape[0]):
        for y in range(first_row, last_row):
            for first in range(0, out.shape[2], _BLOCK):
                target = out[n, y, first : first + _BLOCK]
                for c in range(channels):
                    for k in range(factor**2):
                        source = image[n, c, y * factor + k // factor, first * factor + k % factor :]
                        for x in range(target.shape[0]):
                            target[x, c * factor**2 + k] = source[x * factor]


@njit(cache=True, error_model="numpy", nogil=True)
def _unfold(image, factor, first_row, last_row, out):  # type: ignore[no-untyped-def]
    """Some rows of ``(N, H, W, C f f)`` to ``(N, C, f H, f W)``."""
    channels = out.shape[1]
    for n in range(out.shape[0]):
        for y in range(first_row, last_row):
            for first in range(0, image.shape[2], _BLOCK):
                source = image[n, y, first : first + _BLOCK]
                for c in range(channels):
                    for k in range(factor**2):
                        target = out[n, c, y * factor + k // factor, first * factor + k % factor :]
                        for x in range(source.shape[0]):
                            target[x * factor] = source[x, c * factor**2 + k]
