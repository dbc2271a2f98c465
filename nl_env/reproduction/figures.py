"""From one measurement per sequence to means with intervals, changes against Repeat and spread over seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nl_env.evaluation import CONFIDENCE, resample_sequences

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Figure:
    """One number of a table.

    Attributes:
        mean: over sequences (and over training seeds, where a row has several).
        standard_error: of the mean, over sequences.
        low, high: 95 % bootstrap interval over sequences.
        change: relative to the row compared with (-0.4 = 40 % less); nan for a table without one.
        change_low, change_high: its interval; both rows are drawn together.
        spread: standard deviation over the training seeds; nan with one.
    """

    mean: float
    standard_error: float
    low: float
    high: float
    change: float
    change_low: float
    change_high: float
    spread: float


Figures = Mapping[str, Mapping[str, Mapping[str, Figure]]]
"""Row, column group (a gap), metric."""


def bootstrap_weights(sequences: int, rng: np.random.Generator) -> Array:
    """``(RESAMPLES, sequences)``: how often each sequence is in each bootstrap sample."""
    drawn = resample_sequences(sequences, rng)
    weights = np.zeros(drawn.shape)
    np.add.at(weights, (np.arange(len(drawn))[:, None], drawn), 1.0)
    return weights


def weighted_mean(weights: Array, values: Array) -> Array:
    """Means ``(samples, ...)`` of ``values`` ``(sequences, ...)``; nan values are left out."""
    finite = np.isfinite(values)
    total = np.tensordot(weights, np.where(finite, values, 0.0), axes=1)
    count = np.tensordot(weights, finite.astype(np.float64), axes=1)
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)


def interval(samples: Array) -> Array:
    """``(2, ...)`` limits of the central 95 % of ``samples`` ``(samples, ...)``; nan samples are left out."""
    tail = (1 - CONFIDENCE) / 2
    finite = np.isfinite(samples).any(axis=0)
    filled = np.where(finite, samples, 0.0)
    return np.where(finite, np.nanquantile(filled, [tail, 1 - tail], axis=0), np.nan)


def summarise(
    values: Array,
    rows: Sequence[str],
    groups: Sequence[str],
    metrics: Sequence[str],
    base: str,
    rng: np.random.Generator,
) -> dict[str, dict[str, dict[str, Figure]]]:
    """Figures of every row.

    Args:
        values: ``(sequences, methods, groups, metrics)``; nan where nothing could be measured.
        rows: the row each method belongs to; methods of one row are its training seeds.
        groups, metrics: names of the last two axes.
        base: the row that changes are relative to.
        rng: draws the bootstrap.

    Raises:
        ValueError: ``values`` of another shape, or ``base`` is not a row.
    """
    if values.shape[1:] != (len(rows), len(groups), len(metrics)):
        expected = f"(sequences, {len(rows)}, {len(groups)}, {len(metrics)})"
        raise ValueError(f"values: found shape {values.shape}, expected {expected}")
    if base not in rows:
        raise ValueError(f"base: found {base!r}, expected one of {', '.join(rows)}")
    weights = bootstrap_weights(len(values), rng)
    everything = np.ones((1, len(values)))
    members = {row: [i for i, name in enumerate(rows) if name == row] for row in dict.fromkeys(rows)}
    pooled = {row: values[:, chosen].mean(axis=1) for row, chosen in members.items()}
    means = {row: weighted_mean(everything, of_row)[0] for row, of_row in pooled.items()}
    samples = {row: weighted_mean(weights, of_row) for row, of_row in pooled.items()}
    figures = {}
    for row, chosen in members.items():
        with np.errstate(divide="ignore", invalid="ignore"):  # an error of zero has no relative change
            change = means[row] / means[base] - 1
            change_limits = interval(samples[row] / samples[base] - 1)
        limits = interval(samples[row])
        finite = np.isfinite(pooled[row]).sum(axis=0)
        error = np.full(finite.shape, np.nan)
        enough = finite > 1
        error[enough] = np.nanstd(pooled[row][:, enough], axis=0, ddof=1) / np.sqrt(finite[enough])
        seeds = weighted_mean(everything, values[:, chosen])[0]
        spread = seeds.std(axis=0, ddof=1) if len(chosen) > 1 else np.full(seeds.shape[1:], np.nan)
        parts = np.stack([means[row], error, *limits, change, *change_limits, spread], axis=-1)
        figures[row] = {
            group: {metric: Figure(*map(float, parts[g, m])) for m, metric in enumerate(metrics)}
            for g, group in enumerate(groups)
        }
    return figures
