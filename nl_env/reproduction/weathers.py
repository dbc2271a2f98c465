"""Keyframe detectors in every weather: the same worlds and drives, rendered and sensed once under each.

Across recorded sequences a weather's F1 says most of all which drives happened to have that weather. Here the
labels of all weathers are the same, and what differs is what the weather does to the detector.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nl_env.classification import CAUSES
from nl_env.config import WEATHERS, DrivingConfig
from nl_env.keyframes import label_keyframe
from nl_env.realism.targets import Target
from nl_env.reproduction.document import Rows, Section, cell
from nl_env.reproduction.keyframe_tables import KeyframeFigures
from nl_env.reproduction.keyframes import OBSERVED, ScoredSequence, Scorer
from nl_env.reproduction.targets import WEATHER_SPREAD
from nl_env.streams import SyntheticStream

STATISTICS = {"f1": "F1", "balanced_accuracy": "balanced accuracy", "rate": "rate Hz"}
"""Columns of every detector in the table, by statistic."""


@dataclass(frozen=True)
class ScoredWorld:
    """Labels and scores of slices 1..K of one world in every weather.

    Attributes:
        seed: of the sequence.
        causes: ``(K, 3)`` bool, in the order of ``nl_env.classification.CAUSES``; of every weather.
        lidar: ``(K,)`` bool, slices with a LiDAR frame.
        scores: ``(weathers, models, K)`` float64.
    """

    seed: int
    causes: NDArray[np.bool_]
    lidar: NDArray[np.bool_]
    scores: NDArray[np.float64]

    def in_weathers(self) -> list[ScoredSequence]:
        """The world as one sequence for each of ``WEATHERS``."""
        return [
            ScoredSequence(self.seed, weather, self.causes, self.lidar, scores)
            for weather, scores in zip(WEATHERS, self.scores, strict=True)
        ]

    def save(self, path: Path) -> None:
        """Write everything to one ``.npz`` file (no pickle)."""
        np.savez_compressed(path, seed=self.seed, causes=self.causes, lidar=self.lidar, scores=self.scores)

    @classmethod
    def load(cls, path: Path) -> ScoredWorld:
        """Read what :meth:`save` wrote."""
        with np.load(path) as file:
            return cls(int(file["seed"]), file["causes"], file["lidar"], file["scores"])


@dataclass(frozen=True)
class WeatherTask:
    """The work of one process: every detector on one world in every weather.

    Attributes:
        config: of the worlds; its weather is replaced.
        make: makes the scorers, in the process that uses them.
    """

    config: DrivingConfig
    make: Callable[[], Sequence[Scorer]]

    def __call__(self, seed: int) -> ScoredWorld:
        """Simulate and score the world of ``seed``.

        Raises:
            RuntimeError: labels that depend on the weather.
        """
        scorers = self.make()
        labels, scores = [], []
        for weather in WEATHERS:
            frames, causes = _drive(
                replace(self.config, scene=replace(self.config.scene, weather=weather)), seed
            )
            labels.append(causes)
            scores.append([scorer(frames) for scorer in scorers])
        if any((causes != labels[0]).any() for causes in labels):
            raise RuntimeError(f"world {seed}: found labels that differ between weathers")
        lidar = np.arange(1, self.config.scene.slices + 1) % self.config.lidar.period == 0
        return ScoredWorld(seed, labels[0], lidar, np.array(scores, np.float64))


def weather_section(found: KeyframeFigures) -> Section:
    """The table: each detector under each weather, and how far the weathers lie apart."""
    columns = [(row, name) for row in found.splits["test"].rows for name in STATISTICS]
    rows: Rows = [["weather", *(f"{row}: {STATISTICS[name]}" for row, name in columns)]]
    for weather, group in found.weathers.items():
        rows.append([weather, *(cell(group.rows[row][name].mean, 3) for row, name in columns)])
    extremes = [_extremes(found, *column) for column in columns]
    rows.append(["lowest to highest", *(f"{cell(low, 3)} to {cell(high, 3)}" for low, high in extremes)])
    rows.append(["highest minus lowest", *(cell(high - low, 2) for low, high in extremes)])
    always = cell(found.splits["test"].always_f1.mean, 3)
    return Section(f"The same worlds in every weather (F1 of `always`: {always})", rows)


def weather_targets(found: KeyframeFigures, detectors: Sequence[str]) -> list[Target]:
    """How far the F1 of ``detectors`` may differ between weathers."""
    targets = []
    for row in detectors:
        low, high = _extremes(found, row, "f1")
        targets.append(Target(f"{row}: F1, highest minus lowest weather", high - low, 0.0, WEATHER_SPREAD))
    return targets


def _extremes(found: KeyframeFigures, row: str, statistic: str) -> tuple[float, float]:
    values = [found.weathers[weather].rows[row][statistic].mean for weather in WEATHERS]
    return min(values), max(values)


def _drive(config: DrivingConfig, seed: int) -> tuple[NDArray[np.int16], NDArray[np.bool_]]:
    """Event frames ``(K, H, W)`` as observed and causes ``(K, 3)`` of slices 1..K."""
    stream = SyntheticStream(config)
    stream.reset(seed)
    frames = np.empty((stream.slices, *stream.camera.shape), np.int16)
    causes = np.empty((stream.slices, len(CAUSES)), bool)
    for frame, row in zip(frames, causes, strict=True):
        sample = stream.advance()
        np.clip(sample.event_frame, *OBSERVED, out=frame)
        label = label_keyframe(sample.state)
        row[:] = label.speed, label.distance, label.new
    return frames, causes
