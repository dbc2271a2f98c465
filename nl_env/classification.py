"""Keyframe detectors as classifiers: F1, balanced accuracy, AUROC, by cause and by weather, with intervals.

Most slices are keyframes, so answering "keyframe" always has a high F1. It is therefore never reported alone:
what always answering scores on the same slices, and measures that it cannot raise, stand beside it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nl_env.evaluation import Estimate, estimate, pooled_f1, pooled_precision, pooled_recall, share
from nl_env.traces import SequenceTrace
from nl_env.types import SLICE_US

CAUSES = ("speed", "distance", "new")
"""The three causes of a keyframe."""


@dataclass(frozen=True)
class Detection:
    """A detector's answers on one sequence, slices 1..K, and the truth.

    Attributes:
        seed: of the sequence.
        weather: its name.
        scores: ``(K,)``, higher means keyframe.
        causes: ``(K, 3)`` bool, which of :data:`CAUSES` hold, or ``(K, 1)``, the label alone, where causes
            are not known.
        lidar: ``(K,)`` bool, slices with a LiDAR frame.
    """

    seed: int
    weather: str
    scores: NDArray[np.floating]
    causes: NDArray[np.bool_]
    lidar: NDArray[np.bool_]

    def __post_init__(self) -> None:
        count = len(self.scores)
        known = self.causes.shape in ((count, len(CAUSES)), (count, 1))
        if self.scores.shape != (count,) or not known or self.lidar.shape != (count,):
            raise ValueError(
                f"detection: found scores {self.scores.shape}, causes {self.causes.shape}, "
                f"lidar {self.lidar.shape}, expected (K,), (K, {len(CAUSES)}) or (K, 1), (K,)"
            )
        if not np.all(np.isfinite(self.scores)):
            raise ValueError(f"detection: found scores of sequence {self.seed} that are not finite")

    @property
    def keyframe(self) -> NDArray[np.bool_]:
        """``(K,)`` bool, the label: any cause."""
        return np.asarray(self.causes.any(axis=1))

    @classmethod
    def of_trace(cls, trace: SequenceTrace, scores: NDArray[np.floating]) -> Detection:
        """Scores ``(K,)`` of the slices 1..K of a precomputed sequence."""
        causes = np.stack([trace.keyframe_speed, trace.keyframe_distance, trace.keyframe_new], axis=1)
        return cls(trace.seed, str(trace.description["weather"]), scores, causes[1:], trace.lidar[1:])


@dataclass(frozen=True)
class DetectorSummary:
    """One detector at one threshold over all sequences; every slice counts, intervals are over sequences.

    Attributes:
        threshold: scores above it mean keyframe.
        keyframes: share of slices that are keyframes.
        triggers: share of slices that the detector calls keyframes.
        rate: effective frame rate that these triggers give, Hz.
        precision, recall, f1: as usual.
        balanced_accuracy: mean of recall and of the share of other slices that are left alone.
        false_positive_rate: share of other slices that are called keyframes.
        auroc: probability that a keyframe scores above another slice; needs no threshold.
        always_f1: F1 of always answering "keyframe".
        f1_gain: ``f1 - always_f1``, its interval paired by sequence.
        recall_by_cause: share of the slices with that cause, alone or with others, that are found; empty
            where causes are not known.
        f1_by_cause: slices with that cause against slices that are no keyframes.
        f1_by_weather: pooled over the sequences of each weather.
    """

    threshold: float
    keyframes: Estimate
    triggers: Estimate
    rate: Estimate
    precision: Estimate
    recall: Estimate
    f1: Estimate
    balanced_accuracy: Estimate
    false_positive_rate: Estimate
    auroc: Estimate
    always_f1: Estimate
    f1_gain: Estimate
    recall_by_cause: Mapping[str, Estimate]
    f1_by_cause: Mapping[str, Estimate]
    f1_by_weather: Mapping[str, float]


def summarise_detector(
    detections: Sequence[Detection], threshold: float, resamples: NDArray[np.int64]
) -> DetectorSummary:
    """Judge one detector.

    Args:
        detections: one per sequence.
        threshold: scores above it mean keyframe.
        resamples: from ``nl_env.evaluation.resample_sequences`` for as many sequences.

    Raises:
        ValueError: no detections, or ``resamples`` for another number of them.
    """
    if not detections or resamples.ndim != 2 or resamples.shape[1] != len(detections):
        raise ValueError(
            f"resamples: found shape {resamples.shape} for {len(detections)} sequences, "
            "expected (n, sequences) for at least one"
        )
    # Columns of these tables: hits, false alarms, misses, correct rejections.
    counts = np.array([confusion(d.scores > threshold, d.keyframe) for d in detections])
    by_cause = {
        cause: np.array(
            [
                _of_cause(confusion(d.scores > threshold, d.causes[:, i]), row)
                for d, row in zip(detections, counts, strict=True)
            ]
        )
        for i, cause in enumerate(CAUSES if all(d.causes.shape[1] > 1 for d in detections) else ())
    }
    rates = np.array([effective_rate(d, threshold) for d in detections])
    wins, pairs = _ordered_pairs(detections)
    weathers = sorted({d.weather for d in detections})
    of_weather = {w: np.array([d.weather == w for d in detections]) for w in weathers}
    return DetectorSummary(
        threshold=threshold,
        keyframes=estimate(lambda c: _ratio(c, (0, 2), (0, 1, 2, 3)), counts, resamples),
        triggers=estimate(lambda c: _ratio(c, (0, 1), (0, 1, 2, 3)), counts, resamples),
        rate=estimate(lambda values: values[..., 0].mean(axis=-1), rates[:, None], resamples),
        precision=estimate(pooled_precision, counts[:, :3], resamples),
        recall=estimate(pooled_recall, counts[:, :3], resamples),
        f1=estimate(pooled_f1, counts[:, :3], resamples),
        balanced_accuracy=estimate(
            lambda c: (_ratio(c, (0,), (0, 2)) + _ratio(c, (3,), (1, 3))) / 2, counts, resamples
        ),
        false_positive_rate=estimate(lambda c: _ratio(c, (1,), (1, 3)), counts, resamples),
        auroc=estimate(
            lambda chosen: _auroc(wins, pairs, chosen),
            np.arange(len(detections), dtype=float)[:, None],
            resamples,
        ),
        always_f1=estimate(_always_f1, counts, resamples),
        f1_gain=estimate(lambda c: pooled_f1(c[..., :3]) - _always_f1(c), counts, resamples),
        recall_by_cause={c: estimate(pooled_recall, table, resamples) for c, table in by_cause.items()},
        f1_by_cause={c: estimate(pooled_f1, table, resamples) for c, table in by_cause.items()},
        f1_by_weather={w: float(pooled_f1(counts[mask][:, :3])) for w, mask in of_weather.items()},
    )


def confusion(called: NDArray[np.bool_], truth: NDArray[np.bool_]) -> tuple[float, float, float, float]:
    """Hits, false alarms, misses and correct rejections."""
    return (
        float(np.count_nonzero(called & truth)),
        float(np.count_nonzero(called & ~truth)),
        float(np.count_nonzero(~called & truth)),
        float(np.count_nonzero(~called & ~truth)),
    )


def effective_rate(detection: Detection, threshold: float) -> float:
    """Depth frames per second, LiDAR frames included, Hz; a trigger that meets a LiDAR frame adds none."""
    frames = np.count_nonzero(detection.lidar | (detection.scores > threshold))
    return frames / (len(detection.scores) * SLICE_US / 1e6)


def auroc(scores: NDArray[np.floating], truth: NDArray[np.bool_]) -> float:
    """Probability that a positive scores above a negative, ties counted half; nan without both."""
    positive, negative = np.sort(scores[truth]), np.sort(scores[~truth])
    if not len(positive) or not len(negative):
        return math.nan
    return _wins(positive, negative) / (len(positive) * len(negative))


def best_f1_threshold(detections: Sequence[Detection]) -> float:
    """The threshold with the best F1 over all slices; the highest of equals.

    Raises:
        ValueError: no slice is a keyframe.
    """
    scores = np.concatenate([d.scores for d in detections])
    truth = np.concatenate([d.keyframe for d in detections])
    if not truth.any():
        raise ValueError("detections: found no keyframe, expected some to choose a threshold by")
    order = np.argsort(-scores, kind="stable")
    called = np.arange(1, len(scores) + 1)
    f1 = 2 * np.cumsum(truth[order]) / (called + truth.sum())
    ordered = scores[order]
    last_of_ties = np.append(ordered[1:] < ordered[:-1], True)  # a threshold cannot split equal scores
    best = int(np.argmax(np.where(last_of_ties, f1, -1.0)))
    return _between(ordered, best)


def even_threshold(detections: Sequence[Detection]) -> float:
    """The threshold that finds as large a share of the keyframes as it leaves alone of the other slices.

    The nearest to it that the scores allow; the highest of equals. Unlike the other rules it does not depend
    on the share of keyframes in the sequences at hand, and it moves less from one set of sequences to another
    than the best balanced accuracy, whose peak is flat.

    Raises:
        ValueError: no slice is a keyframe, or every one.
    """
    scores = np.concatenate([d.scores for d in detections])
    truth = np.concatenate([d.keyframe for d in detections])
    if truth.all() or not truth.any():
        found = "keyframes alone" if truth.any() else "no keyframe"
        raise ValueError(f"detections: found {found}, expected keyframes and others to choose a threshold by")
    order = np.argsort(-scores, kind="stable")
    hits, false_alarms = np.cumsum(truth[order]), np.cumsum(~truth[order])
    uneven = np.abs(hits / hits[-1] - (1 - false_alarms / false_alarms[-1]))
    ordered = scores[order]
    last_of_ties = np.append(ordered[1:] < ordered[:-1], True)
    best = int(np.argmin(np.where(last_of_ties, uneven, np.inf)))
    return _between(ordered, best)


def matching_threshold(detections: Sequence[Detection]) -> float:
    """The threshold that calls as many slices keyframes as there are (fewer where scores are equal).

    Precision then equals recall. Unlike the best F1, which tends to "always" where keyframes are common, it
    moves little with the share of keyframes in the sequences at hand.

    Raises:
        ValueError: no slice is a keyframe.
    """
    scores = np.sort(np.concatenate([d.scores for d in detections]))[::-1]
    keyframes = int(sum(np.count_nonzero(d.keyframe) for d in detections))
    if not keyframes:
        raise ValueError("detections: found no keyframe, expected some to choose a threshold by")
    last_of_ties = np.flatnonzero(np.append(scores[1:] < scores[:-1], True))
    allowed = last_of_ties[last_of_ties < keyframes]
    return _between(scores, int(allowed[-1])) if len(allowed) else float(scores[0])


def rate_threshold(detections: Sequence[Detection], rate_hz: float) -> float:
    """The lowest threshold at which the mean effective rate over sequences is at most ``rate_hz``.

    Raises:
        ValueError: the LiDAR alone is faster.
    """
    free = [np.where(d.lidar, -np.inf, d.scores) for d in detections]
    lidar = np.mean([effective_rate(d, np.inf) for d in detections])
    if lidar > rate_hz:
        raise ValueError(f"rate_hz: found {rate_hz}, expected at least the LiDAR's own {lidar:g}")
    # Every trigger of a sequence raises the mean rate by the same amount for sequences of the same length.
    gain = np.concatenate([np.full(len(s), 1e6 / SLICE_US / len(s) / len(free)) for s in free])
    scores = np.concatenate(free)
    order = np.argsort(-scores, kind="stable")
    rates = lidar + np.cumsum(np.where(np.isfinite(scores[order]), gain[order], 0.0))
    ordered = scores[order]
    last_of_ties = np.append(ordered[1:] < ordered[:-1], True)
    allowed = np.flatnonzero(last_of_ties & (rates <= rate_hz + 1e-9) & np.isfinite(ordered))
    return _between(ordered, int(allowed[-1])) if len(allowed) else float(ordered[0])


def _between(descending: NDArray[np.floating], index: int) -> float:
    """A threshold that the scores up to ``index`` exceed and the next ones do not."""
    following = descending[index + 1] if index + 1 < len(descending) else -np.inf
    if not np.isfinite(following):
        return float(np.nextafter(descending[index], -np.inf))
    middle = (float(descending[index]) + float(following)) / 2
    return middle if middle < descending[index] else float(following)


def _of_cause(cause: tuple[float, ...], all_causes: NDArray[np.float64]) -> tuple[float, float, float]:
    """Hits and misses of one cause, with the false alarms at slices that are no keyframes."""
    return cause[0], float(all_causes[1]), cause[2]


def _ratio(counts: NDArray[np.float64], part: tuple[int, ...], whole: tuple[int, ...]) -> NDArray[np.float64]:
    """Columns ``part`` over columns ``whole`` of ``(..., sequences, 4)`` counts, pooled over sequences."""
    pooled = counts.sum(axis=-2)
    return share(pooled[..., part].sum(axis=-1), pooled[..., whole].sum(axis=-1))


def _always_f1(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    keyframes = _ratio(counts, (0, 2), (0, 1, 2, 3))
    return 2 * keyframes / (1 + keyframes)


def _ordered_pairs(detections: Sequence[Detection]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """``(S, S)``: for keyframes of sequence i and other slices of sequence j, pairs won, and all pairs.

    Any resampling of whole sequences has the AUROC that these two tables give.
    """
    positives = [np.sort(d.scores[d.keyframe]) for d in detections]
    negatives = [np.sort(d.scores[~d.keyframe]) for d in detections]
    wins = np.array([[_wins(p, n) for n in negatives] for p in positives])
    pairs = np.outer([len(p) for p in positives], [len(n) for n in negatives]).astype(float)
    return wins, pairs


def _wins(positive: NDArray[np.floating], negative: NDArray[np.floating]) -> float:
    """Pairs of the sorted arrays with the positive above, ties counted half."""
    above = np.searchsorted(negative, positive, side="left").sum()
    not_below = np.searchsorted(negative, positive, side="right").sum()
    return float(above + not_below) / 2


def _auroc(
    wins: NDArray[np.float64], pairs: NDArray[np.float64], chosen: NDArray[np.float64]
) -> NDArray[np.float64]:
    """AUROC of the sequences ``chosen`` ``(..., sequences, 1)``, which may repeat."""
    index = chosen[..., 0].astype(np.int64)
    weights = np.zeros((*index.shape[:-1], len(wins)))
    np.add.at(weights, (*np.indices(index.shape)[:-1], index), 1.0)
    won = np.einsum("...i,ij,...j->...", weights, wins, weights)
    return share(won, np.einsum("...i,ij,...j->...", weights, pairs, weights))
