"""The comparison's tables, as aligned text for a terminal and as Markdown."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from nl_env.comparison import Comparison
from nl_env.depth.metrics import FULL_METRICS, LOWER_IS_BETTER, PAPER_METRICS
from nl_env.evaluation import DECIDING_METRIC, Estimate, PolicySummary

UNITS = {"rmse": "m", "sq_rel": "m", "imae": "1/km", "irmse": "1/km"}
"""Metrics not listed are pure numbers or shares."""

NOTES = """\
\\* privileged: reads labels or true depth that no sensor gives. `saved`: held-depth error of the LiDAR
alone minus the policy's, taken within sequences. `above floor`: held-depth error minus the least error
that any schedule with as many triggers could have reached (exact). `produced`: error of the extrapolated
frames alone. Precision, recall and F1 are against the paper's keyframe rule at slices
without a LiDAR frame; the row `always` is the all-positive answer. Intervals are 95 % percentile
bootstraps over sequences. Power: 0.8 J a LiDAR frame (VLP-16 data sheet, 8 W at 10 Hz), 0.28 J an
extrapolation (the paper's 9.31 ms at an assumed 30 W), 0.5 W for the event camera (the paper's figure).
"""

_COLUMNS: tuple[tuple[str, Callable[[PolicySummary, Estimate, float], str]], ...] = (
    ("rate Hz", lambda s, saved, above: _cell(s.rate, 1)),
    ("min-max", lambda s, saved, above: f"{s.rate_min:.0f}-{s.rate_max:.0f}"),
    (DECIDING_METRIC, lambda s, saved, above: _cell(s.held[DECIDING_METRIC], 4)),
    ("95 %", lambda s, saved, above: _interval(s.held[DECIDING_METRIC])),
    ("saved", lambda s, saved, above: _cell(saved, 4)),
    ("95 %", lambda s, saved, above: _interval(saved)),
    ("above floor", lambda s, saved, above: _fixed(above, 4)),
    ("imae 1/km", lambda s, saved, above: _cell(s.held["imae"], 2)),
    ("bad_25", lambda s, saved, above: _cell(s.held["bad_25"], 3)),
    ("rmse m", lambda s, saved, above: _cell(s.held["rmse"], 2)),
    ("abs_rel", lambda s, saved, above: _cell(s.held["abs_rel"], 3)),
    ("produced", lambda s, saved, above: _cell(s.produced[DECIDING_METRIC], 4)),
    ("trig/s", lambda s, saved, above: _cell(s.triggers_per_s, 1)),
    ("prec", lambda s, saved, above: _cell(s.precision, 2)),
    ("recall", lambda s, saved, above: _cell(s.recall, 2)),
    ("F1", lambda s, saved, above: _cell(s.f1, 2)),
    ("W", lambda s, saved, above: _cell(s.power_w, 1)),
)
"""Header and cell of the main table, from a summary, what it saves, and how far it is above the floor."""

_METRIC_TABLES: tuple[tuple[str, Callable[[PolicySummary], Mapping[str, Estimate]]], ...] = (
    ("Held depth: time average, what the consumer sees", lambda summary: summary.held),
    ("Produced frames: at triggered slices only", lambda summary: summary.produced),
)


def text_report(comparison: Comparison) -> str:
    """The main table aligned with spaces: names to the left, numbers to the right."""
    rows = _overview(comparison)
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = [
        "  ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))])
        for row in rows
    ]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]])


def markdown_report(comparison: Comparison) -> str:
    """``table.md``: the overview, then every metric of the held and of the produced frames."""
    settings = ", ".join(
        f"{name} {value}" for name, value in comparison.settings.items() if name != "policies"
    )
    parts = ["# Trigger policies compared", settings, _markdown(_overview(comparison)), NOTES]
    for title, frames in _METRIC_TABLES:
        parts.append(f"## {title}")
        for metrics in (FULL_METRICS, PAPER_METRICS):
            parts.append(_markdown(_metric_rows(comparison, metrics, frames)))
    return "\n\n".join(parts) + "\n"


def metric_label(name: str) -> str:
    """Name, unit and which direction is better, e.g. ``rmse m ↓``."""
    unit = f" {UNITS[name]}" if name in UNITS else ""
    return f"{name}{unit} {'↓' if LOWER_IS_BETTER[name] else '↑'}"


def _overview(comparison: Comparison) -> list[list[str]]:
    """A header row, then one row per listed policy."""
    rows = [["policy", *(header for header, _ in _COLUMNS)]]
    for i, (policy, summary) in enumerate(zip(comparison.policies, comparison.summaries, strict=True)):
        if policy.listed:
            name = policy.name + ("*" if policy.privileged else "")
            rows.append(
                [
                    name,
                    *(cell(summary, comparison.saved[i], comparison.above_floor(i)) for _, cell in _COLUMNS),
                ]
            )
    return rows


def _metric_rows(
    comparison: Comparison,
    metrics: Sequence[str],
    frames: Callable[[PolicySummary], Mapping[str, Estimate]],
) -> list[list[str]]:
    rows = [["policy", "rate Hz", *(metric_label(name) for name in metrics)]]
    for policy, summary in zip(comparison.policies, comparison.summaries, strict=True):
        if policy.listed:
            cells = [_cell(frames(summary)[name], 4) for name in metrics]
            rows.append([policy.name, _cell(summary.rate, 1), *cells])
    return rows


def _cell(estimate: Estimate, digits: int) -> str:
    return _fixed(estimate.mean, digits) if math.isfinite(estimate.mean) else "-"


def _interval(estimate: Estimate) -> str:
    return f"{_fixed(estimate.low, 4)}-{_fixed(estimate.high, 4)}"


def _fixed(value: float, digits: int) -> str:
    """Decimals without a negative zero."""
    return f"{round(value, digits) + 0.0:.{digits}f}"


def _markdown(rows: Sequence[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|---" + "|--:" * (len(rows[0]) - 1) + "|", *lines[1:]])
