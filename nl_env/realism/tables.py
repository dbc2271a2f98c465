"""The realism summary as Markdown tables, ours beside what is published."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from nl_env.depth.metrics import PAPER_METRICS
from nl_env.realism import published
from nl_env.realism.network import CONTROLS
from nl_env.realism.summary import Mean, SpeedRow, Summary
from nl_env.realism.targets import targets

Rows = list[list[str]]
NETWORK_METRICS = ("rmse", "abs_rel", "delta_1", "log_mae", "imae", "irmse", "bad_25", "false_return")
"""Both sets: the first three are the paper's."""


def markdown(summary: Summary, heading: str = "##") -> str:
    """All tables, each under a ``heading``."""
    parts = [
        f"{summary.worlds} worlds, {summary.pairs} pairs per gap and world; ± one standard error over worlds."
    ]
    for title, rows in _tables(summary):
        parts += [f"{heading} {title}", _table(rows)]
    return "\n\n".join(parts) + "\n"


def _tables(summary: Summary) -> Iterator[tuple[str, Rows]]:
    yield "Repeat, ours (the paper's, difference)", _repeat(summary)
    yield "Depth change and active pixels with speed", _speeds(summary)
    yield "Keyframe rule", _keyframes(summary)
    yield "Statistics beside the checkpoint's memory", _statistics(summary)
    yield "By scenario and style", _groups(summary)
    if summary.network:
        yield "The authors' checkpoint, unchanged", _network(summary)
        yield "Falsification controls: RMSE divided by Repeat's", _controls(summary)
    if summary.batch_norms is not None:
        yield "Batch-norm distance", _batch_norms(summary)
    yield "Targets", _targets(summary)


def _repeat(summary: Summary) -> Rows:
    rows = [["gap ms", "RMSE m", "AbsRel", "delta < 1.25", "log RMSE", "prior is sky, % (implied)"]]
    for row in summary.gaps:
        known = dict(zip(PAPER_METRICS, published.REPEAT[row.gap_ms], strict=True))
        cells = [str(row.gap_ms)]
        for name, digits in (("rmse", 2), ("abs_rel", 4), ("delta_1", 3), ("log_rmse", 2)):
            ours = row.repeat[name]
            off = f"{ours.value - known[name]:+.3f}" if name == "delta_1" else _off(ours, known[name])
            cells.append(f"{_mean(ours, digits)} ({known[name]:g}, {off})")
        implied = published.PRIOR_SKY[row.gap_ms]
        cells.append(f"{_mean(row.prior_sky, 2, 100)} ({100 * implied:.2f}, {_off(row.prior_sky, implied)})")
        rows.append(cells)
    return rows


def _speeds(summary: Summary) -> Rows:
    gaps = [f"{gap} ms" for gap in published.GAPS_MS]
    rows = [["speed km/h", "pairs", *(f"change m, {g}" for g in gaps), *(f"active %, {g}" for g in gaps)]]
    for row in summary.speeds:
        change = [_mean(mean, 2) for mean in row.depth_change]
        rows.append(
            [speed_label(row), str(row.pairs), *change, *(_mean(mean, 1, 100) for mean in row.active)]
        )
    change = [_mean(row.depth_change, 2) for row in summary.gaps]
    active = [_mean(row.active, 1, 100) for row in summary.gaps]
    return [*rows, ["all", str(summary.worlds * summary.pairs), *change, *active]]


def speed_label(row: SpeedRow) -> str:
    """E.g. ``10-20`` or ``50 and more``."""
    if math.isinf(row.high_kmh):
        return f"{row.low_kmh:.0f} and more"
    return f"{row.low_kmh:.0f}-{row.high_kmh:.0f}"


def _keyframes(summary: Summary) -> Rows:
    k = summary.keyframes
    rows = [["figure", "value"], ["slices that are keyframes", _mean(k.share, 3)]]
    for name, share in k.causes.items():
        rows.append([f"keyframes with cause {name} (with no other)", f"{share:.3f} ({k.alone[name]:.3f})"])
    return [
        *rows,
        ["mean effective rate Hz", f"{_mean(k.rate, 1)} (paper {published.MEAN_RATE_HZ})"],
        ["lowest and highest Hz", f"{k.rate_min:.1f}-{k.rate_max:.1f}"],
        ["sequences between 20 and 50 Hz", f"{k.rate_inside:.2f}"],
    ]


def _statistics(summary: Summary) -> Rows:
    known = published.CHECKPOINT_MEMORY
    return [
        ["figure", "ours", "ELiDAR"],
        *([n, _number(v, 3), known[n]] for n, v in summary.statistics.items()),
    ]


def _groups(summary: Summary) -> Rows:
    gaps = [f"{gap} ms" for gap in published.GAPS_MS]
    rows = [["group", "worlds", *(f"RMSE m, {g}" for g in gaps), *(f"delta, {g}" for g in gaps), "rate Hz"]]
    for g in summary.groups:
        errors = [_number(v, 1) for v in g.rmse] + [_number(v, 3) for v in g.delta_1]
        rows.append([g.name, str(g.worlds), *errors, f"{g.rate:.1f}"])
    return rows


def _network(summary: Summary) -> Rows:
    rows = [["gap ms", "pairs", "frames", *NETWORK_METRICS, "published RMSE"]]
    for row in summary.network:
        known = published.NETWORK_RMSE[row.gap_ms]
        gains = [f"{100 * (row.network[m].value / row.repeat[m].value - 1):+.0f} %" for m in NETWORK_METRICS]
        for name, found in (("Repeat", row.repeat), ("checkpoint", row.network)):
            last = f"{known:g} ({_off(found['rmse'], known)})" if name == "checkpoint" else ""
            cells = [_mean(found[m], 4 if m not in ("rmse", "imae", "irmse") else 2) for m in NETWORK_METRICS]
            rows.append([str(row.gap_ms), str(row.pairs), name, *cells, last])
        rows.append(["", "", "change", *gains, ""])
    return rows


def _controls(summary: Summary) -> Rows:
    rows = [["gap ms", "pairs", *CONTROLS]]
    for row in summary.network:
        ratios = [_number(row.rmse_ratio[name], 2) for name in CONTROLS]
        rows.append([str(row.gap_ms), str(row.control_pairs), *ratios])
    return rows


def _batch_norms(summary: Summary) -> Rows:
    found = summary.batch_norms
    assert found is not None
    groups = (
        ("event stem", found.event_stem),
        ("depth stem", found.depth_stem),
        ("31 layers", found.network),
    )
    return [["layers", "distance"], *([name, f"{value:.4f}"] for name, value in groups)]


def _targets(summary: Summary) -> Rows:
    rows = [["target", "ours", "range", "met"]]
    for t in targets(summary):
        limits = f"at least {t.low:.3g}" if math.isinf(t.high) else f"{t.low:.4g} to {t.high:.4g}"
        met = {None: "not measured", True: "yes", False: "**no**"}[t.met]
        rows.append([t.name, _number(t.value, 4), limits, met])
    return rows


def _off(ours: Mean, known: float) -> str:
    """Relative difference in percent."""
    return "-" if math.isnan(ours.value) else f"{100 * (ours.value / known - 1):+.0f} %"


def _mean(mean: Mean, digits: int, factor: float = 1.0) -> str:
    if math.isnan(mean.value):
        return "-"
    error = "" if math.isnan(mean.error) else f" ± {factor * mean.error:.{digits}f}"
    return f"{factor * mean.value:.{digits}f}{error}"


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _table(rows: Sequence[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|---" + "|--:" * (len(rows[0]) - 1) + "|", *lines[1:]])
