"""Depth error by gap and by ablation as tables, ours beside the paper's."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from nl_env.depth.metrics import FULL_METRICS, PAPER_METRICS
from nl_env.reproduction import published
from nl_env.reproduction.document import Rows, Section, cell, percent
from nl_env.reproduction.figures import Figure, Figures
from nl_env.reproduction.gaps import GROUPS, MEAN
from nl_env.tables import metric_label

REPEAT = "repeat"
"""The row that every change is against."""


def rate_sections(figures: Figures, networks: Sequence[str]) -> list[Section]:
    """Tables of depth error by gap.

    Args:
        figures: by row, gap and metric; has a row ``REPEAT``.
        networks: rows that stand beside the published network.
    """
    sections = [
        Section("Mean over the five gaps: full-image metrics", _means(figures, FULL_METRICS)),
        Section("Mean over the five gaps: the paper's metrics", _means(figures, PAPER_METRICS)),
    ]
    for title, metrics in (("Full-image metrics", FULL_METRICS), ("The paper's metrics", PAPER_METRICS)):
        sections.append(Section(f"{title} by gap", _by_gap(figures, metrics), text=2))
    sections.append(Section("Beside the published table `acc_fps`", _beside(figures, networks), text=2))
    return sections


def ablation_sections(figures: Figures, names: Mapping[str, str]) -> list[Section]:
    """Tables of the ablations: mean over the five gaps, both metric sets, and the paper's table.

    Args:
        figures: by row, gap and metric; has a row ``REPEAT``.
        names: rows that the paper has too, and their keys in ``published.ABLATION``.
    """
    sections = [
        Section("Mean over the five gaps: full-image metrics", _means(figures, FULL_METRICS)),
        Section("Mean over the five gaps: the paper's metrics", _means(figures, PAPER_METRICS)),
    ]
    pairs = {row: key for row, key in names.items() if row in figures}
    if pairs:
        sections.append(Section("Beside the published table `ablation`", _ablation(figures, pairs), text=2))
    return sections


def gap_label(group: str) -> str:
    """E.g. ``20 ms (50 Hz)``, or the name of a group that is not one gap."""
    return f"{group} ms ({1000 // int(group)} Hz)" if group.isdigit() else group


def _means(figures: Figures, metrics: Sequence[str]) -> Rows:
    """One line per row: mean over gaps and its change; interval and spread of the first metric."""
    first = metrics[0]
    header = ["method", *(metric_label(name) for name in metrics)]
    rows = [[*header, f"change of {first}, 95 %", f"{first}, spread over seeds"]]
    for name, by_gap in figures.items():
        of_first = by_gap[MEAN][first]
        limits = f"{percent(of_first.change_low)} to {percent(of_first.change_high)}"
        rows.append(
            [
                name,
                *(_changed(by_gap[MEAN][metric], name) for metric in metrics),
                "" if name == REPEAT else limits,
                cell(of_first.spread, 2),
            ]
        )
    return rows


def _by_gap(figures: Figures, metrics: Sequence[str]) -> Rows:
    rows = [["gap", "method", *(metric_label(name) for name in metrics)]]
    for group in (*GROUPS, MEAN):
        for name, by_gap in figures.items():
            cells = [_with_error(by_gap[group][metric], name) for metric in metrics]
            rows.append([gap_label(group), name, *cells])
    return rows


def _beside(figures: Figures, networks: Sequence[str]) -> Rows:
    """Repeat and the networks, published and here, by gap."""
    rows = [["gap", "row", *(metric_label(name) for name in PAPER_METRICS)]]
    for group in GROUPS:
        adaptive = group == published.ADAPTIVE
        repeat = published.ADAPTIVE_REPEAT if adaptive else published.REPEAT[int(group)]
        network = published.ADAPTIVE_NETWORK if adaptive else published.NETWORK[int(group)]
        gap = gap_label(group)
        rows.append([gap, "Repeat, published", *(cell(value, 4) for value in repeat)])
        rows.append([gap, "Repeat, here", *_plain(figures[REPEAT][group])])
        changes = [
            f"{cell(value, 4)} ({percent(value / base - 1)})"
            for value, base in zip(network, repeat, strict=True)
        ]
        rows.append([gap, "paper's network, published", *changes])
        for row in networks:
            cells = [_changed(figures[row][group][metric], row) for metric in PAPER_METRICS]
            rows.append([gap, f"{row}, here", *cells])
    return rows


def _ablation(figures: Figures, names: Mapping[str, str]) -> Rows:
    """The paper's rows with those measured here, both on gaps drawn at random."""
    rows = [["variant", "row", *(metric_label(name) for name in PAPER_METRICS)]]
    for row, key in names.items():
        rows.append([key, "published", *(cell(value, 4) for value in published.ABLATION[key])])
        rows.append([key, row, *_plain(figures[row][published.ADAPTIVE])])
    return rows


def _plain(by_metric: Mapping[str, Figure]) -> list[str]:
    return [cell(by_metric[metric].mean, 4) for metric in PAPER_METRICS]


def _changed(figure: Figure, row: str) -> str:
    change = "" if row == REPEAT or math.isnan(figure.change) else f" ({percent(figure.change)})"
    return cell(figure.mean, 4) + change


def _with_error(figure: Figure, row: str) -> str:
    change = "" if row == REPEAT or math.isnan(figure.change) else f" ({percent(figure.change)})"
    return f"{cell(figure.mean, 4)} ± {cell(figure.standard_error, 2)}{change}"
