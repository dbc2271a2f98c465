"""The paper's two motivation plots: how depth and events change with time at different ego speeds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from nl_env.realism.published import GAPS_MS
from nl_env.realism.summary import Mean, Summary
from nl_env.realism.tables import speed_label

DEPTH_PLOT, EVENT_PLOT = "depth_change.png", "event_change.png"


def save_plots(summary: Summary, folder: Path) -> None:
    """Write ``DEPTH_PLOT`` and ``EVENT_PLOT`` into ``folder``; the latter is empty without events."""
    rows = [row for row in summary.speeds if row.pairs]
    labels = [f"{speed_label(row)} km/h" for row in rows]
    _save(folder / DEPTH_PLOT, labels, [row.depth_change for row in rows], "mean |depth change| (m)", 1.0)
    _save(folder / EVENT_PLOT, labels, [row.active for row in rows], "active event pixels (%)", 100.0)


def _save(
    path: Path, labels: Sequence[str], bands: Sequence[Sequence[Mean]], ylabel: str, factor: float
) -> None:
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for i, (label, band) in enumerate(zip(labels, bands, strict=True)):
        values = [factor * mean.value for mean in band]
        errors = [factor * mean.error for mean in band]
        colour = colormaps["viridis"](0.9 * i / max(len(bands) - 1, 1))
        axes.errorbar(GAPS_MS, values, errors, fmt="o-", ms=3.5, lw=1.5, capsize=2, color=colour, label=label)
    axes.set(xlabel="time (ms)", ylabel=ylabel, xlim=(0, None), ylim=(0, None))
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#000000", alpha=0.08, lw=0.6)
    axes.legend(frameon=False, fontsize=8, title="ego speed")
    figure.savefig(path, dpi=150, metadata={"Software": None})
