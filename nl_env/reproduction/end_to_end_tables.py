"""End-to-end results as tables: who triggers, how often, and what error that leaves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from nl_env.depth.metrics import FULL_METRICS, METRIC_NAMES, PAPER_METRICS
from nl_env.evaluation import (
    DECIDING_METRIC,
    EpisodeRecord,
    Estimate,
    PolicySummary,
    resample_sequences,
    summarise,
)
from nl_env.reproduction import figures as statistics
from nl_env.reproduction import published
from nl_env.reproduction.document import Rows, Section, cell, percent
from nl_env.reproduction.figures import Figure
from nl_env.tables import metric_label

LIDAR_ALONE = "never"
"""The policy that every held-depth error is compared with."""

Records = Mapping[str, Mapping[str, Sequence[EpisodeRecord]]]
"""Policy, extrapolator, one record per sequence in the same order everywhere."""

ByMetric = Mapping[str, Figure]


@dataclass(frozen=True)
class EndToEnd:
    """All figures of the table.

    Attributes:
        policies: rate, precision, recall and F1 of each policy (with the last extrapolator).
        held: by policy and extrapolator, time averages of the held depth; changes against the LiDAR alone.
        produced: by policy and extrapolator, errors of the frames made; changes against Repeat at the same
            triggers.
    """

    policies: Mapping[str, PolicySummary]
    held: Mapping[str, Mapping[str, ByMetric]]
    produced: Mapping[str, Mapping[str, ByMetric]]


def summarise_records(records: Records, seed: int) -> EndToEnd:
    """Put all sequences together; ``seed`` draws the bootstrap, the same sequences for every figure.

    Raises:
        ValueError: no policy ``LIDAR_ALONE``, or no extrapolator ``"repeat"``.
    """
    if LIDAR_ALONE not in records:
        raise ValueError(f"records: found policies {', '.join(records)}, expected {LIDAR_ALONE} among them")
    cases = [(policy, extrapolator) for policy, by in records.items() for extrapolator in by]
    held = _figures(
        {f"{p}\n{e}": [r.held for r in records[p][e]] for p, e in cases},
        f"{LIDAR_ALONE}\n{next(iter(records[LIDAR_ALONE]))}",
        seed,
    )
    produced: dict[str, dict[str, ByMetric]] = {}
    for policy, by in records.items():
        if "repeat" not in by:
            raise ValueError(f"records: found extrapolators {', '.join(by)}, expected repeat among them")
        produced[policy] = _figures(
            {e: [r.produced for r in found] for e, found in by.items()}, "repeat", seed
        )
    sequences = len(next(iter(records[LIDAR_ALONE].values())))
    resamples = resample_sequences(sequences, np.random.default_rng(seed))
    return EndToEnd(
        policies={p: summarise(list(by.values())[-1], resamples) for p, by in records.items()},
        held={p: {e: held[f"{p}\n{e}"] for e in by} for p, by in records.items()},
        produced=produced,
    )


def end_to_end_sections(found: EndToEnd, reference: str, main: str) -> list[Section]:
    """Tables for a document.

    Args:
        found: all figures.
        reference: the policy whose frames stand beside the paper's.
        main: the extrapolator whose policies are compared metric by metric.
    """
    full, paper = FULL_METRICS, PAPER_METRICS
    return [
        Section("Policies", _policies(found)),
        Section(f"Held depth, {metric_label(DECIDING_METRIC)}: policy by extrapolator", _matrix(found)),
        Section(f"Held depth with {main}, full-image metrics", _by_policy(found, main, full)),
        Section(f"Held depth with {main}, the paper's metrics", _by_policy(found, main, paper)),
        Section(
            f"Frames made at the triggers of {reference}, full-image metrics", _made(found, reference, full)
        ),
        Section(
            f"Frames made at the triggers of {reference}, beside the published table `system_eval`",
            _beside(found, reference),
        ),
    ]


def _figures(cases: Mapping[str, Sequence[Mapping[str, float]]], base: str, seed: int) -> dict[str, ByMetric]:
    values = np.array([[[m[name] for name in METRIC_NAMES] for m in records] for records in cases.values()])
    by_row = statistics.summarise(
        values.transpose(1, 0, 2)[:, :, None],
        list(cases),
        ("all",),
        METRIC_NAMES,
        base,
        np.random.default_rng(seed),
    )
    return {row: by_group["all"] for row, by_group in by_row.items()}


def _policies(found: EndToEnd) -> Rows:
    rows = [["policy", "rate Hz", "95 %", "lowest-highest", "precision", "recall", "F1"]]
    for name, summary in found.policies.items():
        limits = f"{summary.rate_min:.1f}-{summary.rate_max:.1f}"
        rates = [f"{summary.rate.mean:.1f}", f"{summary.rate.low:.1f}-{summary.rate.high:.1f}", limits]
        rows.append([name, *rates, *map(_estimate, (summary.precision, summary.recall, summary.f1))])
    low, high = published.RATE_RANGE_HZ
    return [*rows, ["published", f"{published.MEAN_RATE_HZ}", "", f"{low}-{high}", "", "", ""]]


def _estimate(estimate: Estimate) -> str:
    return cell(estimate.mean, 3)


def _matrix(found: EndToEnd) -> Rows:
    extrapolators = list(next(iter(found.held.values())))
    rows = [["policy", "rate Hz", *extrapolators]]
    for policy, by in found.held.items():
        cells = [_changed(by[e][DECIDING_METRIC], policy == LIDAR_ALONE) for e in extrapolators]
        rows.append([policy, f"{found.policies[policy].rate.mean:.1f}", *cells])
    return rows


def _by_policy(found: EndToEnd, extrapolator: str, metrics: Sequence[str]) -> Rows:
    rows = [["policy", "rate Hz", *map(metric_label, metrics), f"change of {metrics[0]}, 95 %"]]
    for policy, by in found.held.items():
        alone = policy == LIDAR_ALONE
        cells = [_changed(by[extrapolator][metric], alone) for metric in metrics]
        first = by[extrapolator][metrics[0]]
        limits = "" if alone else f"{percent(first.change_low)} to {percent(first.change_high)}"
        rows.append([policy, f"{found.policies[policy].rate.mean:.1f}", *cells, limits])
    return rows


def _made(found: EndToEnd, policy: str, metrics: Sequence[str]) -> Rows:
    rows = [["extrapolator", *map(metric_label, metrics)]]
    for extrapolator, by_metric in found.produced[policy].items():
        cells = [_changed(by_metric[metric], extrapolator == "repeat") for metric in metrics]
        rows.append([extrapolator, *cells])
    return rows


def _beside(found: EndToEnd, policy: str) -> Rows:
    rows = _made(found, policy, PAPER_METRICS)
    repeat = published.END_TO_END["repeat"]
    for name, values in published.END_TO_END.items():
        cells = [
            f"{value:g}" + ("" if name == "repeat" else f" ({percent(value / base - 1)})")
            for value, base in zip(values, repeat, strict=True)
        ]
        rows.append([f"published: {name}", *cells])
    return rows


def _changed(figure: Figure, base: bool) -> str:
    return cell(figure.mean, 4) + (
        "" if base or math.isnan(figure.change) else f" ({percent(figure.change)})"
    )
