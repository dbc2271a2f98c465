"""The comparison's tables, as aligned text for a terminal and as Markdown."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from nl_env.comparison import Comparison
from nl_env.depth.metrics import FULL_METRICS, LOWER_IS_BETTER, PAPER_METRICS
from nl_env.evaluation import DECIDING_METRIC, EnergyModel, Estimate, PolicySummary
from nl_env.frontier import BASELINE, MATCHED_RATES, Frontier

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

FRONTIER_NOTES = """\
Curves are lower convex hulls of a family's operating points and of holding or triggering always: between two
points one can switch over time. `regret`: area between the curve and the optimal oracle's over all frame
rates, divided by the area between periodic triggering's and the oracle's; `periodic` is the best of spreading
triggers evenly (families `periodic` and `evenly`), and `schedule` the best of all fixed schedules of an
interval. The columns in Hz give the held-depth error at that effective rate. `Hz as good as periodic`: the
rate at which the family reaches the error of periodic triggering at 40.6 Hz, the mean rate of the paper's
rule, and the power that this takes. Second table: differences in units of 1e-5. Intervals are 95 % bootstraps
over sequences, paired: all policies play the same sequences. Several trainings are averaged; in brackets the
lowest and highest regret of one.
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
    if comparison.frontier is not None:
        parts += ["## Frontier", frontier_markdown(comparison.frontier), FRONTIER_NOTES]
    for title, frames in _METRIC_TABLES:
        parts.append(f"## {title}")
        for metrics in (FULL_METRICS, PAPER_METRICS):
            parts.append(_markdown(_metric_rows(comparison, metrics, frames)))
    return "\n\n".join(parts) + "\n"


def frontier_markdown(frontier: Frontier) -> str:
    """Regret and matched operating points of every family, the best first."""
    return _markdown(frontier_rows(frontier)) + "\n\n" + _markdown(matched_rows(frontier))


def frontier_rows(frontier: Frontier) -> list[list[str]]:
    """A header row, then one row per family: its regret and what it reaches at matched rates."""
    rates = [f"{rate:g} Hz" for rate in MATCHED_RATES]
    energy = EnergyModel()
    rows = [["family", "regret", "95 %", "trainings", *rates, "Hz as good as periodic", "W there"]]
    for curve in frontier.families:
        errors = {matched.rate: matched.error for matched in curve.matched}
        spread = f"{curve.runs} ({curve.regret_low:.3f}-{curve.regret_high:.3f})" if curve.runs > 1 else ""
        needed, lidar_hz = curve.rate_for_periodic.mean, float(curve.rate[0])
        rows.append(
            [
                curve.family,
                _cell(curve.regret, 3),
                _interval(curve.regret, 3) if math.isfinite(curve.regret.mean) else "-",
                spread,
                *(_cell(errors[rate], 5) if rate in errors else "-" for rate in MATCHED_RATES),
                _cell(curve.rate_for_periodic, 1),
                _fixed(energy.energy(lidar_hz, needed - lidar_hz, 1.0), 1) if math.isfinite(needed) else "-",
            ]
        )
    return rows


def matched_rows(frontier: Frontier) -> list[list[str]]:
    """Differences at matched rates: from periodic triggering, and from the paper's detector if it played."""
    rows = [["family"]]
    rows[0] += [f"below periodic, {rate:g} Hz" for rate in MATCHED_RATES]
    baseline = any(matched.below_baseline for curve in frontier.families for matched in curve.matched)
    if baseline:
        rows[0] += [f"below {BASELINE}, {rate:g} Hz" for rate in MATCHED_RATES]
    for curve in frontier.families:
        at = {matched.rate: matched for matched in curve.matched}
        differences = [at[rate].saved if rate in at else None for rate in MATCHED_RATES]
        if baseline:
            differences += [at[rate].below_baseline if rate in at else None for rate in MATCHED_RATES]
        rows.append([curve.family, *(_difference(estimate) for estimate in differences)])
    return rows


def _difference(estimate: Estimate | None) -> str:
    """Times 1e5, with its interval."""
    if estimate is None or not math.isfinite(estimate.mean):
        return "-"
    mean, low, high = (round(1e5 * value) for value in (estimate.mean, estimate.low, estimate.high))
    return f"{mean} ({low} to {high})"


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


def _interval(estimate: Estimate, digits: int = 4) -> str:
    return f"{_fixed(estimate.low, digits)}-{_fixed(estimate.high, digits)}"


def _fixed(value: float, digits: int) -> str:
    """Decimals without a negative zero."""
    return f"{round(value, digits) + 0.0:.{digits}f}"


def _markdown(rows: Sequence[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|---" + "|--:" * (len(rows[0]) - 1) + "|", *lines[1:]])
