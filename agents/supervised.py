"""What the supervised trainings of trigger policies share: options, trigger costs, and the way down.

:mod:`agents.value_training` learns from event statistics, :mod:`agents.picture_training` from pictures.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from nl_env.config import choice, number
from nl_env.observations import cost_coordinate

OBJECTIVES = ("reduction", "advantage", "clone", "planned")

Judged = TypeVar("Judged")
Progress = Callable[[int, float, float], None]
"""Called with the step, the mean loss since the last evaluation, and the criterion."""


@dataclass(frozen=True)
class ValueTraining:
    """How a value network is trained."""

    objective: str = "planned"
    """reduction, advantage, clone or planned."""
    hidden: tuple[int, ...] = (48, 24)
    """Widths of the hidden layers."""
    steps: int = 1200
    """Optimiser steps."""
    batch: int = 128
    """LiDAR intervals per step; all states of each."""
    learning_rate: float = 2e-3
    """Peak, reached after a tenth of the steps; a cosine brings it down to 0."""
    weight_decay: float = 1e-2
    """AdamW's."""
    dropout: float = 0.0
    """Share of activity inputs that are replaced by their mean in training."""
    cost_low: float = 1e-3
    """Lowest trigger cost, in units of reward."""
    cost_high: float = 3.0
    """Highest trigger cost."""
    error_scale: float = 0.05
    """The log_mae that costs as much as a trigger of cost 1; as the environment's."""
    evaluate_every: int = 100
    """Steps between evaluations on the validation decisions; the best is kept."""
    seed: int = 0
    """Of the initial weights and of the batches."""

    def validate(self) -> None:
        """Raise ``ValueError`` naming the option, what was found and what was expected."""
        choice("objective", self.objective, OBJECTIVES)
        number("steps", self.steps, 1, 10**7)
        number("batch", self.batch, 1, 10**6)
        number("learning_rate", self.learning_rate, 0.0, 1.0)
        number("weight_decay", self.weight_decay, 0.0, 10.0)
        number("dropout", self.dropout, 0.0, 0.9)
        number("cost_low", self.cost_low, 1e-4, self.cost_high)
        number("cost_high", self.cost_high, self.cost_low, 1e2)
        number("error_scale", self.error_scale, 1e-9, 1e9)
        number("evaluate_every", self.evaluate_every, 1, 10**7)

    @property
    def conditioned(self) -> bool:
        """Whether the network is told the trigger cost."""
        return self.objective != "reduction"


def draw_costs(options: ValueTraining, rng: torch.Generator) -> Tensor:
    """A trigger cost for every interval of a batch."""
    low, high = math.log(options.cost_low), math.log(options.cost_high)
    return torch.exp(low + (high - low) * torch.rand(options.batch, generator=rng))


def told(observations: Tensor, costs: Tensor) -> Tensor:
    """Observations ``(n, states, fields)`` with the costs ``(n,)`` as the last field."""
    shown = torch.from_numpy(np.asarray(cost_coordinate(costs.numpy())))
    return torch.cat([observations, shown[:, None, None].expand(-1, observations.shape[1], 1)], dim=-1)


def descend(
    network: nn.Module,
    options: ValueTraining,
    loss: Callable[[], Tensor],
    judge: Callable[[int], tuple[float, Judged]],
    progress: Progress,
) -> tuple[Judged, tuple[tuple[int, float, float], ...]]:
    """Train ``network`` in place; of all evaluations the one with the lowest criterion counts.

    Args:
        network: ends with the weights of the best evaluation.
        options: of the training.
        loss: of a batch that it draws itself.
        judge: ``step -> (criterion, what was found)``.
        progress: called after each evaluation.

    Returns:
        What was found at the best evaluation, and what ``progress`` was called with.
    """
    optimiser = torch.optim.AdamW(
        network.parameters(), lr=options.learning_rate, weight_decay=options.weight_decay
    )
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: _share_of_rate(step, options.steps))
    best: tuple[float, Judged] | None = None
    weights = network.state_dict()
    history, losses = [], []
    for step in range(1, options.steps + 1):
        error = loss()
        optimiser.zero_grad()
        error.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        losses.append(float(error.detach()))
        if step % options.evaluate_every == 0 or step == options.steps:
            criterion, found = judge(step)
            history.append((step, float(np.mean(losses)), criterion))
            progress(*history[-1])
            losses = []
            if best is None or criterion < best[0]:
                best, weights = (criterion, found), copy.deepcopy(network.state_dict())
    assert best is not None
    network.load_state_dict(weights)
    return best[1], tuple(history)


def _share_of_rate(step: int, steps: int) -> float:
    """Share of the peak learning rate at ``step`` (from 0 on) of ``steps``."""
    warm = max(1, steps // 10)
    return min((step + 1) / warm, 0.5 * (1 + math.cos(math.pi * step / steps)))
