"""Supervised training of trigger networks on pictures of the events, from stored traces.

The same decisions and objectives as in :mod:`agents.value_training`; what is seen is ``obs_mode="dict"``,
with the memory of :mod:`agents.pictures`, in place of event statistics.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from agents.decisions import collect, states
from agents.pictures import MAGNITUDES, POOL, picture, with_memory
from agents.rl_networks import TriggerNetwork
from agents.rl_training.judgement import ByRegret, Verdict
from agents.rl_training.validation import Validation
from agents.supervised import ValueTraining, descend, draw_costs, told
from agents.value_training import objective_loss
from nl_env.observations import STATE_FIELDS, cost_coordinate
from nl_env.traces import SequenceTrace

BLOCK = 64
"""Images that are made into pictures together."""


@dataclass(frozen=True)
class PictureDecisions:
    """Decision states of n LiDAR intervals of P slices, in the order of :func:`agents.decisions.states`.

    Attributes:
        pictures: ``(n, P - 1, 2, h, w)`` int8 of :func:`agents.pictures.picture`, of the slices between LiDAR
            frames.
        state: ``(n, P (P - 1) / 2, 4)`` float32, the observation's.
        errors: ``(n, P, P)`` float64, as :class:`agents.decisions.Decisions` has them.
    """

    pictures: NDArray[np.int8]
    state: NDArray[np.float32]
    errors: NDArray[np.float64]

    @classmethod
    def of(cls, traces: Sequence[SequenceTrace]) -> PictureDecisions:
        """The decisions of all whole LiDAR intervals of ``traces``; ``ValueError`` as ``collect``."""
        decisions = collect(traces)
        period = decisions.period
        parts = []
        for trace in traces:
            count = (trace.slices + 1) // period * period
            shown = np.concatenate(
                [picture(trace.images[k : min(k + BLOCK, count)]) for k in range(0, count, BLOCK)]
            )
            parts.append(shown.reshape(-1, period, *shown.shape[1:])[:, 1:])
        state = decisions.observations[..., : len(STATE_FIELDS)]
        return cls(np.concatenate(parts), np.ascontiguousarray(state), decisions.errors)

    @property
    def period(self) -> int:
        """Slices between LiDAR frames."""
        return self.errors.shape[1]

    def shown(self, chosen: NDArray[np.int64], mirrored: NDArray[np.bool_]) -> NDArray[np.int8]:
        """``(m, states, 3, h, w)`` int8, pictures with their memory in all states of intervals ``chosen``.

        Args:
            chosen: ``(m,)`` intervals.
            mirrored: ``(m,)`` where to swap left and right.
        """
        pictures = self.pictures[chosen]
        pictures[mirrored] = pictures[mirrored][..., ::-1]
        sums = np.cumsum(pictures[:, :, MAGNITUDES], axis=1, dtype=np.int16)
        sums = np.concatenate([np.zeros_like(sums[:, :1]), sums], axis=1)  # of slices 1..k at k
        return np.stack(
            [with_memory(pictures[:, k - 1], sums[:, k] - sums[:, h]) for k, h in states(self.period)], axis=1
        )


@dataclass(frozen=True)
class TrainedPictures:
    """The best network of a training and how it got there."""

    network: TriggerNetwork
    best: Verdict
    best_step: int
    history: tuple[tuple[int, float, float], ...]
    """``(step, mean loss since the last, regret)`` at every evaluation."""


def train_pictures(
    data: PictureDecisions,
    validation: Validation,
    options: ValueTraining,
    progress: Callable[[int, float, float], None] = lambda step, loss, regret: None,
) -> TrainedPictures:
    """Train a network that is told the trigger cost; of all evaluations the one with the least regret counts.

    With the objective ``reduction`` its output is what a trigger saves at its own slice, less its price.
    Same data and options, same weights, on one machine and with one thread.

    Raises:
        ValueError: bad options.
    """
    options.validate()
    rng = torch.Generator().manual_seed(options.seed)
    errors = torch.from_numpy(np.nan_to_num(data.errors)).float()
    network = _network(options, data, rng)

    def loss() -> Tensor:
        drawn = torch.randint(2 * len(errors), (options.batch,), generator=rng)
        chosen, mirrored = drawn % len(errors), drawn >= len(errors)
        costs = draw_costs(options, rng)
        shown = torch.from_numpy(data.shown(chosen.numpy(), mirrored.numpy()))
        encoded = network.encode(shown.flatten(0, 1))
        state = torch.from_numpy(data.state[chosen.numpy()])
        output = network(encoded, told(state, costs).flatten(0, 1))
        return objective_loss(output.view(len(chosen), -1), errors[chosen], costs, options)

    def judge(step: int) -> tuple[float, tuple[int, Verdict]]:
        verdict = ByRegret()(network.eval(), validation)
        network.train()
        return verdict.criterion, (step, verdict)

    (best_step, best), history = descend(network, options, loss, judge, progress)
    return TrainedPictures(network.eval(), best, best_step, history)


def _network(options: ValueTraining, data: PictureDecisions, rng: torch.Generator) -> TriggerNetwork:
    """A fresh network that standardises its numbers; the draws come from ``rng`` alone."""
    height, width = (size * POOL for size in data.pictures.shape[-2:])
    costs = options.cost_low, options.cost_high
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(torch.randint(2**62, (1,), generator=rng)))
        network = TriggerNetwork("dict", True, options.hidden, "relu", height, width, costs)
    low, high = (float(cost_coordinate(cost)) for cost in costs)
    numbers = torch.from_numpy(data.state.reshape(-1, data.state.shape[-1]))
    encoder = network.encoder
    encoder.mean[:-1], encoder.mean[-1] = numbers.mean(dim=0), (low + high) / 2
    encoder.scale[:-1] = 1 / numbers.std(dim=0).clamp_min(1e-2)
    encoder.scale[-1] = math.sqrt(12) / max(high - low, 1e-3)
    return network
