"""The table on policies and extrapolators together."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from agents.keyframe_cnn import FRAME_WEIGHTS, TEMPORAL_WEIGHTS
from agents.oracle import priced_schedule
from agents.table_policies import FRAME, PlayPolicies
from nl_env.config import number
from nl_env.reproduction.elidar import Release
from nl_env.reproduction.elidar_end_to_end import (
    ElidarEndToEndTask,
    ElidarRun,
    end_to_end_names,
    records_of,
)
from nl_env.reproduction.end_to_end import EndToEndTask, SequenceRun
from nl_env.reproduction.end_to_end_tables import end_to_end_sections, summarise_records
from nl_env.reproduction.gaps import Method
from nl_env.reproduction.schedules import play_all
from nl_env.reproduction.targets import end_to_end_targets, target_section
from nl_env.reproduction.variants import OURS, PAPER
from nl_env.types import SLICE_US
from scripts.tables.gaps import OUR_WEIGHTS
from scripts.tables.options import Common, measure


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
        job = self.common.job("table-end-to-end", {"test": data}, weights, settings, self.common.on_error)
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
        job = self.common.job("table-end-to-end", {"test": data}, weights, settings, self.common.on_error)
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
