"""What the commands of all tables share."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from nl_env.config import number
from nl_env.elidar import elidar_in
from nl_env.elidar.layout import RANGE
from nl_env.reproduction.data import Sequences, SimulatedWorlds, find_sequences
from nl_env.reproduction.elidar import Release
from nl_env.reproduction.job import Job, Output


@dataclass(frozen=True)
class Making:
    """How any table is made."""

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

    def job(
        self,
        table: str,
        data: Mapping[str, Sequences | SimulatedWorlds],
        weights: Iterable[Path],
        settings: dict[str, Any],
        on_error: str = "raise",
    ) -> Job:
        """Start a table; arguments as :class:`nl_env.reproduction.job.Job` and its ``Output``."""
        folder = self.out or Path("runs") / table
        output = Output(folder, self.markdown, self.workers, self.overwrite, self.resume, on_error)
        return Job(table, output, data, weights, settings)


@dataclass(frozen=True)
class Common(Making):
    """What every table takes that is measured on recordings or on ELiDAR."""

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


def measure(job: Job, task: Any, load: Any) -> dict[str, list[Any]]:
    """Measure what is not finished, with a progress bar on a terminal."""
    with tqdm(total=len(job.seeds), desc=job.table, unit="sequence", disable=None) as bar:
        return job.measure(task, load, bar.update)
