"""Draw the frontier: error against frame rate of every family of policies, on stored traces of test drives.

The traces come from scripts/precompute.py, so nothing is rendered or extrapolated. Learned policies can take
part with several trainings each: FAMILY@WEIGHTS for every one of them. Every finished sequence is kept in the
output folder, so an interrupted run continues with --resume.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # agents/ is used from the checkout, wherever the command is started

import numpy as np
import tyro
from tqdm import tqdm

import nl_env
from agents.catalogue import FAMILIES, WEIGHTS, make_policy, parse_policy
from agents.oracle import oracle_curve
from agents.schedules import Scheduler
from nl_env.command_line import command_line, run_command
from nl_env.comparison import SequenceResult, compare, evaluate_sequence
from nl_env.config import number
from nl_env.depth.extrapolators import make_extrapolator
from nl_env.evaluation import EnergyModel
from nl_env.frame_rates import KINDS, SPEED_BIN, rate_by_kind, rate_by_speed
from nl_env.plots import adaptive_policies
from nl_env.recording_stream import RecordingStream
from nl_env.report import write_report
from nl_env.reproduction.document import Section, check_document, machine, markdown, update_document
from nl_env.runs import open_folder, run_sequences
from nl_env.tables import FRONTIER_NOTES, frontier_rows, matched_rows
from nl_env.trace_files import open_trace, open_traces, read_source, trace_files
from nl_env.trace_source import file_digest
from nl_env.traces import trace_sequence
from scripts.compare import available, policy_infos

BLOCK = "frontier"
"""Name of the block of the document that holds the results."""


ROWS = (
    "keyframe-cnn",
    "keyframe-cnn-temporal",
    "periodic:2",
    "evenly:27.8",
    "evenly:40.6",
    "schedule:0100",
    "schedule:0101",
    "random",
    "event-rate:0.17",
    "event-rate-hysteresis",
    "accumulated:0.5",
    "accumulated-weighted",
    "speed-age",
    "value-reduction",
    "value-advantage:0.3",
    "value-clone:0.3",
    "value-planned:0.3",
    "rl",
    "keyframe-rule",
    "greedy",
    "oracle:27.8",
    "oracle:40.6",
)
"""Rows of the tables by default."""


@dataclass(frozen=True)
class Settings:
    """What determines the results."""

    data: Path = Path("runs/data/test-tables-unet")
    """Stored traces of the test split: a folder that scripts/precompute.py wrote."""
    sequences: int | None = None
    """Only the first so many."""
    policies: tuple[str, ...] = field(default_factory=lambda: available(ROWS))
    """Families by name, FAMILY:NUMBER or FAMILY@WEIGHTS:NUMBER; the number makes a row of the tables, and all
    numbers of the family's sweep make its curve. Several FAMILY@WEIGHTS are trainings of one family. By
    default everything that is shipped."""
    every: int = 1
    """Only every so many-th number of the sweeps of adaptive families."""
    seed: int = 0
    """Of the bootstrap."""


@dataclass(frozen=True)
class Options:
    """Draw the frontier on stored traces of test sequences."""

    settings: Annotated[Settings, tyro.conf.OmitArgPrefixes]
    player: Path | None = None
    """Recordings of the same sequences: the first is extrapolated once more (half a minute), so that the page
    can play it."""
    workers: int = os.cpu_count() or 1
    """Processes of one thread each; 0 runs in this one. The results do not depend on it."""
    out: Path = Path("runs/frontier")
    """Output folder: results.json, table.md, figures, report.html, and the finished sequences."""
    document: Path | None = None
    """Markdown document whose block "frontier" is replaced by the results."""
    overwrite: bool = False
    """Replace the run that is in the output folder."""
    resume: bool = False
    """Continue the run that is in the output folder; the settings must be the same."""


@dataclass(frozen=True)
class FrontierSequence:
    """The work of one process: one stored sequence with every policy."""

    settings: Settings
    player: Path | None

    def __call__(self, seed: int) -> SequenceResult:
        """Play every policy on the stored trace."""
        files = trace_files(self.settings.data)
        trace = open_trace(files[seed])
        if self.player is not None and seed == next(iter(files)):
            trace = replace(trace, frames=self._frames(files[seed], seed, trace.errors))
        scheduler = Scheduler(trace)
        names = [info.name for info in policy_infos(self.settings.policies, every=self.settings.every)]
        policies = {name: scheduler.scripted(make_policy(name, seed)) for name in names}
        return evaluate_sequence(trace, policies, least_errors, EnergyModel())

    def _frames(self, path: Path, seed: int, errors: Any) -> Any:
        """Small frames of a sequence; its extrapolator must be the stored trace's."""
        assert self.player is not None
        source = read_source(path)
        name = "unet" if source.extrapolator == "network" else source.extrapolator
        extrapolator = make_extrapolator(name, odometry=source.odometry)
        again = trace_sequence(RecordingStream(self.player), extrapolator, seed, keep_frames=True)
        if any(not np.allclose(again.errors[metric], errors[metric], equal_nan=True) for metric in errors):
            raise ValueError(f"player: found other errors in {self.player} than stored in {path}")
        return again.frames


def least_errors(errors: Any, period: int) -> Any:
    """The optimal oracle's least total error for 0..N triggers."""
    return oracle_curve(errors, period)[1]


def run(options: Options, command: str) -> dict[str, Any]:
    """Evaluate, write the report and the document; returns the content of ``results.json``."""
    settings = options.settings
    if settings.sequences is not None:
        number("sequences", settings.sequences, 1, 10**6)
    number("every", settings.every, 1, 100)
    infos = policy_infos(settings.policies, every=settings.every)  # a wrong name fails before the work
    if options.document is not None:
        check_document(options.document, BLOCK)
    seeds = list(trace_files(settings.data))[: settings.sequences]
    open_traces(settings.data, seeds)  # all of one kind
    checkpoints = open_folder(
        options.out, identity(options), overwrite=options.overwrite, resume=options.resume
    )
    with tqdm(total=len(seeds), desc="sequences", unit="sequence", disable=None) as bar:
        results = run_sequences(
            FrontierSequence(settings, options.player),
            SequenceResult.load,
            seeds,
            checkpoints,
            workers=options.workers,
            progress=bar.update,
        )
    shown = {**asdict(settings), "data": settings.data.name}
    comparison = compare(shown, infos, results, np.random.default_rng(settings.seed))
    written = write_report(comparison, options.out)
    sections = document_sections(comparison)
    if options.document is not None:
        about = f"{len(seeds)} test sequences of {results[0].slices * 0.02:g} s. Machine: {machine()}."
        text = f"```\n{command}\n```\n\n{about}\n\n{markdown(sections)}\n\n{FRONTIER_NOTES}"
        update_document(options.document, BLOCK, text)
    print(markdown(sections[:2]))
    print(f"page: {(options.out / 'report.html').resolve().as_uri()}")
    return written


def identity(options: Options) -> dict[str, Any]:
    """What no resumed run may change: the settings, the traces and the weights."""
    settings = options.settings
    names = [parse_policy(name) for name in settings.policies]
    weights = {
        str(path): file_digest(path)
        for path in (
            Path(name.weights) if name.weights else WEIGHTS / FAMILIES[name.family].weights
            for name in names
            if FAMILIES[name.family].load is not None
        )
    }
    first = next(iter(trace_files(settings.data).values()))
    return {
        "version": nl_env.__version__,
        **asdict(settings),
        "data": str(settings.data),
        "policies": list(settings.policies),
        "traces": {**asdict(read_source(first)), "recording": ""},
        "weights": weights,
        "player": None if options.player is None else str(options.player),
    }


def document_sections(comparison: Any) -> list[Section]:
    """Curves, differences, and how the frame rate follows the scene."""
    assert comparison.frontier is not None
    sections = [
        Section("Regret, and error at matched rates", frontier_rows(comparison.frontier)),
        Section("Differences at matched rates, 1e-5", matched_rows(comparison.frontier)),
    ]
    chosen = adaptive_policies(comparison)
    curves = {i: rate_by_speed(comparison.sequences, i) for i in chosen}
    speeds = next(iter(curves.values())).speed
    bins = [f"{speed - SPEED_BIN / 2:g}-{speed + SPEED_BIN / 2:g} m/s" for speed in speeds]
    header = ["mean rate, Hz", *bins]
    rows = [[comparison.policies[i].name, *(f"{rate:.1f}" for rate in curves[i].rate)] for i in chosen]
    sections.append(Section("Frame rate by ego speed", [header, *rows]))
    for entry in KINDS:
        kinds = {i: rate_by_kind(comparison.sequences, i, entry) for i in chosen}
        first = next(iter(kinds.values()))
        if not first.kind:
            continue
        header = [
            "mean rate, Hz (lowest-highest)",
            *(f"{kind} ({count})" for kind, count in zip(first.kind, first.sequences, strict=True)),
        ]
        rows = [
            [
                comparison.policies[i].name,
                *(
                    f"{rate:.1f} ({low:.0f}-{high:.0f})"
                    for rate, low, high in zip(found.rate, found.low, found.high, strict=True)
                ),
            ]
            for i, found in kinds.items()
        ]
        sections.append(Section(f"Frame rate by {entry}", [header, *rows]))
    return sections


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""

    def work(given: list[str]) -> None:
        run(tyro.cli(Options, args=given, description=__doc__), command_line("frontier", given))

    return run_command("frontier", work, arguments, kept="finished sequences are kept")


if __name__ == "__main__":
    sys.exit(main())
