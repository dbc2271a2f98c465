"""Measure the paper's tables again on recorded sequences, ours beside the published figures.

Every finished sequence is kept in the output folder, so an interrupted run continues with --resume.
"""

from __future__ import annotations

import os
import shlex
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

from agents.base import Policy
from agents.keyframe_cnn import FRAME_WEIGHTS, TEMPORAL_WEIGHTS, KeyframeCNN
from agents.oracle import priced_schedule
from agents.rules import Always, KeyframeRule, Never, Periodic
from nl_env.config import number
from nl_env.depth.extrapolators import WEIGHTS
from nl_env.depth.metrics import METRIC_NAMES
from nl_env.evaluation import play
from nl_env.reproduction.data import Sequences, find_sequences
from nl_env.reproduction.end_to_end import EndToEndTask, Schedule, SequenceRun
from nl_env.reproduction.end_to_end_tables import end_to_end_sections, summarise_records
from nl_env.reproduction.figures import Figures, summarise
from nl_env.reproduction.gap_tables import REPEAT, ablation_sections, rate_sections
from nl_env.reproduction.gaps import GROUPS, MEAN, GapsTask, Method, SequenceErrors, with_mean
from nl_env.reproduction.job import Job, Output, shown
from nl_env.reproduction.keyframe_tables import DetectorFile, keyframe_sections, summarise_keyframes
from nl_env.reproduction.keyframes import ScoredSequence, Scorer, ScoreTask
from nl_env.reproduction.schedules import play_all
from nl_env.reproduction.targets import (
    ablation_targets,
    end_to_end_targets,
    keyframe_targets,
    rate_targets,
    target_section,
)
from nl_env.reproduction.variants import OURS, PAPER, read_variant
from nl_env.traces import SequenceTrace
from nl_env.types import SLICE_US

FRAME, TEMPORAL = "keyframe-cnn", "keyframe-cnn-temporal"
OUR_WEIGHTS, PAPER_WEIGHTS = (WEIGHTS / f"{name}.safetensors" for name in ("unet", "unet-paper"))


@dataclass(frozen=True)
class Common:
    """What every table takes."""

    data: Path = Path("runs/data/test")
    """Recordings of the test split, as scripts/record.py writes them (the gaps need --depth-period-ms 10)."""
    sequences: int | None = None
    """Measure on the first ones only; all of them by default."""
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
        output = Output(folder, self.markdown, self.workers, self.overwrite, self.resume)
        return Job(table, output, data, weights, settings)


@dataclass(frozen=True)
class TableKeyframe:
    """Keyframe detection: F1, precision, recall, balanced accuracy, AUROC; by cause and by weather."""

    common: Annotated[Common, tyro.conf.OmitArgPrefixes]
    train: Path | None = None
    """Recordings of the train split, for the paper's train row."""
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
        data = {"test": self.common.test()}
        if self.train is not None:
            data = {"train": find_sequences(self.train, self.train_sequences), **data}
        rows = [(FRAME, path) for path in self.weights]
        rows += [(TEMPORAL, path) for path in self.temporal_weights]
        rows += [(f"{FRAME}, the paper's recipe", path) for path in self.recipe_weights]
        if not rows:
            raise ValueError("weights: found no detector, expected at least one file")
        paths = tuple(path for _, path in rows)
        detectors = [DetectorFile(row, KeyframeCNN.load(path).threshold) for row, path in rows]
        job = self.common.job("table-keyframe", data, paths, {})
        files = {seed: file for found in data.values() for seed, file in found.files.items()}
        scored = measure(job, ScoreTask(files, LoadScorers(paths)), ScoredSequence.load)
        figures = summarise_keyframes(scored, detectors, self.common.seed)
        thresholds = ", ".join(f"{d.row} {d.threshold:.3f}" for d in detectors)
        notes = f"All slices count. Thresholds are the weights' own, from validation sequences: {thresholds}."
        sections = keyframe_sections(figures) + target_section(keyframe_targets(figures, FRAME, TEMPORAL))
        print(job.publish(sections, figures, command, notes))


@dataclass(frozen=True)
class LoadScorers:
    """Makes the scorers of :class:`ScoreTask` from weights."""

    weights: tuple[Path, ...]

    def __call__(self) -> list[Scorer]:
        """One per file."""
        return [KeyframeCNN.load(path).score_sequence for path in self.weights]


@dataclass(frozen=True)
class TableRates:
    """Depth error at gaps of 20, 50, 100, 200 and 500 ms (50, 20, 10, 5 and 2 Hz) and at varying ones."""

    common: Annotated[Common, tyro.conf.OmitArgPrefixes]
    weights: tuple[Path, ...] = (OUR_WEIGHTS,)
    """Our network, one file for each training seed."""
    paper_weights: tuple[Path, ...] = (PAPER_WEIGHTS,)
    """The paper's network, one file for each training seed."""
    pairs: int = 10
    """LiDAR frames per sequence, at random times, each with every gap."""

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
        print(job.publish(sections, figures, command, gap_notes(self.pairs)))


@dataclass(frozen=True)
class TableAblation:
    """Depth error of trained variants: the paper's ablations, the steps of ours, and changed events."""

    common: Annotated[Common, tyro.conf.OmitArgPrefixes]
    variants: tuple[Path, ...] = (PAPER_WEIGHTS, OUR_WEIGHTS)
    """Weights of the variants; their cards name the rows. Files of one variant are its training seeds."""
    weights: tuple[Path, ...] = (OUR_WEIGHTS,)
    """Our network, which is also run with the true motion, without events and with shuffled events."""
    pairs: int = 10
    """LiDAR frames per sequence, at random times, each with every gap."""

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
        print(job.publish(sections, figures, command, gap_notes(self.pairs)))


@dataclass(frozen=True)
class TableEndToEnd:
    """Policies and extrapolators together: error of the held depth, error of the frames made, rate."""

    common: Annotated[Common, tyro.conf.OmitArgPrefixes]
    weights: Path | None = OUR_WEIGHTS
    """Our network; None leaves it out."""
    paper_weights: Path | None = PAPER_WEIGHTS
    """The paper's network; None leaves it out."""
    keyframe_weights: Path = FRAME_WEIGHTS
    """The paper's keyframe detector."""
    temporal_weights: Path = TEMPORAL_WEIGHTS
    """The keyframe detector with a memory."""
    duration: float | None = None
    """Cut sequences to this length, s."""
    reference: str = FRAME
    """The policy that matched rates are matched to: keyframe-cnn or keyframe-cnn-temporal."""

    def run(self, command: str) -> None:
        """Measure, write and print the table."""
        if self.duration is not None:
            number("duration", self.duration, 0.2, 120.0)
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
        data = self.common.test()
        settings = {"duration": self.duration, "reference": self.reference}
        weights = (*named.values(), *policies.detectors.values())
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
            targets = end_to_end_targets(figures, self.reference, ours, job.resolution)
            sections += target_section(targets)
        print(job.publish(sections, figures, command, notes))


@dataclass(frozen=True)
class PlayPolicies:
    """Plays the policies whose rate is their own on a sequence; the ``decide`` of :class:`EndToEndTask`."""

    keyframe_weights: Path
    temporal_weights: Path

    @property
    def detectors(self) -> dict[str, Path]:
        """Weights of the learned policies."""
        return {FRAME: self.keyframe_weights, TEMPORAL: self.temporal_weights}

    def __call__(self, trace: SequenceTrace) -> dict[str, Schedule]:
        """When each policy triggers."""
        policies: dict[str, Policy] = {
            "never": Never(),
            "periodic:2": Periodic(2),
            "always": Always(),
            "keyframe-rule*": KeyframeRule(),
            **{name: KeyframeCNN.load(path) for name, path in self.detectors.items()},
        }
        schedules = {}
        for name, policy in policies.items():
            schedules[name] = np.zeros(trace.slices + 1, bool)
            schedules[name][list(play(policy, trace, name).triggers)] = True
        return schedules


def measure(job: Job, task: Any, load: Any) -> dict[str, list[Any]]:
    """Measure what is not finished, with a progress bar on a terminal."""
    with tqdm(total=len(job.seeds), desc=job.table, unit="sequence", disable=None) as bar:
        return job.measure(task, load, bar.update)


def baselines() -> list[Method]:
    """Extrapolators without learning."""
    named = [Method(name, name) for name in (REPEAT, "linear", "exponential", "warp")]
    return [*named, Method("warp (true motion)", "warp", odometry=True)]


def measure_gaps(table: str, common: Common, methods: Sequence[Method], pairs: int) -> tuple[Job, Figures]:
    """Errors of ``methods`` at every gap."""
    number("pairs", pairs, 1, 1_000)
    for method in methods:
        method.make()  # wrong weights fail before the work
    data = common.test()
    weights = sorted({Path(m.extrapolator) for m in methods if Path(m.extrapolator).is_file()})
    rows = [[m.row, shown(Path(m.extrapolator)), m.odometry, m.control] for m in methods]
    job = common.job(table, {"test": data}, weights, {"pairs": pairs, "methods": rows})
    results = measure(job, GapsTask(data.files, tuple(methods), pairs), SequenceErrors.load)["test"]
    errors: NDArray[np.float64] = with_mean(np.array([result.errors for result in results]))
    rng = np.random.default_rng(common.seed)
    return job, summarise(errors, [m.row for m in methods], (*GROUPS, MEAN), METRIC_NAMES, REPEAT, rng)


def gap_notes(pairs: int) -> str:
    """What the numbers of the gap tables are."""
    return (
        f"{pairs} LiDAR frames of each, at random times, with every gap. In brackets the change against "
        "Repeat; ± one standard error over sequences; intervals are bootstraps over sequences."
    )


Table = TableKeyframe | TableRates | TableAblation | TableEndToEnd


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    again = [argument for argument in arguments if argument not in ("--overwrite", "--resume")]
    command = shlex.join(["python", "scripts/reproduce.py", *again])
    try:
        tyro.cli(Table, args=arguments, description=__doc__).run(command)
    except (ValueError, OSError) as error:
        print(f"reproduce: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(
            f"\ninterrupted; finished sequences are kept. Continue with: {command} --resume", file=sys.stderr
        )
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
