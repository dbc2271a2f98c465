"""Compare trigger policies on test sequences: a table, error-against-rate curves, and a page to look at.

Every finished sequence is kept in the output folder, so an interrupted run continues with --resume.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # agents/ is used from the checkout, wherever the command is started

import numpy as np
import tyro
from tqdm import tqdm

import nl_env
from agents.catalogue import FAMILIES, PolicyName, make_policy, parse_policy
from agents.oracle import oracle_curve
from agents.schedules import Scheduler
from nl_env.command_line import run_command
from nl_env.comparison import PolicyInfo, SequenceResult, compare, evaluate_sequence
from nl_env.config import (
    SPLITS,
    DrivingConfig,
    EventCameraConfig,
    LidarConfig,
    SceneConfig,
    number,
)
from nl_env.depth.extrapolators import make_extrapolator
from nl_env.evaluation import EnergyModel
from nl_env.report import write_report
from nl_env.runs import open_folder, run_sequences
from nl_env.streams import SyntheticStream
from nl_env.tables import text_report
from nl_env.traces import trace_sequence

SEQUENCES_PER_SEED = 1_000
"""Runs of different --seed share no sequence."""

SWEEP_STEP = 2
"""Every second number of an adaptive family's sweep is enough for a curve of few sequences."""

ENDPOINTS = ("never", "always")
"""Always compared: the ends of every curve; "always" is also the all-positive keyframe detector."""


ROWS = (
    "keyframe-cnn",
    "keyframe-cnn-temporal",
    "evenly:40",
    "periodic:2",
    "schedule:0100",
    "event-rate:0.125",
    "accumulated:0.5",
    "accumulated-weighted",
    "speed-age",
    "value-reduction",
    "value-clone:0.3",
    "rl",
    "keyframe-rule",
    "greedy",
    "oracle:20",
    "oracle:30",
    "oracle:40",
)
"""The table's policies by default."""


def available(names: Sequence[str]) -> tuple[str, ...]:
    """Those of ``names`` that can be made: the weights of learned policies may not be there."""
    return tuple(name for name in names if FAMILIES[parse_policy(name).family].available)


@dataclass(frozen=True)
class Settings:
    """What determines the results."""

    sequences: int = 8
    """Number of test sequences."""
    duration: float = 10.0
    """Length of each, seconds."""
    seed: int = 0
    """Which test sequences; another seed gives others. Also seeds the bootstrap."""
    resolution: str = "quarter"
    """full (480x640), half (240x320) or quarter (120x160)."""
    lidar_hz: int = 10
    """LiDAR frames per second: 1, 2, 5, 10 or 25."""
    noise: str = "realistic"
    """Event camera: realistic or ideal."""
    extrapolator: str = "unet"
    """unet (ours), unet-paper, repeat, linear, exponential, warp, or a path to weights."""
    odometry: bool = False
    """Give the extrapolator the true ego motion."""
    policies: tuple[str, ...] = field(default_factory=lambda: available(ROWS))
    """Rows of the table beside never and always: FAMILY, FAMILY:NUMBER or FAMILY@WEIGHTS:NUMBER. Families
    and their numbers: docs/policies.md. By default learned policies take part if they are shipped."""
    sweep: bool = True
    """Also vary each family's number, which draws the curves."""

    def validate(self) -> None:
        """Raise ``ValueError`` naming the option, what was found and what was expected."""
        number("sequences", self.sequences, 1, SEQUENCES_PER_SEED)
        number("seed", self.seed, 0, len(SPLITS["test"]) // SEQUENCES_PER_SEED - 1)
        self.config  # noqa: B018 - validates the rest
        for name in self.policies:
            make_policy(name, seed=0)

    @property
    def config(self) -> DrivingConfig:
        """The synthetic stream's configuration."""
        return DrivingConfig(
            resolution=self.resolution,
            scene=SceneConfig(duration_s=self.duration),
            events=EventCameraConfig.preset(self.noise),
            lidar=LidarConfig(rate_hz=self.lidar_hz),
        )

    @property
    def infos(self) -> list[PolicyInfo]:
        """Everything that plays."""
        return policy_infos(self.policies, self.sweep, SWEEP_STEP)

    @property
    def sequence_seeds(self) -> range:
        """Seeds of the test sequences; the page plays the first."""
        first = self.seed * SEQUENCES_PER_SEED
        return SPLITS["test"][first : first + self.sequences]


@dataclass(frozen=True)
class Options:
    """Compare trigger policies on test sequences."""

    settings: Annotated[Settings, tyro.conf.OmitArgPrefixes]
    workers: int = os.cpu_count() or 1
    """Processes of one thread each; 0 runs in this one. The results do not depend on it."""
    out: Path = Path("runs/compare")
    """Output folder: results.json, table.md, figures, report.html, and the finished sequences."""
    overwrite: bool = False
    """Replace the run that is in the output folder."""
    resume: bool = False
    """Continue the run that is in the output folder; the settings must be the same."""
    json: bool = False
    """Print results.json instead of the table."""


def policy_infos(names: Sequence[str], sweep: bool = True, every: int = 1) -> list[PolicyInfo]:
    """The table's policies, never and always first, then the sweeps of their families.

    Args:
        names: of the table's policies.
        sweep: whether the families' sweeps take part.
        every: of the sweeps of adaptive families only every so many-th number.
    """
    listed = [parse_policy(name) for name in (*ENDPOINTS, *names)]
    swept = [
        PolicyName(family, float(value), weights)
        for family, weights in dict.fromkeys((name.family, name.weights) for name in listed)
        for value in FAMILIES[family].sweep[:: every if FAMILIES[family].adaptive else 1]
    ]
    return [
        PolicyInfo(
            name=str(name),
            family=name.family,
            parameter=name.parameter,
            listed=name in listed,
            adaptive=FAMILIES[name.family].adaptive,
            privileged=make_policy(str(name), seed=0).privileged,
            weights=name.weights,
        )
        for name in dict.fromkeys([*listed, *(swept if sweep else [])])
    ]


@dataclass(frozen=True)
class CompareSequence:
    """The work of one process: one sequence with every policy."""

    settings: Settings

    def __call__(self, seed: int) -> SequenceResult:
        """Run the sensors once, then play every policy on what they saw."""
        settings = self.settings
        stream = SyntheticStream(settings.config)
        extrapolator = make_extrapolator(settings.extrapolator, odometry=settings.odometry)
        first = seed == settings.sequence_seeds[0]
        trace = trace_sequence(stream, extrapolator, seed, keep_frames=first)
        stream.close()
        scheduler = Scheduler(trace)
        policies = {info.name: scheduler.scripted(make_policy(info.name, seed)) for info in settings.infos}
        energy = EnergyModel(lidar_frame_j=settings.config.lidar.energy_mj / 1000)
        return evaluate_sequence(trace, policies, least_errors, energy)


def least_errors(errors: Any, period: int) -> Any:
    """The optimal oracle's least total error for 0..N triggers."""
    return oracle_curve(errors, period)[1]


def run(options: Options) -> dict[str, Any]:
    """Evaluate, write the report, print it, and return the content of ``results.json``."""
    settings = options.settings
    settings.validate()
    make_extrapolator(settings.extrapolator, odometry=settings.odometry)  # a wrong name fails before the work
    identity = {"version": nl_env.__version__, **asdict(settings)}  # no run mixes versions
    checkpoints = open_folder(options.out, identity, overwrite=options.overwrite, resume=options.resume)
    with tqdm(total=settings.sequences, desc="sequences", unit="sequence", disable=None) as bar:
        results = run_sequences(
            CompareSequence(settings),
            SequenceResult.load,
            settings.sequence_seeds,
            checkpoints,
            workers=options.workers,
            progress=bar.update,
        )
    comparison = compare(
        asdict(settings),
        settings.infos,
        results,
        np.random.default_rng(settings.seed),
    )
    written = write_report(comparison, options.out)
    if options.json:
        print(json.dumps(written, indent=1, allow_nan=False))
    else:
        print(text_report(comparison))
        print("* privileged: reads what no sensor gives. Columns: see table.md beside the page.")
        print(f"page: {(options.out / 'report.html').resolve().as_uri()}")
    return written


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""

    def work(given: list[str]) -> None:
        run(tyro.cli(Options, args=given, description=__doc__))

    return run_command("compare", work, arguments, kept="finished sequences are kept")


if __name__ == "__main__":
    sys.exit(main())
