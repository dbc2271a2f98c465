"""Schedules of triggers made after the sequences were run: fixed ones, and ones that match another's rate."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from nl_env.depth.metrics import METRIC_NAMES
from nl_env.evaluation import DECIDING_METRIC, EpisodeRecord
from nl_env.reproduction.end_to_end import Schedule, SequenceRun
from nl_env.types import SLICE_US

PricedOracle = Callable[[NDArray[np.float64], int, float], Schedule]
"""``(errors (K+1, P), period, price) -> schedule`` with the least ``total error + price * triggers``."""

PRICE_STEPS = 40
"""Bisections of the oracle's price; the rate is a step function of it."""


def play_all(
    runs: Sequence[SequenceRun], reference: str, priced: PricedOracle
) -> dict[str, dict[str, list[EpisodeRecord]]]:
    """Records of every policy with every extrapolator, by policy, extrapolator, in the order of ``runs``.

    Beside the policies of the runs: once per LiDAR interval, and evenly, by event rate and by the oracle at
    the mean rate of the policy ``reference``.
    """
    rate = mean_rate(runs, [run.schedules[reference] for run in runs])
    schedules = {name: [run.schedules[name] for run in runs] for name in runs[0].schedules}
    for offset in range(1, runs[0].lidar_period):
        schedules[f"once per interval, slice {offset}"] = [once(run, offset) for run in runs]
    schedules[f"evenly at {rate:.1f} Hz"] = [evenly(run, rate) for run in runs]
    schedules[f"event-rate at {rate:.1f} Hz"] = event_rate(runs, rate)
    best = f"oracle* at {rate:.1f} Hz"
    records: dict[str, dict[str, list[EpisodeRecord]]] = {name: {} for name in (*schedules, best)}
    for extrapolator in runs[0].errors:
        chosen = {**schedules, best: oracle(runs, extrapolator, rate, priced)}
        for name, of_runs in chosen.items():
            records[name][extrapolator] = [
                run.play(name, schedule, extrapolator) for run, schedule in zip(runs, of_runs, strict=True)
            ]
    return records


def mean_rate(runs: Sequence[SequenceRun], schedules: Sequence[Schedule]) -> float:
    """Mean effective frame rate of one schedule per sequence, Hz."""
    return float(
        np.mean(
            [
                (np.count_nonzero(run.columns["lidar"][1:]) + np.count_nonzero(schedule & run.free))
                * 1e6
                / (run.slices * SLICE_US)
                for run, schedule in zip(runs, schedules, strict=True)
            ]
        )
    )


def once(run: SequenceRun, offset: int) -> Schedule:
    """Trigger once per LiDAR interval, ``offset`` slices after the LiDAR frame."""
    return (np.arange(run.slices + 1) % run.lidar_period == offset) & run.free


def evenly(run: SequenceRun, rate_hz: float) -> Schedule:
    """Triggers spread evenly over the slices without a LiDAR frame, as many as ``rate_hz`` needs."""
    free = np.flatnonzero(run.free)
    lidar_frames = np.count_nonzero(run.columns["lidar"][1:])
    wanted = round(rate_hz * run.slices * SLICE_US / 1e6) - lidar_frames
    triggers = int(np.clip(wanted, 0, len(free)))
    schedule = np.zeros(run.slices + 1, bool)
    if triggers:
        steps = np.arange(len(free) + 1) * triggers // len(free)
        schedule[free[np.diff(steps) > 0]] = True
    return schedule


def event_rate(runs: Sequence[SequenceRun], rate_hz: float) -> list[Schedule]:
    """Trigger where the share of active pixels is above the threshold whose mean rate is ``rate_hz``."""
    shares = np.concatenate([run.columns["active_fraction"][run.free] for run in runs])
    triggers = _triggers(runs, rate_hz)
    threshold = np.inf if triggers == 0 else np.sort(shares)[len(shares) - triggers]
    return [(run.columns["active_fraction"] >= threshold) & run.free for run in runs]


def oracle(
    runs: Sequence[SequenceRun], extrapolator: str, rate_hz: float, priced: PricedOracle
) -> list[Schedule]:
    """The schedules with the least total error over all sequences together at a mean rate of ``rate_hz``.

    Every trigger costs the same, and the price is the lowest one at which the rate is not exceeded. When
    even free triggers would not be worth that rate, it stays below.
    """
    metric = METRIC_NAMES.index(DECIDING_METRIC)
    wanted = _triggers(runs, rate_hz)

    def schedules(price: float) -> list[Schedule]:
        return [priced(run.errors[extrapolator][metric], run.lidar_period, price) for run in runs]

    def count(found: Sequence[Schedule]) -> int:
        return sum(int(np.count_nonzero(schedule)) for schedule in found)

    low, high = 0.0, 1.0
    best = schedules(low)
    if count(best) <= wanted:
        return best
    while count(best := schedules(high)) > wanted:
        low, high = high, 2 * high
    for _ in range(PRICE_STEPS):
        price = (low + high) / 2
        found = schedules(price)
        if count(found) > wanted:
            low = price
        else:
            high, best = price, found
    return best


def _triggers(runs: Iterable[SequenceRun], rate_hz: float) -> int:
    """Triggers in all sequences together for a mean rate over time of ``rate_hz``."""
    wanted, free = 0.0, 0
    for run in runs:
        wanted += rate_hz * run.slices * SLICE_US / 1e6 - np.count_nonzero(run.columns["lidar"][1:])
        free += int(np.count_nonzero(run.free))
    return min(max(round(wanted), 0), free)
