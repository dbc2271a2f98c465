"""What the learned pair has to reach, checked against the figures of the tables."""

from __future__ import annotations

import math
from collections.abc import Iterable

from nl_env.config import WEATHERS
from nl_env.depth.metrics import FULL_METRICS, LOWER_IS_BETTER, PAPER_METRICS
from nl_env.evaluation import DECIDING_METRIC
from nl_env.realism.targets import Target
from nl_env.reproduction.document import Rows, Section, cell
from nl_env.reproduction.end_to_end_tables import EndToEnd
from nl_env.reproduction.figures import Figure, Figures
from nl_env.reproduction.gap_tables import REPEAT
from nl_env.reproduction.gaps import MEAN
from nl_env.reproduction.keyframe_tables import KeyframeFigures
from nl_env.reproduction.published import GAPS_MS

QUARTER = {"log_mae": -0.40, "imae": -0.40, "bad_25": -0.35, "rmse": -0.40}
LARGER = {"log_mae": -0.45, "imae": -0.50, "bad_25": -0.45, "rmse": -0.40}
"""Change against Repeat, mean over the gaps, at 120x160 and at higher resolutions."""

EVENTS_WORTH = 0.05
"""Share of Repeat's error that is lost without events, and with events in the wrong order."""

WEATHER_SPREAD = 0.05
"""Of a detector's F1, from the lowest weather to the highest."""

MOST_HZ = 41.0
HELD_QUARTER, HELD_LARGER = -0.20, -0.25
"""Change of the held depth's error against the LiDAR alone."""


def rate_targets(figures: Figures, ours: str, resolution: str) -> list[Target]:
    """Targets of the depth error by gap; none without a row ``ours``."""
    if ours not in figures:
        return []
    mean = figures[ours][MEAN]
    limits = QUARTER if resolution == "quarter" else LARGER
    found = [
        Target(f"change of {name} against Repeat, mean over gaps", mean[name].change, -1.0, limit)
        for name, limit in limits.items()
    ]
    for title, metrics in (("full-image", FULL_METRICS), ("the paper's", PAPER_METRICS)):
        change, where = max(
            (_loss(figures[ours][str(gap)][name], name), f"{name} at {gap} ms")
            for gap in GAPS_MS
            for name in metrics
        )
        found.append(Target(f"worst change of {title} metrics, any gap ({where})", change, -1.0, 0.0))
    return found


def ablation_targets(figures: Figures, ours: str, without: Iterable[str]) -> list[Target]:
    """What events are worth: error of the rows ``without`` them above ours, as a share of Repeat's."""
    if ours not in figures:
        return []
    repeat, best = (figures[row][MEAN][DECIDING_METRIC].mean for row in (REPEAT, ours))
    return [
        Target(
            f"{DECIDING_METRIC} lost, {row}",
            (figures[row][MEAN][DECIDING_METRIC].mean - best) / repeat,
            EVENTS_WORTH,
            math.inf,
        )
        for row in without
        if row in figures
    ]


def keyframe_targets(found: KeyframeFigures, frame: str, temporal: str) -> list[Target]:
    """Targets of two detectors on the test split; new objects are for the one named ``temporal``."""
    targets = []
    rows = found.splits["test"].rows
    for row, by_name in ((row, rows[row]) for row in (frame, temporal) if row in rows):
        f1 = [group.rows[row]["f1"].mean for name, group in found.weathers.items() if name in WEATHERS]
        targets += [
            Target(f"{row}: F1", by_name["f1"].mean, 0.85, 1.0),
            Target(f"{row}: F1 above always", by_name["f1_gain"].mean, 0.05, 1.0),
            Target(f"{row}: balanced accuracy", by_name["balanced_accuracy"].mean, 0.80, 1.0),
            Target(f"{row}: F1, highest minus lowest weather", max(f1) - min(f1), 0.0, WEATHER_SPREAD),
        ]
        if row == temporal:
            targets.append(Target(f"{row}: recall of new objects", by_name["recall:new"].mean, 0.60, 1.0))
    return targets


def end_to_end_targets(found: EndToEnd, detectors: Iterable[str], ours: str, resolution: str) -> list[Target]:
    """Targets of the keyframe ``detectors`` with the extrapolator ``ours``."""
    limit = HELD_QUARTER if resolution == "quarter" else HELD_LARGER
    held = {policy: by[ours][DECIDING_METRIC] for policy, by in found.held.items()}
    once = min(figure.mean for policy, figure in held.items() if policy.startswith("once"))
    targets = []
    for name in detectors:
        targets += [
            Target(f"{name}: mean rate, Hz", found.policies[name].rate.mean, 0.0, MOST_HZ),
            Target(f"{name}: change of held {DECIDING_METRIC}", held[name].change, -1.0, limit),
        ]
    decided = Target(
        "always against once per interval, best slice", held["always"].mean / once - 1, -1.0, 0.0
    )
    return [*targets, decided]


def target_section(targets: list[Target]) -> list[Section]:
    """The table of targets, or nothing where there is none."""
    rows: Rows = [["target", "value", "range", "met"]]
    for target in targets:
        low, high = (cell(limit, 3) for limit in (target.low, target.high))
        limits = f"at least {low}" if math.isinf(target.high) else f"{low} to {high}"
        met = {None: "not measured", True: "yes", False: "**no**"}[target.met]
        rows.append([target.name, cell(target.value, 4), limits, met])
    return [Section("Targets", rows)] if targets else []


def _loss(figure: Figure, metric: str) -> float:
    """Relative change, positive when worse."""
    return figure.change if LOWER_IS_BETTER[metric] else -figure.change
