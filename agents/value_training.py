"""Supervised training of :class:`agents.value_network.ValueNetwork` on enumerated decisions.

Objectives:

``"reduction"``
    Regress the error that a trigger saves at this very slice, which is what the greedy oracle knows.
``"advantage"``
    Regress the least total of the rest of the interval when holding now, minus that when triggering now, both
    followed by the best decisions in hindsight, at the given trigger cost.
``"clone"``
    Imitate the decision of the optimal oracle at the given trigger cost, in every state, also in those that
    the oracle avoids.
``"planned"``
    Minimise the expected total error and cost of the interval when the network itself decides, with the
    probability that its output gives. An interval has few states, so the expectation is summed exactly and
    differentiated; nothing is sampled and nothing is looked up in hindsight.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from agents.decisions import Decisions, states
from agents.supervised import ValueTraining, descend, draw_costs, told
from agents.value_network import ValueNetwork
from nl_env.curves import Curve, lower_hull
from nl_env.observations import cost_coordinate

VALIDATION_POINTS = 24
"""Operating points of the curve by which checkpoints are chosen."""


@dataclass(frozen=True)
class Evaluation:
    """A network's curve on validation decisions.

    Attributes:
        step: of the training.
        excess: mean over all frame rates of its error minus the oracle's.
        curve: lower hull of its operating points and both ends.
    """

    step: int
    excess: float
    curve: Curve


@dataclass(frozen=True)
class Trained:
    """The best network of a training and how it got there."""

    network: ValueNetwork
    best: Evaluation
    history: tuple[tuple[int, float, float], ...]
    """``(step, mean loss since the last, excess)`` at every evaluation."""


def train(
    data: Decisions,
    validation: Decisions,
    options: ValueTraining,
    progress: Callable[[int, float, float], None] = lambda step, loss, excess: None,
) -> Trained:
    """Train a network; of all evaluations the one with the least excess counts.

    Same data and options, same weights, on one machine and with one thread.

    Raises:
        ValueError: bad options, or decisions of different LiDAR periods.
    """
    options.validate()
    if data.period != validation.period:
        raise ValueError(f"validation: found period {validation.period}, expected {data.period}")
    rng = torch.Generator().manual_seed(options.seed)
    observations, errors = _with_mirror(data)
    network = _network(options, observations, errors, rng)
    floor = oracle_curve(validation)

    def loss() -> Tensor:
        chosen = torch.randint(len(errors), (options.batch,), generator=rng)
        costs = draw_costs(options, rng)
        return _loss(network, observations[chosen], errors[chosen], costs, options, rng)

    def judge(step: int) -> tuple[float, Evaluation]:
        found = evaluate(network, validation, floor, step)
        return found.excess, found

    best, history = descend(network, options, loss, judge, progress)
    return Trained(network.eval(), best, history)


def plan(errors: Tensor, price: Tensor, probabilities: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """What holding and triggering cost from every state on, to the end of the interval.

    Args:
        errors: ``(n, P, P)``, as :class:`agents.decisions.Decisions` has them.
        price: ``(n,)`` error that a trigger costs.
        probabilities: ``(n, states)`` of triggering, for what follows; None lets the best follow.

    Returns:
        ``(hold, trigger)``, ``(n, states)`` each; ``trigger`` includes its price.
    """
    period = errors.shape[1]
    places = {place: i for i, place in enumerate(states(period))}
    hold: list[Tensor] = [price] * len(places)
    trigger: list[Tensor] = [price] * len(places)
    after = [torch.zeros_like(price)] * period  # by offset of the frame that is held
    for k in range(period - 1, 0, -1):
        now = list(after)
        for h in range(k):
            i = places[k, h]
            hold[i] = errors[:, k, h] + after[h]
            trigger[i] = price + errors[:, k, k] + after[k]
            if probabilities is None:
                now[h] = torch.minimum(hold[i], trigger[i])
            else:
                now[h] = hold[i] + probabilities[:, i] * (trigger[i] - hold[i])
        after = now
    return torch.stack(hold, dim=1), torch.stack(trigger, dim=1)


def play_out(
    errors: NDArray[np.float64], triggers: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Total error over the offsets 1..P-1 and triggers, ``(n,)`` each, of decisions ``(n, states)``."""
    period, rows = errors.shape[1], np.arange(len(errors))
    first = np.array([k * (k - 1) // 2 for k in range(period)])  # the states of offset k follow each other
    held = np.zeros(len(errors), np.int64)
    total, count = np.zeros(len(errors)), np.zeros(len(errors), np.int64)
    for k in range(1, period):
        triggered = triggers[rows, first[k] + held]
        held = np.where(triggered, k, held)
        count += triggered
        total += errors[rows, k, held]
    return total, count


def oracle_curve(decisions: Decisions) -> Curve:
    """The least mean error at every mean number of triggers: the hull over prices of the best decisions."""
    errors = torch.from_numpy(np.nan_to_num(decisions.errors))
    points = []
    for price in np.geomspace(1e-6, 1.0, 100):
        hold, trigger = plan(errors, torch.full((len(errors),), price))
        points.append(_mean_point(decisions, (trigger < hold).numpy()))
    return _hull(decisions, points)


def evaluate(network: ValueNetwork, decisions: Decisions, floor: Curve, step: int) -> Evaluation:
    """Play ``decisions`` with a series of costs or thresholds and compare the curve with ``floor``."""
    network.eval()
    observations = torch.from_numpy(decisions.observations)
    with torch.inference_mode():
        if network.conditioned:
            low, high = network.cost_range
            chosen = [
                network(told(observations, torch.full((len(observations),), float(cost)))).numpy() > 0
                for cost in np.geomspace(low, high, VALIDATION_POINTS)
            ]
        else:
            scores = network(observations).numpy()
            chosen = [scores > t for t in np.quantile(scores, np.linspace(0, 1, VALIDATION_POINTS))]
    network.train()
    curve = _hull(decisions, [_mean_point(decisions, triggers) for triggers in chosen])
    low, high = float(floor.rate[0]), float(floor.rate[-1])
    excess = (curve.area(low, high) - floor.area(low, high)) / (high - low)
    return Evaluation(step, excess, curve)


def _mean_point(decisions: Decisions, triggers: NDArray[np.bool_]) -> tuple[float, float]:
    """Mean triggers per interval and mean error per slice."""
    total, count = play_out(decisions.errors, triggers)
    return float(count.mean()), float(total.mean()) / decisions.period


def _hull(decisions: Decisions, points: list[tuple[float, float]]) -> Curve:
    """Hull over triggers per interval of points and both ends."""
    every = np.ones((len(decisions.errors), len(states(decisions.period))), bool)
    ends = [_mean_point(decisions, ~every), _mean_point(decisions, every)]
    triggers, errors = np.array([*points, *ends]).T
    return lower_hull(triggers, errors)


def _network(
    options: ValueTraining, observations: Tensor, errors: Tensor, rng: torch.Generator
) -> ValueNetwork:
    """A fresh network that standardises its inputs; the draws come from ``rng`` alone."""
    unit = 1.0
    if not options.conditioned:
        unit = float((_diagonal(errors)).std())
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(torch.randint(2**62, (1,), generator=rng)))
        network = ValueNetwork(
            options.conditioned,
            options.hidden,
            unit,
            (options.cost_low, options.cost_high) if options.conditioned else (),
            options.error_scale,
        )
    flat = observations.reshape(-1, observations.shape[-1])
    fields = flat.shape[-1]
    network.mean[:fields] = flat.mean(dim=0)
    network.scale[:fields] = 1 / flat.std(dim=0).clamp_min(1e-3)
    if options.conditioned:
        low, high = (float(cost_coordinate(cost)) for cost in (options.cost_low, options.cost_high))
        network.mean[-1] = (low + high) / 2
        network.scale[-1] = math.sqrt(12) / max(high - low, 1e-3)
    return network


def _with_mirror(data: Decisions) -> tuple[Tensor, Tensor]:
    """Observations and errors, every drive also seen in a mirror."""
    both = [data, data.mirrored()]
    observations = np.concatenate([part.observations for part in both])
    errors = np.concatenate([part.errors for part in both])
    return torch.from_numpy(observations), torch.from_numpy(np.nan_to_num(errors)).float()


def _diagonal(errors: Tensor) -> Tensor:
    """``(n, states)`` error that a trigger saves at once."""
    return torch.stack([errors[:, k, h] - errors[:, k, k] for k, h in states(errors.shape[1])], dim=1)


def _loss(
    network: ValueNetwork,
    observations: Tensor,
    errors: Tensor,
    costs: Tensor,
    options: ValueTraining,
    rng: torch.Generator,
) -> Tensor:
    """Mean loss of one batch."""
    seen = told(observations, costs) if options.conditioned else observations
    if options.dropout:
        kept = torch.rand(len(seen), 1, seen.shape[-1], generator=rng) >= options.dropout
        kept[..., -1] |= options.conditioned
        seen = torch.where(kept, seen, network.mean)
    output = network(seen)
    if options.objective == "reduction":
        return torch.nn.functional.smooth_l1_loss(output, _diagonal(errors) / network.unit)
    return objective_loss(output, errors, costs, options)


def objective_loss(output: Tensor, errors: Tensor, costs: Tensor, options: ValueTraining) -> Tensor:
    """Mean loss of a network that is told the trigger cost and triggers where its output is above 0.

    Args:
        output: ``(n, states)``.
        errors: ``(n, P, P)``, as :class:`agents.decisions.Decisions` has them.
        costs: ``(n,)``.
        options: with the objective; ``reduction`` is here what a trigger saves at its slice, less its price.
    """
    price = costs * options.error_scale
    if options.objective == "planned":
        probabilities = torch.sigmoid(output)
        hold, trigger = plan(errors, price, probabilities)
        # The first state is where every interval starts. Dividing makes cheap and dear triggers count alike.
        total = hold[:, 0] + probabilities[:, 0] * (trigger[:, 0] - hold[:, 0])
        return (total / (price + PRICE_OFFSET)).mean()
    hold, trigger = plan(errors, price)
    gain = _diagonal(errors) - price[:, None] if options.objective == "reduction" else hold - trigger
    if options.objective == "clone":
        return torch.nn.functional.binary_cross_entropy_with_logits(output, (gain > 0).float())
    return torch.nn.functional.smooth_l1_loss(output, gain / (price + PRICE_OFFSET)[:, None])


PRICE_OFFSET = 2e-3
"""Totals are divided by the price plus this error, about what a trigger saves in slow traffic."""
