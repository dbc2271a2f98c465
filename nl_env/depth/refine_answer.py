"""From the refinement network's answer to depth frames, without PyTorch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nl_env.depth.features import LOG_CENTRE, LOG_SCALE


def depth_frames(
    answer: NDArray[np.float32], max_depth: float, threshold: float = 0.0
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depth frame and depth if there were a return, ``(H, W)`` float32 m, from an answer ``(3, H, W)``.

    Args:
        answer: of the network, for one image.
        max_depth: range, m; what the network puts there or beyond is no return.
        threshold: logit of a return from which there is one.
    """
    far = np.float32((np.log(max_depth) - LOG_CENTRE) / LOG_SCALE)
    code, logit, code_if = answer
    metres, metres_if = (
        np.exp(np.minimum(each, far) * np.float32(LOG_SCALE) + np.float32(LOG_CENTRE))
        for each in (code, code_if)
    )
    return np.where((logit > threshold) & (code < far), metres, np.float32(0)), metres_if
