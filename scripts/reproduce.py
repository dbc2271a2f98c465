"""Measure the paper's tables again, on recorded sequences or on ELiDAR, ours beside the published figures.

Every finished sequence is kept in the output folder, so an interrupted run continues with --resume.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # agents/ is used from the checkout, wherever the command is started

import numpy as np
import tyro
from numpy.typing import NDArray
from tqdm import tqdm

from agents.keyframe_cnn import FRAME_WEIGHTS, TEMPORAL_WEIGHTS, load_detector
from agents.oracle import priced_schedule
from agents.table_policies import FRAME, TEMPORAL, LoadScorers, PlayPolicies
from nl_env.command_line import command_line, run_command
from nl_env.config import number
from nl_env.depth.extrapolators import WEIGHTS
from nl_env.depth.metrics import METRIC_NAMES
from nl_env.elidar import elidar_in
from nl_env.elidar.layout import RANGE
from nl_env.reproduction.data import Sequences, find_sequences
from nl_env.reproduction.elidar import WEATHER_GROUPS as ELIDAR_WEATHERS
from nl_env.reproduction.elidar import ElidarGapsTask, ElidarScoreTask, Release
from nl_env.reproduction.elidar_end_to_end import (
    ElidarEndToEndTask,
    ElidarRun,
    end_to_end_names,
    records_of,
)
from nl_env.reproduction.end_to_end import EndToEndTask, SequenceRun
from nl_env.reproduction.end_to_end_tables import end_to_end_sections, summarise_records
from nl_env.reproduction.figures import Figures, summarise
from nl_env.reproduction.gap_tables import REPEAT, ablation_sections, rate_sections
from nl_env.reproduction.gaps import GROUPS, MEAN, GapsTask, Method, SequenceErrors, with_mean
from nl_env.reproduction.job import Job, Output, shown
from nl_env.reproduction.keyframe_tables import (
    WEATHER_GROUPS,
    DetectorFile,
    keyframe_sections,
    summarise_keyframes,
)
from nl_env.reproduction.keyframes import ScoredSequence, ScoreTask
from nl_env.reproduction.schedules import play_all
from nl_env.reproduction.targets import (
    ablation_targets,
    end_to_end_targets,
    keyframe_targets,
    rate_targets,
    target_section,
)
from nl_env.reproduction.variants import OURS, PAPER, read_variant
from nl_env.types import SLICE_US

OUR_WEIGHTS = WEIGHTS / "unet.safetensors"


@dataclass(frozen=True)
class Common:
    """What every table takes."""

    data: Path = Path("runs/data/test")
    """Recordings of the test split, as scripts/record.py writes them (the gaps need --depth-period-ms 10), or
    a folder with ELiDAR's files."""
    fov: float = 75.0
    """ELiDAR only: horizontal field of view, degrees, which its files do not say."""
    max_depth: float = RANGE
    """ELiDAR only: range, m; 9 indoors."""
    sequences: int | None = None
    """Measure on the first ones only; all of them by default."""
    on_error: str = "raise"
    """raise, or skip: damaged sequences are left out, with a warning for each; the results name them."""
    seed: int = 0
    """Draws the bootstrap."""
    workers: int = os.cpu_count() or 1
    """Processes of one thread each; 0 runs in this one. The results do not depend on it."""
    out: Path | None = None
    """Output folder: results.json, table.md and the finished sequences; runs/TABLE by default."""
    markdown: Path | None = None
    """Also put the tables between this table's marks in a document, such as docs/results.md."""
    overwrite: bool = False
    """Replace the run that is in the output folder."""
    resume: bool = False
    """Continue the run that is in the output folder; data, weights and settings must be the same."""

    def release(self, folder: Path | None = None) -> Release | None:
        """ELiDAR, where ``folder`` (default: the data) holds it."""
        number("fov", self.fov, 20.0, 120.0)
        files = elidar_in(folder or self.data)
        return None if files is None else Release(files, self.fov, self.max_depth, self.on_error)

    def test(self) -> Sequences:
        """The test recordings; those of another split raise ``ValueError``."""
        found = find_sequences(self.data, self.sequences)
        if found.split != "test":
            raise ValueError(f"data: found {found.split} sequences in {self.data}, expected the test split")
        return found

    def job(
        self, table: str, data: dict[str, Sequences], weights: Iterable[Path], settings: dict[str, Any]
    ) -> Job:
        """Start a table; arguments as :class:`nl_env.reproduction.job.Job`."""
        folder = self.out or Path("runs") / table
        output = Output(folder, self.markdown, self.workers, self.overwrite, self.resume, self.on_error)
        return Job(table, output, data, weights, settings)


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
        if not rows:
            raise ValueError("weights: found no detector, expected at least one file")
        paths = tuple(path for _, path in rows)
        known = [load_detector(path).thresholds for path in paths]
        detectors = [
            DetectorFile(row, thresholds.get("default", 0.5), number)
            for number, ((row, _), thresholds) in enumerate(zip(rows, known, strict=True))
        ]
        detectors += [
            DetectorFile(f"{row}, even", thresholds["even"], number)
            for number, ((row, _), thresholds) in enumerate(zip(rows, known, strict=True))
            if "even" in thresholds
        ]
        job = self.common.job("table-keyframe", data, paths, {})
        files = {seed: file for found in data.values() for seed, file in found.files.items()}
        task = (ScoreTask if release is None else ElidarScoreTask)(files, LoadScorers(paths))
        scored = measure(job, task, ScoredSequence.load)
        groups = WEATHER_GROUPS if release is None else ELIDAR_WEATHERS
        figures = summarise_keyframes(scored, detectors, self.common.seed, groups)
        thresholds = ", ".join(f"{d.row} {d.threshold:.3f}" for d in detectors)
        notes = (
            f"All slices count. Thresholds are the weights' own, from validation sequences: {thresholds}; "
            "`even` finds as large a share of the keyframes as it leaves alone of the other slices."
        )
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
class TableRates:
    """Depth error at gaps of 20, 50, 100, 200 and 500 ms (50, 20, 10, 5 and 2 Hz) and at varying ones."""

    common: Annotated[Common, tyro.conf.OmitArgPrefixes]
    weights: tuple[Path, ...] = (OUR_WEIGHTS,)
    """Our network, one file for each training seed."""
    paper_weights: tuple[Path, ...] = ()
    """The paper's network, one file for each training seed."""
    pairs: int = 10
    """LiDAR frames per sequence, at random times, each with every gap; of ELiDAR, at most so many stored
    pairs of each gap (the release has up to 93)."""

    def run(self, command: str) -> None:
        """Measure, write and print the table."""
        methods = [
            *baselines(),
            *(Method(PAPER, str(path)) for path in self.paper_weights),
            *(Method(OURS, str(path)) for path in self.weights),
            *(Method(f"{OURS} (true motion)", str(path), odometry=True) for path in self.weights),
        ]
        job, figures = measure_gaps("table-rates", self.common, methods, self.pairs)
        sections = rate_sections(figures, [row for row in (PAPER, OURS) if row in figures])
        sections += target_section(rate_targets(figures, OURS, job.resolution))
        print(job.publish(sections, figures, command, gap_notes(self.pairs, self.common.release())))


@dataclass(frozen=True)
class TableAblation:
    """Depth error of trained variants: the paper's ablations, the steps of ours, and changed events."""

    common: Annotated[Common, tyro.conf.OmitArgPrefixes]
    variants: tuple[Path, ...] = (OUR_WEIGHTS,)
    """Weights of the variants; their cards name the rows. Files of one variant are its training seeds."""
    weights: tuple[Path, ...] = (OUR_WEIGHTS,)
    """Our network, which is also run with the true motion, without events and with shuffled events."""
    pairs: int = 10
    """LiDAR frames per sequence, at random times, each with every gap; of ELiDAR, at most so many stored
    pairs of each gap (the release has up to 93)."""

    def run(self, command: str) -> None:
        """Measure, write and print the table."""
        variants = {path: read_variant(path) for path in self.variants}
        methods = [*baselines(), *(Method(v.row, str(path), v.odometry) for path, v in variants.items())]
        for row, odometry, control in (
            ("run with the true motion", True, ""),
            ("run without events", False, "no events"),
            ("run with events shuffled in time", False, "shuffled events"),
        ):
            methods += [Method(f"{OURS}, {row}", str(path), odometry, control) for path in self.weights]
        job, figures = measure_gaps("table-ablation", self.common, methods, self.pairs)
        sections = ablation_sections(figures, {v.row: v.published for v in variants.values() if v.published})
        without = (f"{OURS}: without events", *(row for row in figures if "shuffled" in row))
        sections += target_section(ablation_targets(figures, OURS, without))
        print(job.publish(sections, figures, command, gap_notes(self.pairs, self.common.release())))


@dataclass(frozen=True)
class TableEndToEnd:
    """Policies and extrapolators together: error of the held depth, error of the frames made, rate."""

    common: Annotated[Common, tyro.conf.OmitArgPrefixes]
    weights: Path | None = OUR_WEIGHTS
    """Our network; None leaves it out."""
    paper_weights: Path | None = None
    """The paper's network; None leaves it out."""
    keyframe_weights: Path = FRAME_WEIGHTS
    """The paper's keyframe detector."""
    temporal_weights: Path = TEMPORAL_WEIGHTS
    """The keyframe detector with a memory."""
    duration: float | None = None
    """Recordings only: cut sequences to this length, s."""
    pairs: int = 10
    """ELiDAR only: at most so many stored pairs of 20 and of 50 ms."""
    reference: str = FRAME
    """The policy that matched rates are matched to: keyframe-cnn or keyframe-cnn-temporal."""

    def run(self, command: str) -> None:
        """Measure, write and print the table."""
        release = self.common.release()
        if self.duration is not None:
            number("duration", self.duration, 0.2, 120.0)
        number("pairs", self.pairs, 1, 1_000)
        policies = PlayPolicies(self.keyframe_weights, self.temporal_weights)
        if self.reference not in policies.detectors:
            raise ValueError(
                f"reference: found {self.reference!r}, expected one of {', '.join(policies.detectors)}"
            )
        networks = {PAPER: self.paper_weights, OURS: self.weights}
        named = {row: path for row, path in networks.items() if path is not None}
        methods = (
            *(Method(name, name) for name in ("repeat", "linear", "exponential", "warp")),
            *(Method(row, str(path)) for row, path in named.items()),
        )
        for method in methods:
            method.make()  # wrong weights fail before the work
        weights = (*named.values(), *policies.detectors.values())
        if release is not None:
            print(self._on_elidar(release, policies, methods, weights, command))
            return
        data = self.common.test()
        settings = {"duration": self.duration, "reference": self.reference}
        job = self.common.job("table-end-to-end", {"test": data}, weights, settings)
        slices = None if self.duration is None else round(self.duration * 1e6) // SLICE_US
        runs = measure(job, EndToEndTask(data.files, methods, policies, slices), SequenceRun.load)["test"]
        records = play_all(runs, self.reference, priced_schedule)
        figures = summarise_records(records, self.common.seed)
        cut = "" if self.duration is None else f"The first {self.duration:g} s of each. "
        notes = (
            f"{cut}Changes of held depth are against the LiDAR alone (`never`), changes of "
            "the frames made against `repeat` at the same triggers. \\* reads labels or true depth."
        )
        ours = methods[-1].row
        sections = end_to_end_sections(figures, self.reference, ours)
        if ours == OURS:
            targets = end_to_end_targets(figures, policies.detectors, ours, job.resolution)
            sections += target_section(targets)
        print(job.publish(sections, figures, command, notes))

    def _on_elidar(
        self,
        release: Release,
        policies: PlayPolicies,
        methods: tuple[Method, ...],
        weights: tuple[Path, ...],
        command: str,
    ) -> str:
        """Measure and write the table; its text."""
        data, names = release.test_pairs(self.common.sequences, end_to_end_names(release))
        settings = {"pairs": self.pairs, "reference": self.reference}
        job = self.common.job("table-end-to-end", {"test": data}, weights, settings)
        raw = {name: release.files.raw[name] for name in names}
        pairs = release.pairs(names)
        task = ElidarEndToEndTask(pairs, names, raw, methods, policies.on_elidar, self.pairs, self.common.fov)
        records = records_of(measure(job, task, ElidarRun.load)["test"])
        figures = summarise_records(records, self.common.seed)
        notes = (
            "Rates are of the raw sequences, with a LiDAR frame at every fifth slice. Errors are of stored "
            "pairs of 20 and 50 ms: extrapolated where the policy triggers at the last slice before the "
            "truth, else the LiDAR frame held. Changes are against `never` for held depth and against "
            "`repeat` for frames made. \\* reads labels."
        )
        return job.publish(
            end_to_end_sections(figures, self.reference, methods[-1].row), figures, command, notes
        )


def measure(job: Job, task: Any, load: Any) -> dict[str, list[Any]]:
    """Measure what is not finished, with a progress bar on a terminal."""
    with tqdm(total=len(job.seeds), desc=job.table, unit="sequence", disable=None) as bar:
        return job.measure(task, load, bar.update)


def baselines() -> list[Method]:
    """Extrapolators without learning."""
    named = [Method(name, name) for name in (REPEAT, "linear", "exponential", "warp")]
    return [*named, Method("warp (true motion)", "warp", odometry=True)]


def measure_gaps(table: str, common: Common, methods: Sequence[Method], pairs: int) -> tuple[Job, Figures]:
    """Errors of ``methods`` at every gap; of ELiDAR without those that need the true motion."""
    number("pairs", pairs, 1, 1_000)
    release = common.release()
    if release is not None:
        methods = [method for method in methods if not method.odometry]
    for method in methods:
        method.make()  # wrong weights fail before the work
    task: GapsTask | ElidarGapsTask
    if release is None:
        data = common.test()
        task = GapsTask(data.files, tuple(methods), pairs)
    else:
        data, names = release.test_pairs(common.sequences)
        task = ElidarGapsTask(release.pairs(names), names, tuple(methods), pairs, common.fov)
    weights = sorted({Path(m.extrapolator) for m in methods if Path(m.extrapolator).is_file()})
    rows = [[m.row, shown(Path(m.extrapolator)), m.odometry, m.control] for m in methods]
    job = common.job(table, {"test": data}, weights, {"pairs": pairs, "methods": rows})
    results = measure(job, task, SequenceErrors.load)["test"]
    errors: NDArray[np.float64] = with_mean(np.array([result.errors for result in results]))
    rng = np.random.default_rng(common.seed)
    return job, summarise(errors, [m.row for m in methods], (*GROUPS, MEAN), METRIC_NAMES, REPEAT, rng)


def gap_notes(pairs: int, release: Release | None) -> str:
    """What the numbers of the gap tables are."""
    told = (
        f"{pairs} LiDAR frames of each, at random times, with every gap."
        if release is None
        else f"At most {pairs} stored pairs of every gap of each; `adaptive` is the mean over all of them. "
        "The LiDAR frame before a prior is the depth frame nearest to 100 ms before it. No poses: rows with "
        "the true motion are left out."
    )
    return (
        f"{told} In brackets the change against Repeat; ± one standard error over sequences; "
        "intervals are bootstraps over sequences."
    )


Table = TableKeyframe | TableRates | TableAblation | TableEndToEnd


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""

    def work(given: list[str]) -> None:
        tyro.cli(Table, args=given, description=__doc__).run(command_line("reproduce", given))

    return run_command("reproduce", work, arguments, kept="finished sequences are kept")


if __name__ == "__main__":
    sys.exit(main())
