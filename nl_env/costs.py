"""What a trigger costs: one number, or a range of which every episode draws its own cost."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from nl_env.config import number

COST_RANGE = (1e-4, 1e2)
"""Trigger costs that an observation can show."""
ANY_COST = (0.0, 1e9)
"""Trigger costs where no observation shows them."""

TriggerCost = float | tuple[float, float]


def check_trigger_cost(cost: Any, name: str = "trigger_cost") -> None:
    """Refuse what is no cost and no range of costs.

    Raises:
        ValueError: not a number in :data:`ANY_COST`, nor a pair ``(low, high)`` within :data:`COST_RANGE`.
    """
    if not isinstance(cost, (tuple, list)):
        number(name, cost, *ANY_COST)
        return
    if len(cost) != 2:
        raise ValueError(f"{name}: found {cost!r}, expected a number or a pair (lowest, highest)")
    for bound in cost:
        number(name, bound, *COST_RANGE)
    if cost[0] > cost[1]:
        raise ValueError(f"{name}: found {cost!r}, expected the lowest cost first")


def episode_cost(cost: TriggerCost, options: Mapping[str, Any], rng: np.random.Generator) -> float:
    """The cost of an episode that starts: given by ``options``, drawn from a range, or the only one.

    Raises:
        ValueError: ``options["trigger_cost"]`` is out of range.
    """
    if "trigger_cost" in options:
        given = options["trigger_cost"]
        number("options['trigger_cost']", given, *(COST_RANGE if isinstance(cost, tuple) else ANY_COST))
        return float(given)
    return draw_trigger_cost(cost, rng) if isinstance(cost, tuple) else cost


def draw_trigger_cost(costs: tuple[float, float], rng: np.random.Generator) -> float:
    """A cost between both of ``costs``, uniform in the logarithm; one draw of ``rng``."""
    low, high = costs
    return min(max(math.exp(rng.uniform(math.log(low), math.log(high))), low), high)
