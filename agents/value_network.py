"""A small network that says what a trigger is worth in the state at hand, from event activity in numbers."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from agents.activity import STATISTICS_FIELDS


class ValueNetwork(nn.Module):
    """Standardised observations through a multilayer perceptron to one number.

    Args:
        conditioned: the trigger cost is the last number of the observation. The output is then a margin:
            trigger where it is above 0. Otherwise it is the error that a trigger saves.
        hidden: widths of the hidden layers.
        unit: what an output of 1 means; 1 for a margin, else an error.
        cost_range: lowest and highest trigger cost of the training, where it is conditioned.
        error_scale: the error that costs as much as a trigger of cost 1.
    """

    mean: Tensor
    scale: Tensor

    def __init__(
        self,
        conditioned: bool,
        hidden: Sequence[int] = (48, 24),
        unit: float = 1.0,
        cost_range: Sequence[float] = (),
        error_scale: float = 0.05,
    ) -> None:
        super().__init__()
        if not hidden or min(hidden) < 1:
            raise ValueError(f"hidden: found {hidden!r}, expected at least one width of at least 1")
        if not unit > 0 or (conditioned and len(cost_range) != 2):
            raise ValueError(
                f"network: found unit {unit!r} and cost_range {cost_range!r}, "
                "expected a positive unit and a pair of costs"
            )
        self.conditioned = conditioned
        self.unit = float(unit)
        self.cost_range = tuple(float(cost) for cost in cost_range)
        self.error_scale = float(error_scale)
        fields = STATISTICS_FIELDS + conditioned
        self.register_buffer("mean", torch.zeros(fields))
        self.register_buffer("scale", torch.ones(fields))
        widths = [fields, *hidden]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))
        self.last = nn.Linear(widths[-1], 1)

    def forward(self, observations: Tensor) -> Tensor:
        """``(..., fields)`` float32 to ``(...)``."""
        x = (observations - self.mean) * self.scale
        for layer in self.layers:
            x = torch.relu(layer(x))
        return self.last(x)[..., 0]


ARCHITECTURES = {"trigger-value": ValueNetwork}
