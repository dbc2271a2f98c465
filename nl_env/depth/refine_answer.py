"""From the refinement network's answer to depth frames, without PyTorch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nl_env.depth.features import LOG_CENTRE, LOG_SCALE
from nl_env.depth.threads import together


def depth_frames(
    answer: NDArray[np.float32], max_depth: float, threshold: float = 0.0, threads: int = 1
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depth frame and depth if there were a return, ``(H, W)`` float32 m, from an answer ``(3, H, W)``.

    Args:
        answer: of the network, for one image.
        max_depth: range, m; what the network puts there or beyond is no return.
        threshold: logit of a return from which there is one.
        threads: with two or more, both frames are made at once.
    """
    far = np.float32((np.log(max_depth) - LOG_CENTRE) / LOG_SCALE)
    code, logit, code_if = answer
    depth, depth_if = np.empty_like(code), np.empty_like(code_if)

    def with_holes() -> None:
        _to_metres(code, far, depth)
        depth[~((logit > threshold) & (code < far))] = 0

    together((with_holes, lambda: _to_metres(code_if, far, depth_if)), threads)
    return depth, depth_if


def _to_metres(code: NDArray[np.float32], far: np.float32, metres: NDArray[np.float32]) -> None:
    """Depths of the codes up to ``far``, in ``metres``."""
    np.minimum(code, far, out=metres)
    metres *= np.float32(LOG_SCALE)
    metres += np.float32(LOG_CENTRE)
    np.exp(metres, out=metres)
