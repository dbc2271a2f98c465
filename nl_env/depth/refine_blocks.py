"""What surrounds the refinement network's convolutions, in compiled loops, for runtimes that are slow at it.

OpenVINO and ONNX Runtime spend much of the network's time on its folding, slicing and averaging, in bfloat16
the larger part. So they are given the convolutions alone, with the
channels of a place side by side at both ends; what comes before and after happens here, in one pass each.
Answers are those of :class:`nl_env.depth.refine.RefineNetwork` but for rounding.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from nl_env.depth.blocks import folded_blocks, in_bands, unfold_rows
from nl_env.depth.features import CHANNELS
from nl_env.depth.threads import usable_threads

FOLD = 2
"""Blocks of 2x2 pixels become channels before the first convolution: the same work at a quarter of the
places, which trains and runs faster on a CPU than few channels at full resolution, and learns more."""

WARPED, RETURN = CHANNELS.index("warped log depth"), CHANNELS.index("warped return")

PARTS = (2, 2, 1)
"""Outputs per pixel: change and gate of either depth, and the return."""

AROUND = 9
"""Pixels across the window in which a missing return takes after its neighbours; a power of two and one."""

SOMEWHERE, LONELY = 0.5, 0.01
"""Coded log depth (about 40 m) of a missing return with no other around, and its weight against them."""

SURE = 4.0
"""Logit with which an untrained network keeps a return, or none."""

_REACH = AROUND // 2


class RefinementInBlocks:
    """A refinement network of three heads from its convolutions, for batches of features.

    Args:
        convolutions: ``(1, H/2, W/2, 4 C)`` blocks of features to ``(1, H/2, W/2, 20)``, in some runtime;
            see :class:`nl_env.depth.refine.BlockConvolutions`.
        threads: of what surrounds them, at most; the default is that of a network.
    """

    def __init__(
        self, convolutions: Callable[..., tuple[NDArray[np.float32], ...]], threads: int | None = None
    ) -> None:
        self._convolutions, self._threads = convolutions, threads

    def __call__(self, features: NDArray[np.float32]) -> tuple[NDArray[np.float32]]:
        """``(n, C, H, W)`` features to the answers ``(n, 3, H, W)``, which do not depend on the threads."""
        count, _, height, width = features.shape
        answers = np.empty((count, 3, height, width), np.float32)
        threads = usable_threads((height, width), self._threads)
        (outputs,) = self._convolutions(folded_blocks(np.ascontiguousarray(features), FOLD, threads))
        for seen, output, answer in zip(features, outputs, answers, strict=True):
            _answer(seen, output[None], answer, threads)
        return (answers,)


def _answer(
    seen: NDArray[np.float32], output: NDArray[np.float32], answer: NDArray[np.float32], threads: int
) -> None:
    """Fill ``answer`` from the features of one image and the convolutions' output for it."""
    _, height, width = answer.shape
    planes = np.empty((1, sum(PARTS), height, width), np.float32)

    def work(first: int, last: int) -> None:
        unfold_rows(output, FOLD, first, last, planes)
        rows = slice(first * FOLD, last * FOLD)
        with np.errstate(over="ignore"):  # a gate that is shut
            for gate in (planes[0, 1, rows], planes[0, 3, rows]):
                np.exp(np.negative(gate, out=gate), out=gate)
        _change(seen[WARPED], seen[RETURN], planes[0], rows.start, rows.stop, answer)

    in_bands(work, height // FOLD, threads)


@njit(cache=True, error_model="numpy", nogil=True)
def _change(base, returned, planes, first_row, last_row, answer):  # type: ignore[no-untyped-def]
    """Some rows of the answer, from the warped frame and what changes it; gates as ``exp(-logit)``.

    The sums of the window's columns stand in two rows with a margin, so that all loops run on vectors.
    """
    height, width = base.shape
    totals, counts = np.empty(width + 2 * _REACH, np.float32), np.empty(width + 2 * _REACH, np.float32)
    one, per_window = np.float32(1), np.float32(1 / AROUND**2)
    lonely, somewhere = np.float32(LONELY), np.float32(LONELY * SOMEWHERE)
    for y in range(first_row, last_row):
        totals[:] = 0
        counts[:] = 0
        for row in range(max(y - _REACH, 0), min(y + _REACH + 1, height)):
            code, there = base[row], returned[row]
            for x in range(width):
                totals[x + _REACH] += code[x] * there[x]
                counts[x + _REACH] += there[x]
        code, there = base[y], returned[y]
        change, shut, logit = planes[0, y], planes[1, y], planes[4, y]
        change_if, shut_if = planes[2, y], planes[3, y]
        depth, is_return, depth_if = answer[0, y], answer[1, y], answer[2, y]
        for x in range(width):
            total, count = totals[x], counts[x]
            for k in range(1, AROUND):
                total += totals[x + k]
                count += counts[x + k]
            around = (total * per_window + somewhere) / (count * per_window + lonely)
            filled = there[x] * code[x] + (one - there[x]) * around
            depth[x] = code[x] + change[x] / (one + shut[x])
            depth_if[x] = filled + change_if[x] / (one + shut_if[x])
            is_return[x] = logit[x] + np.float32(SURE) * (there[x] + there[x] - one)
