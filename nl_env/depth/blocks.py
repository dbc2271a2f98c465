"""Blocks of pixels as the channels of one place, and back: folding between images and convolutions.

Full-resolution images have their channels one after the other; convolutions on a CPU want the channels of a
place side by side. ``pixel_unshuffle`` and ``pixel_shuffle`` do half of that way with strides; here it is
one pass over the memory, a band of rows at a time.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from nl_env.depth.threads import together

_BLOCK = 16
"""Places that are filled together: few enough for the fastest cache, enough to read whole lines."""


def folded_blocks(image: NDArray[np.float32], factor: int, threads: int = 1) -> NDArray[np.float32]:
    """``(N, H/f, W/f, C f f)`` from an image ``(N, C, H, W)``, channels in the order of ``pixel_unshuffle``.

    Args:
        image: float32, consecutive.
        factor: pixels along a block's side.
        threads: a band of rows to each.
    """
    count, channels, height, width = image.shape
    places = np.empty((count, height // factor, width // factor, channels * factor**2), np.float32)
    source, target, across = _in_pairs(image, places, factor)
    in_bands(lambda first, last: _fold(source, factor, across, first, last, target), len(places[0]), threads)
    return places


def unfolded_blocks(places: NDArray[np.float32], factor: int, threads: int = 1) -> NDArray[np.float32]:
    """``(N, C, f H, f W)`` from consecutive float32 ``(N, H, W, C f f)``: undoes :func:`folded_blocks`."""
    count, height, width, channels = places.shape
    image = np.empty((count, channels // factor**2, height * factor, width * factor), np.float32)
    in_bands(lambda first, last: unfold_rows(places, factor, first, last, image), height, threads)
    return image


def unfold_rows(
    places: NDArray[np.float32], factor: int, first: int, last: int, image: NDArray[np.float32]
) -> None:
    """Part of :func:`unfolded_blocks`: fill what rows ``first`` to before ``last`` of the places cover."""
    target, source, across = _in_pairs(image, places, factor)
    _unfold(source, factor, across, first, last, target)


def _in_pairs(
    image: NDArray[np.float32], places: NDArray[np.float32], factor: int
) -> tuple[NDArray[Any], NDArray[Any], int]:
    """Both as they can be copied with fewest steps, and what is then next to each other in a block's row.

    Neighbours in a row of a block are neighbours in both; two of them move as one number of twice the size.
    """
    if factor % 2:
        return image, places, factor
    return image.view(np.int64), places.view(np.int64), factor // 2


def in_bands(work: Callable[[int, int], None], rows: int, threads: int) -> None:
    """``work`` on all rows, from a first one to before a last one, a band to every thread."""
    edges = [k * rows // threads for k in range(threads + 1)]
    together([partial(work, first, last) for first, last in pairwise(edges)], threads)


@njit(cache=True, error_model="numpy", nogil=True)
def _fold(image, factor, across, first_row, last_row, out):  # type: ignore[no-untyped-def]
    """``(N, C, H, W)`` to some rows of ``(N, H/f, W/f, C f f)``; ``across`` values make a block's row."""
    size = factor * across
    for n in range(image.shape[0]):
        for y in range(first_row, last_row):
            for first in range(0, out.shape[2], _BLOCK):
                target = out[n, y, first : first + _BLOCK]
                for c in range(image.shape[1]):
                    for k in range(size):
                        source = image[n, c, y * factor + k // across, first * across + k % across :]
                        for x in range(target.shape[0]):
                            target[x, c * size + k] = source[x * across]


@njit(cache=True, error_model="numpy", nogil=True)
def _unfold(image, factor, across, first_row, last_row, out):  # type: ignore[no-untyped-def]
    """Some rows of ``(N, H, W, C f f)`` to ``(N, C, f H, f W)``; ``across`` as in :func:`_fold`."""
    size = factor * across
    for n in range(out.shape[0]):
        for y in range(first_row, last_row):
            for first in range(0, image.shape[2], _BLOCK):
                source = image[n, y, first : first + _BLOCK]
                for c in range(out.shape[1]):
                    for k in range(size):
                        target = out[n, c, y * factor + k // across, first * across + k % across :]
                        for x in range(source.shape[0]):
                            target[x * across] = source[x, c * size + k]
