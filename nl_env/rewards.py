"""The reward: named components, summed in one place."""

from __future__ import annotations

import math


def components(error: float, error_scale: float, triggered: bool, trigger_cost: float) -> dict[str, float]:
    """The reward's parts.

    Args:
        error: error of the held depth frame, in the unit of its metric. NaN, as the paper's metrics
            give for an image without a single return, counts as no error.
        error_scale: the error that costs 1.
        triggered: whether this slice produced an extrapolated frame.
        trigger_cost: what an extrapolation costs.

    Returns:
        ``{"error": ..., "trigger": ...}``, both at most 0.
    """
    return {
        "error": 0.0 if math.isnan(error) else -error / error_scale,
        "trigger": -trigger_cost if triggered else 0.0,
    }


def total(parts: dict[str, float]) -> float:
    """The reward of one step."""
    return sum(parts.values())
