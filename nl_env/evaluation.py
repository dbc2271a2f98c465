"""Trigger policies on precomputed sequences: episodes, summaries with intervals, and the oracle's floor.

Every policy plays the same sequences (common random numbers). ``log_mae`` of the held depth decides.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.depth.metrics import METRIC_NAMES
from nl_env.ledger import DepthLedger
from nl_env.observations import (
    IMAGE_OFFSET,
    make_observation,
    observation_space,
    state_vector,
    statistics_observation,
)
from nl_env.statistics import ActivityMemory
from nl_env.traces import SequenceTrace
from nl_env.types import SLICE_US, TriggerPolicy

DECIDING_METRIC = "log_mae"
"""Error that ranks policies, that the optimal oracle minimises and that the curves show."""

RESAMPLES = 2_000
CONFIDENCE = 0.95


@dataclass(frozen=True)
class EnergyModel:
    """Energy of sensing and extrapolating. Only the event camera's power is the paper's own number.

    Attributes:
        lidar_frame_j: one LiDAR frame, J. Default: 8 W (Velodyne VLP-16 data sheet) at 10 Hz.
        extrapolation_j: one extrapolated frame, J. Default: the paper's 9.31 ms on a Jetson AGX Orin, at
            an assumed 30 W (its middle power mode; the paper gives no power).
        event_camera_w: always on, W ("approximately 0.5 W" in the paper's motivation).
    """

    lidar_frame_j: float = 0.8
    extrapolation_j: float = 9.31e-3 * 30
    event_camera_w: float = 0.5

    def energy(self, lidar_frames: float, triggers: float, duration_s: float) -> float:
        """Energy of a sequence, J."""
        return (
            lidar_frames * self.lidar_frame_j
            + triggers * self.extrapolation_j
            + duration_s * self.event_camera_w
        )


@dataclass(frozen=True)
class EpisodeRecord:
    """One policy on one sequence; slices 1..K count.

    Attributes:
        policy: name of the policy.
        seed: sequence seed.
        duration_s: length of the sequence, s.
        triggers: slices at which a frame was extrapolated (a LiDAR slice never is one).
        effective_rate: depth frames per second, Hz.
        held: every metric of the held depth, averaged over time: what the consumer sees.
        produced: every metric of the extrapolated frames alone (the paper's end-to-end table);
            nan without a trigger.
        true_positives, false_positives, false_negatives: triggers against the keyframe label at slices
            without a LiDAR frame.
        energy_j: of the whole sequence, J.
    """

    policy: str
    seed: int
    duration_s: float
    triggers: tuple[int, ...]
    effective_rate: float
    held: Mapping[str, float]
    produced: Mapping[str, float]
    true_positives: int
    false_positives: int
    false_negatives: int
    energy_j: float


def play(
    policy: TriggerPolicy,
    trace: SequenceTrace,
    name: str,
    *,
    obs_mode: str | None = None,
    energy: EnergyModel | None = None,
) -> EpisodeRecord:
    """Let ``policy`` act on slices 1..K of ``trace``, as it would in the environment.

    Privileged policies (``policy.privileged``) are handed the whole trace through ``policy.begin(trace)``.
    A policy that was trained for many trigger costs has the one to show it in ``policy.trigger_cost``.

    Args:
        policy: what plays.
        trace: what is played.
        name: of the policy, for the record.
        obs_mode: what the policy sees; None asks ``policy.obs_mode``, and ``"image"`` where it has none.
        energy: what sensing and extrapolating cost.

    Raises:
        ValueError: unknown ``obs_mode``, one that cannot show a cost to a policy that wants to see it, or
            the policy answers something else than 0 or 1.
    """
    shows = getattr(policy, "obs_mode", "image") if obs_mode is None else obs_mode
    cost = getattr(policy, "trigger_cost", None)
    observation_space(shows, trace.images.shape[1:], costs=cost is not None)  # refuses what cannot be shown
    activity = ActivityMemory() if shows == "statistics" else None
    if getattr(policy, "privileged", False):
        policy.begin(trace)  # type: ignore[attr-defined]
    ledger = DepthLedger(trace.lidar_period)
    ages = np.zeros(trace.slices, np.int64)
    triggered = np.zeros(trace.slices, bool)
    state: Any = None
    episode_start: NDArray[np.bool_] | None = np.array([True])
    for k in range(1, trace.slices + 1):
        if activity is not None:
            activity.see(trace.statistics[k], bool(trace.lidar[k]))
        observation = _observation(shows, trace, k, ledger, activity, cost)
        action, state = policy.predict(observation, state=state, episode_start=episode_start)
        episode_start = None  # for SB3 and for the rules alike: nothing has just been reset
        if action not in (0, 1):
            raise ValueError(f"policy {name!r}: found action {action!r} at slice {k}, expected 0 or 1")
        triggered[k - 1] = ledger.act(k, bool(trace.lidar[k]), int(action))
        if activity is not None:
            activity.act(triggered[k - 1])
        ages[k - 1] = ledger.age
    return _record(name, trace, triggered, ages, ledger, energy or EnergyModel())


def _observation(
    obs_mode: str,
    trace: SequenceTrace,
    k: int,
    ledger: DepthLedger,
    activity: ActivityMemory | None,
    cost: float | None,
) -> Any:
    """The environment's observation at slice ``k``."""
    image = trace.images[k]
    if obs_mode == "image":
        return image[None]
    since_lidar, since_depth = ledger.staleness(k, bool(trace.lidar[k]))
    state = state_vector(since_lidar, since_depth, int(trace.event_count[k]), image.size, ledger.last_action)
    if activity is not None:
        return statistics_observation(state, activity.observed(), cost)
    return make_observation(obs_mode, image.astype(np.int16) - np.int16(IMAGE_OFFSET), state, cost=cost)


def _record(
    name: str,
    trace: SequenceTrace,
    triggered: NDArray[np.bool_],
    ages: NDArray[np.int64],
    ledger: DepthLedger,
    energy: EnergyModel,
) -> EpisodeRecord:
    """Look the schedule's errors up in the trace's tables. Images without a valid pixel (nan) are skipped."""
    slices = np.arange(1, trace.slices + 1)
    free, keyframe = ~trace.lidar[1:], trace.keyframe[1:]
    duration_s = trace.slices * SLICE_US / 1e6
    return EpisodeRecord(
        policy=name,
        seed=trace.seed,
        duration_s=duration_s,
        triggers=tuple(int(k) for k in slices[triggered]),
        effective_rate=ledger.effective_rate,
        held={metric: _mean(table[slices, ages]) for metric, table in trace.errors.items()},
        produced={metric: _mean(table[slices[triggered], 0]) for metric, table in trace.errors.items()},
        true_positives=int(np.count_nonzero(free & triggered & keyframe)),
        false_positives=int(np.count_nonzero(free & triggered & ~keyframe)),
        false_negatives=int(np.count_nonzero(free & ~triggered & keyframe)),
        energy_j=energy.energy(ledger.lidar_frames, ledger.triggers, duration_s),
    )


def _mean(values: NDArray[np.float64]) -> float:
    """Mean of the finite values; nan when there is none."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else math.nan


@dataclass(frozen=True)
class Estimate:
    """A mean over sequences and its 95 % percentile-bootstrap interval; all nan when nothing was measured."""

    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class PolicySummary:
    """One policy over all sequences.

    Attributes:
        policy: name of the policy.
        rate: effective frame rate, Hz; ``rate_min`` and ``rate_max`` over sequences.
        triggers_per_s: extrapolated frames per second.
        held, produced: for every metric, as in :class:`EpisodeRecord`.
        precision, recall, f1: triggers against the keyframe label, counts pooled over sequences.
        power_w: energy over time, W.
    """

    policy: str
    rate: Estimate
    rate_min: float
    rate_max: float
    triggers_per_s: Estimate
    held: Mapping[str, Estimate]
    produced: Mapping[str, Estimate]
    precision: Estimate
    recall: Estimate
    f1: Estimate
    power_w: Estimate


def resample_sequences(sequences: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """``(RESAMPLES, sequences)`` bootstrap indices, shared by all policies so that intervals compare."""
    return rng.integers(sequences, size=(RESAMPLES, sequences))


def summarise(records: Sequence[EpisodeRecord], resamples: NDArray[np.int64]) -> PolicySummary:
    """Summarise one policy's records, one per sequence, all of equal weight.

    Args:
        records: of one policy, in the same order of sequences for every policy.
        resamples: from :func:`resample_sequences` for ``len(records)`` sequences.

    Raises:
        ValueError: no records, records of several policies, or ``resamples`` for another number of them.
    """
    names = sorted({record.policy for record in records})
    if len(names) != 1:
        raise ValueError(f"records: found policies {names}, expected the records of exactly one")
    if resamples.ndim != 2 or resamples.shape[1] != len(records):
        raise ValueError(f"resamples: found shape {resamples.shape}, expected (n, {len(records)})")

    def mean(values: Iterable[float]) -> Estimate:
        return estimate_mean(np.array(list(values)), resamples)

    counts = np.array([[r.true_positives, r.false_positives, r.false_negatives] for r in records], float)
    rates = [record.effective_rate for record in records]
    return PolicySummary(
        policy=names[0],
        rate=mean(rates),
        rate_min=min(rates),
        rate_max=max(rates),
        triggers_per_s=mean(len(r.triggers) / r.duration_s for r in records),
        held={name: mean(r.held[name] for r in records) for name in METRIC_NAMES},
        produced={name: mean(r.produced[name] for r in records) for name in METRIC_NAMES},
        precision=estimate(pooled_precision, counts, resamples),
        recall=estimate(pooled_recall, counts, resamples),
        f1=estimate(pooled_f1, counts, resamples),
        power_w=mean(r.energy_j / r.duration_s for r in records),
    )


def estimate_mean(values: NDArray[np.float64], resamples: NDArray[np.int64]) -> Estimate:
    """Mean of ``values`` ``(sequences,)`` and its interval; nan values are left out."""
    return estimate(_nanmean, values[:, None], resamples)


Statistic = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Reduces ``(..., sequences, columns)`` to ``(...)``."""


def estimate(statistic: Statistic, values: NDArray[np.float64], resamples: NDArray[np.int64]) -> Estimate:
    """``statistic`` of ``values`` ``(sequences, columns)`` with its percentile-bootstrap interval.

    ``resamples`` are the ``(n, sequences)`` indices of :func:`resample_sequences`.
    """
    drawn = statistic(values[resamples])
    drawn = drawn[np.isfinite(drawn)]
    if not drawn.size:
        return Estimate(math.nan, math.nan, math.nan)
    low, high = np.quantile(drawn, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Estimate(float(statistic(values)), float(low), float(high))


def _nanmean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean over sequences without the nan ones (a policy that never triggered produced no frame)."""
    finite = np.isfinite(values[..., 0])
    return share(np.where(finite, values[..., 0], 0.0).sum(axis=-1), finite.sum(axis=-1))


def pooled_precision(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share of triggers that are right, from counts as in :func:`pooled_f1`."""
    hits, false_alarms, _ = np.moveaxis(counts.sum(axis=-2), -1, 0)
    return share(hits, hits + false_alarms)


def pooled_recall(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share of keyframes that are triggered, from counts as in :func:`pooled_f1`."""
    hits, _, misses = np.moveaxis(counts.sum(axis=-2), -1, 0)
    return share(hits, hits + misses)


def pooled_f1(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    """F1 of ``(..., sequences, 3)`` hits, false alarms and misses, counts pooled over sequences."""
    hits, false_alarms, misses = np.moveaxis(counts.sum(axis=-2), -1, 0)
    return share(2 * hits, 2 * hits + false_alarms + misses)


def share(part: NDArray[Any], whole: NDArray[Any]) -> NDArray[np.float64]:
    """``part / whole``, nan where ``whole`` is 0."""
    return np.divide(part, whole, out=np.full(np.shape(whole), np.nan), where=np.asarray(whole) > 0)
