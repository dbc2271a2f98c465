"""The tables on depth error by gap: rates and ablations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from numpy.typing import NDArray

from nl_env.config import number
from nl_env.depth.extrapolators import WEIGHTS
from nl_env.depth.metrics import METRIC_NAMES
from nl_env.reproduction.elidar import ElidarGapsTask, Release
from nl_env.reproduction.figures import Figures, summarise
from nl_env.reproduction.gap_tables import REPEAT, ablation_sections, rate_sections
from nl_env.reproduction.gaps import GROUPS, MEAN, GapsTask, Method, SequenceErrors, with_mean
from nl_env.reproduction.job import Job, shown
from nl_env.reproduction.targets import ablation_targets, rate_targets, target_section
from nl_env.reproduction.variants import OURS, PAPER, read_variant
from scripts.tables.options import Common, measure

OUR_WEIGHTS = WEIGHTS / "unet.safetensors"


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
    job = common.job(table, {"test": data}, weights, {"pairs": pairs, "methods": rows}, common.on_error)
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
