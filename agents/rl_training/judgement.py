"""What a network is worth on validation sequences, by the kind of its training."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch

from agents.rl_networks import TriggerNetwork
from agents.rl_training.validation import Validation, means, play_together
from nl_env.evaluation import DECIDING_METRIC
from nl_env.types import SLICE_US

COSTS = 12
"""Trigger costs that a conditioned network is validated at."""
HALVINGS = 14


@dataclass(frozen=True)
class Verdict:
    """Of one network.

    Attributes:
        criterion: the lower, the better; comparable within a training.
        scalars: for the log.
        metrics: for the card, JSON-ready.
    """

    criterion: float
    scalars: dict[str, float]
    metrics: dict[str, Any]


class Judge(Protocol):
    """Judges networks of one kind; may calibrate them."""

    def __call__(self, network: TriggerNetwork, validation: Validation) -> Verdict: ...


class ByRegret:
    """A network that is told the cost: its whole curve, by its regret."""

    def __call__(self, network: TriggerNetwork, validation: Validation) -> Verdict:
        low, high = network.cost_range
        costs = [float(cost) for cost in np.geomspace(low, high, COSTS)]
        points = play_together(network, validation.traces, costs)
        regret = validation.regret(points)
        scalars = {"regret": regret}
        for cost, rate, error in zip(costs, points.rate.mean(axis=1), points.error.mean(axis=1), strict=True):
            scalars |= {f"rate_hz/{cost:.3g}": float(rate), f"{DECIDING_METRIC}/{cost:.3g}": float(error)}
        curve = {"trigger_cost": [round(cost, 6) for cost in costs], **means(points)}
        return Verdict(regret, scalars, {"regret": round(regret, 5), "curve": curve})


class ByCost:
    """A network for one trigger cost: what holding and triggering cost per slice."""

    def __init__(self, trigger_cost: float, error_scale: float) -> None:
        self._trigger_cost = trigger_cost
        self._error_scale = error_scale

    def __call__(self, network: TriggerNetwork, validation: Validation) -> Verdict:
        points = play_together(network, validation.traces)
        rate, error = float(points.rate.mean()), float(points.error.mean())
        lidar_hz = float(validation.ends.rate.mean(axis=1).min())
        triggers = (rate - lidar_hz) * SLICE_US / 1e6
        criterion = error / self._error_scale + self._trigger_cost * triggers
        scalars = {"cost_per_slice": criterion, "rate_hz": rate, DECIDING_METRIC: error}
        return Verdict(criterion, scalars, {**means(points), "cost_per_slice": round(criterion, 6)})


class ByErrorAtRate:
    """A network for one frame rate: its error once its last bias keeps that rate; sets the bias.

    Decisions change one by one with the bias, so the rate is the target or the next that is not above it.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz

    def __call__(self, network: TriggerNetwork, validation: Validation) -> Verdict:
        before = play_together(network, validation.traces)
        low, high = -64.0, 64.0
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            rate = play_together(network, validation.traces, biases=[middle]).rate.mean()
            low, high = (low, middle) if rate > self._rate_hz else (middle, high)
        with torch.no_grad():
            network.last.bias.add_(low)
        points = play_together(network, validation.traces)
        rate, error = float(points.rate.mean()), float(points.error.mean())
        scalars = {DECIDING_METRIC: error, "rate_hz": rate, "trained_rate_hz": float(before.rate.mean())}
        return Verdict(error, scalars, {**means(points), "target_hz": self._rate_hz, "bias": round(low, 6)})
