"""Keyframe detection as tables: splits, weather and causes, ours beside the paper's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from nl_env.classification import CAUSES, DetectorSummary, summarise_detector
from nl_env.config import WEATHERS
from nl_env.evaluation import Estimate, resample_sequences
from nl_env.reproduction import published
from nl_env.reproduction.document import Rows, Section, cell
from nl_env.reproduction.keyframes import ScoredSequence

STATISTICS = (
    "f1",
    "precision",
    "recall",
    "balanced_accuracy",
    "auroc",
    "false_positive_rate",
    "f1_gain",
    "rate",
)
"""Columns of the table by split; ``f1_gain`` is F1 above that of always answering "keyframe"."""

WEATHER_GROUPS = {
    "dry": ("ClearNoon", "ClearSunset", "CloudyNoon", "CloudySunset"),
    "wet": ("WetNoon", "WetSunset", "WetCloudyNoon", "WetCloudySunset"),
    "rain": tuple(name for name in WEATHERS if "Rain" in name),
    "noon": tuple(name for name in WEATHERS if name.endswith("Noon")),
    "sunset": tuple(name for name in WEATHERS if name.endswith("Sunset")),
}
"""Few sequences have the same weather, and a sequence's share of keyframes moves its F1 most."""


@dataclass(frozen=True)
class DetectorFile:
    """One trained detector at one operating point.

    Attributes:
        row: row of the table; detectors of one row are training seeds of the same thing.
        threshold: scores above it mean keyframe.
        scores: which line of a sequence's scores is its own.
    """

    row: str
    threshold: float
    scores: int


@dataclass(frozen=True)
class SeedEstimate:
    """A statistic of one row.

    Attributes:
        mean: over the training seeds.
        low, high: 95 % interval over sequences, the mean of the seeds' intervals.
        spread: standard deviation over the training seeds; nan with one.
    """

    mean: float
    low: float
    high: float
    spread: float


@dataclass(frozen=True)
class Group:
    """Some sequences, judged together.

    Attributes:
        sequences: how many.
        keyframes: share of their slices that are keyframes.
        always_f1: F1 of always answering "keyframe".
        rows: by row and statistic; ``recall:CAUSE`` and ``f1:CAUSE`` for one cause.
    """

    sequences: int
    keyframes: float
    always_f1: Estimate
    rows: Mapping[str, Mapping[str, SeedEstimate]]


@dataclass(frozen=True)
class KeyframeFigures:
    """All figures of the table.

    Attributes:
        splits: by split.
        weathers: test sequences by weather and by group of weathers.
        cause_shares: by cause, its share of the test slices; empty where causes are not known.
    """

    splits: Mapping[str, Group]
    weathers: Mapping[str, Group]
    cause_shares: Mapping[str, float]


def summarise_keyframes(
    splits: Mapping[str, Sequence[ScoredSequence]],
    detectors: Sequence[DetectorFile],
    seed: int,
    groups: Mapping[str, Sequence[str]] = WEATHER_GROUPS,
) -> KeyframeFigures:
    """Figures of every split, and of the weathers and causes of ``"test"``.

    Args:
        splits: sequences with a line of scores for each network.
        detectors: what is judged.
        seed: draws the bootstrap.
        groups: weathers that are also judged together.

    Raises:
        ValueError: no test split.
    """
    if "test" not in splits:
        raise ValueError(f"splits: found {', '.join(splits)}, expected test among them")
    test = splits["test"]
    chosen = {name: (name,) for name in WEATHERS} | dict(groups)
    by_weather = {name: [s for s in test if s.weather in names] for name, names in chosen.items()}
    known = all(sequence.causes.shape[1] == len(CAUSES) for sequence in test)
    causes = np.concatenate([sequence.causes for sequence in test]) if known else None
    return KeyframeFigures(
        splits={name: _group(sequences, detectors, seed) for name, sequences in splits.items()},
        weathers={name: _group(s, detectors, seed) for name, s in by_weather.items() if s},
        cause_shares=(
            {} if causes is None else {cause: float(causes[:, i].mean()) for i, cause in enumerate(CAUSES)}
        ),
    )


def _group(sequences: Sequence[ScoredSequence], detectors: Sequence[DetectorFile], seed: int) -> Group:
    resamples = resample_sequences(len(sequences), np.random.default_rng(seed))
    summaries = [
        summarise_detector(
            [sequence.detection(detector.scores) for sequence in sequences], detector.threshold, resamples
        )
        for detector in detectors
    ]
    rows: dict[str, list[dict[str, Estimate]]] = {}
    for detector, summary in zip(detectors, summaries, strict=True):
        rows.setdefault(detector.row, []).append(_statistics(summary))
    return Group(
        sequences=len(sequences),
        keyframes=summaries[0].keyframes.mean,
        always_f1=summaries[0].always_f1,
        rows={
            row: {name: _over_seeds([member[name] for member in members]) for name in members[0]}
            for row, members in rows.items()
        },
    )


def _statistics(summary: DetectorSummary) -> dict[str, Estimate]:
    return {
        **{name: getattr(summary, name) for name in STATISTICS},
        **{f"recall:{cause}": estimate for cause, estimate in summary.recall_by_cause.items()},
        **{f"f1:{cause}": estimate for cause, estimate in summary.f1_by_cause.items()},
    }


def _over_seeds(estimates: Sequence[Estimate]) -> SeedEstimate:
    values = np.array([[e.mean, e.low, e.high] for e in estimates])
    mean, low, high = (float(v) for v in values.mean(axis=0))
    spread = float(values[:, 0].std(ddof=1)) if len(estimates) > 1 else float("nan")
    return SeedEstimate(mean, low, high, spread)


def keyframe_sections(found: KeyframeFigures) -> list[Section]:
    """Tables for a document; none by cause or weather where these are not known."""
    title = "Splits, beside the published table `keyframe_TrainTestAcc`"
    sections = [Section(title, _splits(found), text=2)]
    if found.cause_shares:
        sections.append(Section("Test, by cause", _causes(found), text=2))
    if found.weathers:
        sections.append(Section("Test, F1 by weather", _weathers(found)))
    return sections


def _splits(found: KeyframeFigures) -> Rows:
    labels = {"false_positive_rate": "FPR", "f1_gain": "f1 above always", "rate": "rate Hz"}
    header = ["split", "detector", *(labels.get(name, name) for name in STATISTICS)]
    rows = [[*header, "f1, spread over seeds", "balanced_accuracy, spread"]]
    for split, group in found.splits.items():
        if split in published.KEYFRAMES:
            figures = [f"{value}" for value in published.KEYFRAMES[split]]
            rows.append([split, "published", *figures, *[""] * (len(STATISTICS) - 1)])
        for row, by_name in group.rows.items():
            spreads = [cell(by_name[name].spread, 2) for name in ("f1", "balanced_accuracy")]
            rows.append([split, row, *(_interval(by_name[name]) for name in STATISTICS), *spreads])
        always = [_interval(group.always_f1), cell(group.keyframes, 3), "1", "0.5", "0.5", "1", "0", "50"]
        rows.append([split, "always", *always, "", ""])
    return rows


def _causes(found: KeyframeFigures) -> Rows:
    header = ["cause", "detector", "recall", "recall, spread over seeds", "F1", "published F1"]
    rows = [[*header, "share of slices"]]
    for cause in CAUSES:
        for row, by_name in found.splits["test"].rows.items():
            recall, f1 = by_name[f"recall:{cause}"], by_name[f"f1:{cause}"]
            cells = [_interval(recall), cell(recall.spread, 2), _interval(f1)]
            share = cell(found.cause_shares[cause], 3)
            rows.append([cause, row, *cells, f"{published.CAUSE_F1[cause]}", share])
    return rows


def _weathers(found: KeyframeFigures) -> Rows:
    detectors = list(found.splits["test"].rows)
    rows = [["weather", "sequences", "keyframes", *detectors, "always"]]
    for name, group in found.weathers.items():
        cells = [_interval(group.rows[row]["f1"]) for row in detectors]
        head = [name, str(group.sequences), cell(group.keyframes, 3)]
        rows.append([*head, *cells, _interval(group.always_f1)])
    extremes = []
    for row in detectors:
        values = [group.rows[row]["f1"].mean for name, group in found.weathers.items() if name in WEATHERS]
        extremes.append(f"{cell(min(values), 3)} to {cell(max(values), 3)}")
    rows.append(["lowest to highest weather", "", "", *extremes, ""])
    low, high = published.WEATHER_F1
    return [*rows, ["published", "", "", f"{low} to {high}", *[""] * len(detectors)]]


def _interval(estimate: SeedEstimate | Estimate) -> str:
    limits = f" ({cell(estimate.low, 3)} to {cell(estimate.high, 3)})" if estimate.low < estimate.high else ""
    return cell(estimate.mean, 3) + limits
