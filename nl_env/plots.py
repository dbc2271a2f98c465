"""The comparison's figures as PNG files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from nl_env.comparison import Comparison, PolicyInfo
from nl_env.evaluation import DECIDING_METRIC, Estimate, PolicySummary
from nl_env.frame_rates import rate_by_speed, rate_over_time
from nl_env.frontier import ORACLE, PERIODIC, PERIODIC_CURVE, Frontier
from nl_env.types import SLICE_US

PALETTE = (
    "#4269d0",
    "#e4572e",
    "#3ca951",
    "#a463f2",
    "#d99a00",
    "#17a2a2",
    "#d6569c",
    "#9c6b4e",
    "#6b8e23",
    "#7b5cd6",
    "#c2410c",
    "#0e7490",
    "#be185d",
    "#1f2a44",
    "#f2789f",
    "#84a59d",
    "#b5179e",
    "#e0a458",
    "#006d77",
    "#7f5539",
)
NEUTRAL = "#8a8f98"
"""Colour of families without a knob that look at nothing: the end points of every curve."""


DASHES = ("-", "--", ":", "-.")


def family_colours(policies: Sequence[PolicyInfo]) -> dict[str, str]:
    """One colour per family, the same in every figure; families beyond the palette are neutral."""
    plain = {p.family for p in policies if p.parameter is None and not p.adaptive}
    coloured = list(dict.fromkeys(p.family for p in policies if p.family not in plain))
    return {**dict.fromkeys(coloured + sorted(plain), NEUTRAL), **dict(zip(coloured, PALETTE, strict=False))}


def adaptive_policies(comparison: Comparison) -> list[int]:
    """Listed policies whose frame rate follows the scene; of several trainings the first."""
    chosen: dict[tuple[str, float | None], int] = {}
    for i, policy in enumerate(comparison.policies):
        if policy.listed and policy.adaptive:
            chosen.setdefault((policy.family, policy.parameter), i)
    return list(chosen.values())


def save_plots(comparison: Comparison, folder: Path) -> None:
    """Write into ``folder`` one PNG for every figure that the comparison has the numbers for."""
    figures = [("error_vs_rate", draw_error_against_rate, 4.6), ("rate_vs_speed", draw_rate_by_speed, 3.8)]
    if comparison.frontier is not None:
        figures.append(("frontier", draw_frontier, 7.6))
    if comparison.shown is not None:
        figures.append(("rate_vs_time", draw_rate_over_time, 4.6))
    for name, draw, height in figures:
        figure = Figure(figsize=(7.2, height), layout="constrained")
        FigureCanvasAgg(figure)
        draw(comparison, figure)
        figure.savefig(folder / f"{name}.png", dpi=150, metadata={"Software": None})


def draw_error_against_rate(comparison: Comparison, figure: Figure) -> None:
    """Sweep of each family above the floor that no schedule passes; listed points with intervals."""
    axes = _axes(figure.add_subplot())
    axes.plot(comparison.floor_rates, comparison.floor, color="black", lw=1.2, ls="--", label="floor (exact)")
    for family, colour in family_colours(comparison.policies).items():
        members = [i for i, policy in enumerate(comparison.policies) if policy.family == family]
        members.sort(key=lambda i: comparison.summaries[i].rate.mean)
        rates = [comparison.summaries[i].rate.mean for i in members]
        errors = [comparison.summaries[i].held[DECIDING_METRIC].mean for i in members]
        axes.plot(rates, errors, "o-", color=colour, ms=3, lw=1.4, label=family)
        for i in members:
            if comparison.policies[i].listed:
                _interval(axes, comparison.summaries[i], comparison.saved[i], colour)
    axes.set(xlabel="effective frame rate (Hz)", ylabel=f"held-depth error, {DECIDING_METRIC}")
    axes.legend(frameon=False, fontsize=8)


def draw_frontier(comparison: Comparison, figure: Figure) -> None:
    """Every family's curve, and below it the share of the possible gain that it reaches."""
    frontier = comparison.frontier
    assert frontier is not None
    above, below = (_axes(axes) for axes in figure.subplots(2, 1, sharex=True, height_ratios=(3, 2)))
    colours = curve_colours(comparison)
    shares = gap_closed(frontier)
    for curve in frontier.families:
        colour, dashes = colours[curve.family], "--" if curve.family == ORACLE else "-"
        label = f"{curve.family} ({curve.regret.mean:.2f})"
        above.plot(curve.rate, curve.error, color=colour, ls=dashes, lw=1.4, label=label)
        below.plot(curve.rate, shares[curve.family], color=colour, ls=dashes, lw=1.4)
    above.set(ylabel=f"held-depth error, {DECIDING_METRIC}")
    above.legend(frameon=False, fontsize=7, title="family (regret)", title_fontsize=7, ncols=2)
    below.set(xlabel="effective frame rate (Hz)", ylabel="share of the gap closed", ylim=(-0.25, 1.05))


def curve_colours(comparison: Comparison) -> dict[str, str]:
    """A colour for each curve of the frontier; the oracle's is black."""
    colours = family_colours(comparison.policies)
    periodic = next((colours[name] for name in PERIODIC if name in colours), NEUTRAL)
    return {**colours, PERIODIC_CURVE: periodic, ORACLE: "#000000"}


def gap_closed(frontier: Frontier) -> dict[str, NDArray[np.float64]]:
    """Per family and rate, how much of the way from periodic triggering to the oracle it goes.

    nan near the ends, where all curves meet.
    """
    periodic, oracle = frontier[PERIODIC_CURVE].error, frontier[ORACLE].error
    gap = periodic - oracle
    gap = np.where(gap > 0.05 * gap.max(), gap, np.nan)
    return {curve.family: (periodic - curve.error) / gap for curve in frontier.families}


def draw_rate_over_time(comparison: Comparison, figure: Figure) -> None:
    """Frame rate of the adaptive policies on the shown sequence, over the ego speed."""
    assert comparison.shown is not None
    result = comparison.sequences[comparison.shown]
    above, below = (_axes(axes) for axes in figure.subplots(2, 1, sharex=True, height_ratios=(3, 1)))
    seconds = np.arange(result.slices + 1) * SLICE_US / 1e6
    for i, (colour, dashes) in _line_styles(comparison).items():
        name = comparison.policies[i].name
        above.plot(seconds[1:], rate_over_time(result, i), color=colour, ls=dashes, lw=1.3, label=name)
    above.set(ylabel="effective frame rate (Hz)", ylim=(0, 1e6 / SLICE_US * 1.04))
    above.legend(frameon=False, fontsize=8, ncols=4, loc="lower left", bbox_to_anchor=(0, 1))
    below.fill_between(seconds, result.ego_speed, color=NEUTRAL, alpha=0.35, lw=0)
    below.set(xlabel="time (s)", ylabel="ego speed (m/s)", xlim=(0, seconds[-1]), ylim=(0, None))


def draw_rate_by_speed(comparison: Comparison, figure: Figure) -> None:
    """Mean frame rate of the adaptive policies by ego speed, over all sequences."""
    axes = _axes(figure.add_subplot())
    for i, (colour, dashes) in _line_styles(comparison).items():
        name, curve = comparison.policies[i].name, rate_by_speed(comparison.sequences, i)
        axes.plot(curve.speed, curve.rate, "o", color=colour, ls=dashes, ms=3.5, lw=1.4, label=name)
    axes.set(xlabel="ego speed (m/s)", ylabel="effective frame rate (Hz)", xlim=(0, None), ylim=(0, None))
    axes.legend(frameon=False, fontsize=8)


def _line_styles(comparison: Comparison) -> dict[int, tuple[str, str]]:
    """Colour and dashes of each adaptive policy; members of one family share the colour."""
    colours = family_colours(comparison.policies)
    seen: Counter[str] = Counter()
    styles = {}
    for i in adaptive_policies(comparison):
        family = comparison.policies[i].family
        styles[i] = colours[family], DASHES[seen[family] % len(DASHES)]
        seen[family] += 1
    return styles


def _interval(axes: Axes, summary: PolicySummary, saved: Estimate, colour: str) -> None:
    """A large point and the interval of what it saves, drawn from the mean error of the LiDAR alone."""
    rate, error = summary.rate.mean, summary.held[DECIDING_METRIC].mean
    alone = error + saved.mean
    axes.plot([rate, rate], [alone - saved.low, alone - saved.high], color=colour, lw=1, alpha=0.5)
    axes.plot(rate, error, "o", color=colour, ms=6, mec="white", mew=0.8)


def _axes(axes: Axes) -> Axes:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#000000", alpha=0.08, lw=0.6)
    return axes
