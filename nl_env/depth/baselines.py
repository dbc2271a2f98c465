"""The paper's model-free baselines (its section "End-to-end evaluation"): repeat, linear, exponential.

Each predicts a pixel from the same pixel of the last LiDAR frames. A pixel without a return in any of
them has no trend to follow and keeps the last frame's value. Depths at or beyond the range come out as
the range and so read as "no return"; a trend that falls through zero ends at 1e-8 m, the floor of the
paper's metrics ("touching"), not at 0, which would mean "no return".
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FLOOR = np.float32(1e-8)


def repeat(last: NDArray[np.float32]) -> NDArray[np.float32]:
    """The last LiDAR frame ``(H, W)`` itself, not copied."""
    return last


def linear(
    previous: NDArray[np.float32], last: NDArray[np.float32], period: float, gap: float, max_depth: float
) -> NDArray[np.float32]:
    """A straight line through time per pixel, ``d_{t+gap} = a d_t + b`` fitted to the last two frames.

    Args:
        previous, last: ``(H, W)`` float32 m, 0 = no return.
        period: time from ``previous`` to ``last``, s.
        gap: time from ``last`` to the wanted frame, s.
        max_depth: sensor range, m.

    Returns:
        ``(H, W)`` float32 m in [1e-8, max_depth], holes as in ``last``.
    """
    share = np.float32(gap / period)
    return _kept_holes(last + (last - previous) * share, previous, last, max_depth)


def exponential(
    previous: NDArray[np.float32], last: NDArray[np.float32], period: float, gap: float, max_depth: float
) -> NDArray[np.float32]:
    """``d_{t+gap} = a exp(gap d_t)``, the paper's formula as it stands, with times in seconds.

    ``a`` makes the formula reproduce the last frame from the one before,
    ``a = d_t exp(-period d_{t-1})``, so a still pixel decays as ``exp((gap - period) d)``: far
    surfaces rush towards the sensor. The exponent is not dimensionless, yet this reading is the one
    with an error like the published one (far above Repeat's in every metric).

    Args and returns as :func:`linear`.
    """
    exponent = np.float32(gap) * last - np.float32(period) * previous
    with np.errstate(over="ignore"):
        grown = last * np.exp(exponent)
    return _kept_holes(grown, previous, last, max_depth)


def _kept_holes(
    predicted: NDArray[np.float32],
    previous: NDArray[np.float32],
    last: NDArray[np.float32],
    max_depth: float,
) -> NDArray[np.float32]:
    both = (previous > 0) & (last > 0)
    return np.where(both, np.clip(predicted, FLOOR, np.float32(max_depth)), last)
