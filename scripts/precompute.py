"""Run a depth extrapolator once over recordings and store what every trigger policy needs from it.

A stored sequence holds the observations, the labels and the error of every depth frame that could be held,
so that nl_env/Replay-v0 with errors="table" gives the rewards of the full computation without a network.
Every finished sequence is kept, so an interrupted run continues with --resume.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # runs from a checkout, wherever it is started

import tyro
from tqdm import tqdm

from nl_env.command_line import run_command
from nl_env.config import LidarConfig, number
from nl_env.depth.extrapolators import make_extrapolator
from nl_env.recording_stream import RecordingStream
from nl_env.runs import open_folder, run_sequences
from nl_env.trace_files import SUFFIX, VERSION, default_folder, open_trace, verify_trace, write_trace
from nl_env.trace_source import ExtrapolatorIdentity, TraceSource, file_digest, identify_extrapolator
from nl_env.traces import trace_sequence


@dataclass(frozen=True)
class Options:
    """Run a depth extrapolator once over recordings."""

    data: Path
    """Recordings: a folder that scripts/record.py wrote, or one recording."""
    extrapolator: str = "unet"
    """unet (ours), unet-paper, repeat, linear, exponential, warp, or a path to weights."""
    odometry: bool = False
    """Give the extrapolator the true ego motion."""
    runtime: str = "auto"
    """What runs a network: auto, torch, openvino, onnxruntime or cuda."""
    lidar_hz: int | None = None
    """Another LiDAR rate than the recorded one: 1, 2, 5, 10 or 25."""
    beams: int | None = None
    """Another number of scan lines than the recorded one: 16, 32, 64, 128, or 0 for a dense LiDAR."""
    sequences: int | None = None
    """Only the first so many."""
    workers: int = os.cpu_count() or 1
    """Processes of one thread each; 0 runs in this one."""
    out: Path | None = None
    """Output folder. Default: DATA-tables-EXTRAPOLATOR, where nl_env/Replay-v0 looks for it."""
    overwrite: bool = False
    """Replace the tables that are in the output folder."""
    resume: bool = False
    """Continue the run that is in the output folder; what is damaged or out of date is made again."""


@dataclass(frozen=True)
class FinishedFile:
    """A trace that a worker wrote under a name of its own, to be moved to its place."""

    path: Path

    def save(self, path: Path) -> None:
        """Move the file onto ``path``."""
        self.path.replace(path)


@dataclass(frozen=True)
class PrecomputeSequence:
    """The work of one process: the trace of one recording, written into ``folder``."""

    files: dict[int, Path]
    lidar: LidarConfig
    extrapolator: str
    runtime: str
    identity: ExtrapolatorIdentity
    folder: Path

    def source(self, seed: int) -> TraceSource:
        """What the trace of ``seed`` is computed from; reads the whole recording."""
        return TraceSource.of(file_digest(self.files[seed]), self.identity, self.lidar)

    def __call__(self, seed: int) -> FinishedFile:
        """Run sensors and extrapolator over recording ``seed``."""
        source = self.source(seed)
        stream = RecordingStream([self.files[seed]], self.lidar)
        extrapolator = make_extrapolator(
            self.extrapolator, odometry=self.identity.odometry, runtime=self.runtime
        )
        trace = trace_sequence(stream, extrapolator, seed, min_depth=source.min_depth)
        stream.close()
        path = self.folder / f".{seed}{SUFFIX}"  # hidden: an interrupted run leaves nothing that looks whole
        write_trace(path, trace, source)
        return FinishedFile(path)


def drop_unusable(task: PrecomputeSequence, seeds: Sequence[int]) -> int:
    """Delete finished tables that are damaged or whose recording changed; returns how many."""
    dropped = 0
    for seed in seeds:
        path = task.folder / f"{seed}{SUFFIX}"
        if path.exists():
            try:
                verify_trace(path, task.source(seed))
            except ValueError as error:
                print(f"precompute: makes again {error}", file=sys.stderr)
                path.unlink()
                dropped += 1
    return dropped


def run(options: Options) -> Path:
    """Compute what is missing and return the folder."""
    number("workers", options.workers, 0, 1_000)
    stream = RecordingStream(options.data)
    recorded, files = stream.config.lidar, stream.files
    lidar = replace(
        recorded,
        rate_hz=recorded.rate_hz if options.lidar_hz is None else options.lidar_hz,
        beams=recorded.beams if options.beams is None else options.beams,
    )
    if options.sequences is not None:
        number("sequences", options.sequences, 1, len(files))
    seeds = list(files)[: options.sequences]
    make_extrapolator(options.extrapolator, options.odometry, options.runtime)  # fails before the work
    identity = identify_extrapolator(options.extrapolator, options.odometry)
    folder = options.out or default_folder(options.data, options.extrapolator, options.odometry)
    settings = {
        "version": VERSION,
        **asdict(identity),
        "lidar_hz": lidar.rate_hz,
        "beams": lidar.beams,
        "runtime": options.runtime,
    }
    checkpoints = open_folder(folder, settings, overwrite=options.overwrite, resume=options.resume)
    task = PrecomputeSequence(
        files, lidar, options.extrapolator, options.runtime, identity, checkpoints.resolve()
    )
    drop_unusable(task, seeds)
    with tqdm(total=len(seeds), desc="sequences", unit="sequence", disable=None) as bar:
        traces = run_sequences(
            task,
            open_trace,
            seeds,
            checkpoints,
            workers=options.workers,
            suffix=SUFFIX,
            progress=bar.update,
        )
    slices = sum(trace.slices for trace in traces)
    print(f"{len(traces)} sequences, {slices} slices: {folder}")
    return folder


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""

    def work(given: list[str]) -> None:
        run(tyro.cli(Options, args=given, description=__doc__))

    return run_command("precompute", work, arguments, kept="finished sequences are kept")


if __name__ == "__main__":
    sys.exit(main())
