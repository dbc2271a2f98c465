"""Playing validation sequences with a network, all of them and all trigger costs side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from agents.base import Policy
from agents.oracle import oracle_curve
from agents.pictures import MAGNITUDES, picture, with_memory
from agents.rl_networks import TriggerNetwork
from agents.rules import Evenly, Periodic
from nl_env.batched_ledger import BatchedLedger
from nl_env.curves import OperatingPoints, oracle_points
from nl_env.evaluation import DECIDING_METRIC
from nl_env.observations import IMAGE_OFFSET, cost_coordinate, state_vector, statistics_observation
from nl_env.statistics import ActivityMemory
from nl_env.traces import SequenceTrace
from nl_env.types import SLICE_US

PERIODS = (1, 2, 3, 4, 6, 8)
RATES_HZ = (15.0, 20.0, 25.0, 30.0, 35.0, 40.0, 45.0)
"""Periodic and even schedules whose common curve has regret 1."""


@dataclass(frozen=True)
class Validation:
    """Sequences of equal length, and what the best and the simplest schedules reach on them.

    Attributes:
        traces: the sequences.
        floor, periodic: area under the optimal oracle's and the periodic schedules' curve of error over
            rate, from holding always to triggering always.
        ends: operating points of holding always and triggering always.
    """

    traces: tuple[SequenceTrace, ...]
    floor: float
    periodic: float
    ends: OperatingPoints

    @classmethod
    def of(cls, traces: Sequence[SequenceTrace]) -> Validation:
        """Prepare ``traces``.

        Raises:
            ValueError: no traces, or of different lengths or LiDAR periods.
        """
        kinds = sorted({(trace.slices, trace.lidar_period) for trace in traces})
        if len(kinds) != 1:
            raise ValueError(
                f"validation: found (slices, LiDAR period) {kinds}, expected one for all sequences"
            )
        ((slices, period),) = kinds
        floors = [oracle_curve(trace.errors[DECIDING_METRIC], period)[1] for trace in traces]
        lidar_frames = int(np.count_nonzero(traces[0].lidar[1:]))
        oracle = oracle_points(floors, lidar_frames, slices, slices * SLICE_US / 1e6)
        lidar_hz = 1e6 / (period * SLICE_US)
        every_hz = 1e6 / SLICE_US
        ends = play_schedules([Evenly(lidar_hz, period), Evenly(every_hz, period)], traces)
        regular: list[Policy] = [Periodic(n) for n in PERIODS]
        regular += [Evenly(hz, period) for hz in RATES_HZ if lidar_hz <= hz <= every_hz]
        periodic = play_schedules(regular, traces)
        return cls(tuple(traces), _area(oracle, ends), _area(periodic, ends), ends)

    def regret(self, points: OperatingPoints) -> float:
        """Where a curve lies between the optimal oracle's (0) and periodic triggering (1)."""
        return (_area(points, self.ends) - self.floor) / (self.periodic - self.floor)


def _area(points: OperatingPoints, ends: OperatingPoints) -> float:
    sequences = ends.rate.shape[1]
    (curve,) = points.joined(ends).curves(np.full((1, sequences), 1 / sequences))
    low, high = np.sort(ends.rate.mean(axis=1))
    return curve.area(float(low), float(high))


def play_together(
    network: TriggerNetwork,
    traces: Sequence[SequenceTrace],
    costs: Sequence[float] | None = None,
    biases: Sequence[float] = (0.0,),
) -> OperatingPoints:
    """What :func:`nl_env.evaluation.play` finds of ``network`` on every trace, in one pass.

    Args:
        network: plays; in evaluation mode.
        traces: of equal length.
        costs: trigger costs to show it, one operating point each; None for a network that is not told.
        biases: added to its margins, one operating point each; for a network that is not told the cost.
    """
    points = len(biases) if costs is None else len(costs)
    count, pixels = points * len(traces), traces[0].images[0].size
    sequence = np.tile(np.arange(len(traces)), points)
    added = torch.as_tensor(np.repeat(biases, len(traces)) if costs is None else np.zeros(count))
    shown_costs = None if costs is None else np.repeat(costs, len(traces))
    events = np.stack([trace.event_count for trace in traces])
    statistics = network.obs_mode == "statistics"
    described = np.stack([trace.statistics for trace in traces]) if statistics else None
    activity = ActivityMemory((count,))
    encoded = _encoded(network, traces)

    def decide(k: int, arrives: NDArray[np.bool_], ledger: BatchedLedger) -> NDArray[np.int64]:
        activity.act(ledger.held_index == k - 1)
        vector, column = None, np.zeros(count, np.int64)
        if network.obs_mode != "image":
            since_lidar, since_depth = ledger.staleness(np.full(count, k), arrives)
            column = np.where(arrives, 0, k - ledger.held_index - 1)
            vector = state_vector(since_lidar, since_depth, events[sequence, k], pixels, ledger.last_action)
            if described is not None:
                activity.see(described[sequence, k], arrives)
                vector = statistics_observation(vector, activity.observed(), shown_costs)
            elif shown_costs is not None:
                vector = np.concatenate([vector, cost_coordinate(shown_costs)[:, None]], axis=1)
        images = next(encoded)
        with torch.inference_mode():
            margins = network(
                None if images is None else images[sequence, column],
                None if vector is None else torch.from_numpy(vector),
            )
            return (margins + added > 0).numpy().astype(np.int64)

    return _play(traces, points, decide)


def play_schedules(policies: Sequence[Policy], traces: Sequence[SequenceTrace]) -> OperatingPoints:
    """What policies that look at nothing but the time reach on every trace."""
    blind = np.full((1, 1, 1), IMAGE_OFFSET, np.uint8)
    actions = np.zeros((len(policies), traces[0].slices), np.int64)
    for policy, row in zip(policies, actions, strict=True):
        state = None
        for k in range(len(row)):
            row[k], state = policy.predict(blind, state)
    rows = np.repeat(actions, len(traces), axis=0)
    return _play(traces, len(policies), lambda k, arrives, ledger: rows[:, k - 1])


Decide = Callable[[int, NDArray[np.bool_], BatchedLedger], NDArray[np.int64]]
"""``(k, LiDAR frames that arrive (n,), ledger) -> actions (n,)`` at slice k."""


def _play(traces: Sequence[SequenceTrace], points: int, decide: Decide) -> OperatingPoints:
    """Errors and rates of ``points`` policies on every trace; row ``i`` is trace ``i % len(traces)``."""
    sequence = np.tile(np.arange(len(traces)), points)
    lidar = np.stack([trace.lidar for trace in traces])
    errors = np.stack([trace.errors[DECIDING_METRIC] for trace in traces])
    ledger = BatchedLedger(len(sequence), traces[0].lidar_period)
    everywhere = np.ones(len(sequence), np.bool_)
    total = np.zeros(len(sequence))
    for k in range(1, traces[0].slices + 1):
        arrives = lidar[sequence, k]
        ledger.act(everywhere, arrives, decide(k, arrives, ledger))
        total += errors[sequence, k, ledger.age]
    shape = (points, len(traces))
    return OperatingPoints(ledger.effective_rate.reshape(shape), (total / traces[0].slices).reshape(shape))


def _encoded(network: TriggerNetwork, traces: Sequence[SequenceTrace]) -> Iterator[Tensor | None]:
    """For every slice from 1 on ``(sequences, ages, size)`` encoded pictures, or None where there are none.

    In mode ``"dict"`` pictures depend on how many slices ago the held frame was made: column 0 is 1 slice,
    and the only one where a LiDAR frame arrives.
    """
    if network.encoder.image is None:
        yield from [None] * traces[0].slices
        return
    period = traces[0].lidar_period
    magnitudes: list[NDArray[np.int8]] = []  # of the slices since the last LiDAR frame, newest first
    for k in range(1, traces[0].slices + 1):
        shown = picture(np.stack([trace.images[k] for trace in traces]))[:, None]
        if network.obs_mode == "dict":
            newest = shown[:, 0, MAGNITUDES]
            magnitudes = [newest, *magnitudes] if k % period else []
            sums = np.cumsum(magnitudes or [np.zeros_like(newest)], axis=0, dtype=np.int64)
            shown = with_memory(np.repeat(shown, len(sums), axis=1), np.moveaxis(sums, 0, 1))
        with torch.inference_mode():
            encoded = network.encode(torch.from_numpy(shown.reshape(-1, *shown.shape[2:])))
        yield encoded.reshape(*shown.shape[:2], -1)


def means(points: OperatingPoints) -> Mapping[str, list[float]]:
    """Mean rate and error of every operating point, JSON-ready."""
    return {
        "rate_hz": [round(float(rate), 4) for rate in points.rate.mean(axis=1)],
        DECIDING_METRIC: [round(float(error), 7) for error in points.error.mean(axis=1)],
    }
