"""The tables on keyframe detectors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from agents.keyframe_cnn import FRAME_WEIGHTS, TEMPORAL_WEIGHTS, load_detector
from agents.table_policies import FRAME, TEMPORAL, LoadScorers
from nl_env.config import SPLITS, WEATHERS, DrivingConfig, SceneConfig, number
from nl_env.reproduction.data import Sequences, SimulatedWorlds, find_sequences
from nl_env.reproduction.elidar import WEATHER_GROUPS as ELIDAR_WEATHERS
from nl_env.reproduction.elidar import ElidarScoreTask
from nl_env.reproduction.keyframe_tables import (
    WEATHER_GROUPS,
    DetectorFile,
    keyframe_sections,
    summarise_keyframes,
)
from nl_env.reproduction.keyframes import ScoredSequence, ScoreTask
from nl_env.reproduction.targets import keyframe_targets, target_section
from nl_env.reproduction.weathers import ScoredWorld, WeatherTask, weather_section, weather_targets
from scripts.tables.options import Common, Making, measure


@dataclass(frozen=True)
class TableKeyframe:
    """Keyframe detection: F1, precision, recall, balanced accuracy, AUROC; by cause and by weather."""

    common: Annotated[Common, tyro.conf.OmitArgPrefixes]
    train: Path | None = None
    """Recordings of the train split, or ELiDAR once more, for the paper's train row."""
    train_sequences: int | None = None
    """Measure the train row on the first ones only."""
    weights: tuple[Path, ...] = (FRAME_WEIGHTS,)
    """The paper's network, one file for each training seed."""
    temporal_weights: tuple[Path, ...] = (TEMPORAL_WEIGHTS,)
    """The network with a memory, one file for each training seed."""
    recipe_weights: tuple[Path, ...] = ()
    """The paper's network trained by the paper's recipe, one file for each training seed."""

    def run(self, command: str) -> None:
        """Measure, write and print the table."""
        release = self.common.release()
        test = self.common.test() if release is None else release.labelled("test", self.common.sequences)
        data = {"test": test}
        if self.train is not None:
            data = {"train": self._train_data(self.train), **data}
        rows = [(FRAME, path) for path in self.weights]
        rows += [(TEMPORAL, path) for path in self.temporal_weights]
        rows += [(f"{FRAME}, the paper's recipe", path) for path in self.recipe_weights]
        paths = tuple(path for _, path in rows)
        detectors = detectors_of(rows)
        job = self.common.job("table-keyframe", data, paths, {}, self.common.on_error)
        files = {seed: file for found in data.values() for seed, file in found.files.items()}
        task = (ScoreTask if release is None else ElidarScoreTask)(files, LoadScorers(paths))
        scored = measure(job, task, ScoredSequence.load)
        groups = WEATHER_GROUPS if release is None else ELIDAR_WEATHERS
        figures = summarise_keyframes(scored, detectors, self.common.seed, groups)
        notes = f"All slices count. {noted(detectors)}"
        sections = keyframe_sections(figures)
        if release is None:
            sections += target_section(keyframe_targets(figures, FRAME, TEMPORAL))
        else:
            notes += " Every fifth slice counts as one with a LiDAR frame."
            if not release.raw("test"):
                notes += " No raw sequences: event frames drawn one by one, no causes, no weather."
        print(job.publish(sections, figures, command, notes))

    def _train_data(self, folder: Path) -> Sequences:
        release = self.common.release(folder)
        if release is None:
            return find_sequences(folder, self.train_sequences)
        return release.labelled("train", self.train_sequences)


@dataclass(frozen=True)
class TableWeather:
    """Keyframe detection in every weather: the same test worlds under each of the fourteen."""

    making: Annotated[Making, tyro.conf.OmitArgPrefixes]
    worlds: int = 24
    """Test sequences, from the first on."""
    duration: float = 10.0
    """Of each, s."""
    weights: tuple[Path, ...] = (FRAME_WEIGHTS,)
    """The paper's network, one file for each training seed."""
    temporal_weights: tuple[Path, ...] = (TEMPORAL_WEIGHTS,)
    """The network with a memory, one file for each training seed."""

    def run(self, command: str) -> None:
        """Measure, write and print the table."""
        number("worlds", self.worlds, 1, 10_000)
        rows = [(FRAME, path) for path in self.weights]
        rows += [(TEMPORAL, path) for path in self.temporal_weights]
        paths = tuple(path for _, path in rows)
        detectors = detectors_of(rows)
        config = DrivingConfig(scene=SceneConfig(duration_s=self.duration))
        worlds = SimulatedWorlds("test", tuple(SPLITS["test"][: self.worlds]), config)
        job = self.making.job("table-weather", {"test": worlds}, paths, {})
        scored = measure(job, WeatherTask(config, LoadScorers(paths)), ScoredWorld.load)["test"]
        sequences = [sequence for world in scored for sequence in world.in_weathers()]
        figures = summarise_keyframes({"test": sequences}, detectors, self.making.seed)
        targets = weather_targets(figures, list(figures.splits["test"].rows))
        sections = [weather_section(figures), *target_section(targets)]
        told = f"Each in the {len(WEATHERS)} weathers, with the same traffic and the same labels."
        print(job.publish(sections, figures, command, f"{told} {noted(detectors)}"))


def detectors_of(rows: Sequence[tuple[str, Path]]) -> list[DetectorFile]:
    """The networks of a table (row and file) at their default thresholds, and at ``even`` where known."""
    if not rows:
        raise ValueError("weights: found no detector, expected at least one file")
    known = [load_detector(path).thresholds for _, path in rows]
    numbered = list(enumerate(zip((row for row, _ in rows), known, strict=True)))
    default = [DetectorFile(row, found.get("default", 0.5), line) for line, (row, found) in numbered]
    even = [
        DetectorFile(f"{row}, even", found["even"], line)
        for line, (row, found) in numbered
        if "even" in found
    ]
    return default + even


def noted(detectors: Sequence[DetectorFile]) -> str:
    """What a table says of the thresholds."""
    thresholds = ", ".join(f"{detector.row} {detector.threshold:.3f}" for detector in detectors)
    return (
        f"Thresholds are the weights' own, from validation sequences: {thresholds}; "
        "`even` finds as large a share of the keyframes as it leaves alone of the other slices."
    )
