"""One table being made: its output folder, the sequences that are measured, the results that are written."""

from __future__ import annotations

import hashlib
import json
import os
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nl_env
from nl_env.config import choice
from nl_env.elidar.metadata import ON_ERROR
from nl_env.reproduction.data import Sequences, SimulatedWorlds
from nl_env.reproduction.document import (
    Section,
    check_document,
    jsonable,
    machine,
    markdown,
    update_document,
)
from nl_env.runs import open_folder, run_sequences, write_text


@dataclass(frozen=True)
class Output:
    """Where results go and how they are made.

    Attributes:
        folder: results.json, table.md and the finished sequences.
        markdown: a document with marks for the table, or None.
        workers: processes of one thread each; 0 runs in this one.
        overwrite: replace the run that is in the folder.
        resume: continue it; data, weights and settings must be the same.
        on_error: ``"skip"`` leaves out sequences that turn out to be damaged, and says so in the results.

    Raises:
        ValueError: an unknown ``on_error``.
    """

    folder: Path
    markdown: Path | None = None
    workers: int = 0
    overwrite: bool = False
    resume: bool = False
    on_error: str = "raise"

    def __post_init__(self) -> None:
        choice("on_error", self.on_error, ON_ERROR)


class Job:
    """One table.

    Args:
        table: its name, as on the command line.
        output: where to.
        data: the recordings or simulated worlds, by what they are for.
        weights: every file of weights that is used.
        settings: what else determines the results, JSON-ready.

    Raises:
        FileNotFoundError: a file of weights or the document is missing.
        ValueError: the document has no marks for the table.
    """

    def __init__(
        self,
        table: str,
        output: Output,
        data: Mapping[str, Sequences | SimulatedWorlds],
        weights: Iterable[Path],
        settings: Mapping[str, Any],
    ) -> None:
        self.table = table
        self.output = output
        self.data = data
        self.left_out: dict[int, str] = {}
        self.settings = {
            "version": nl_env.__version__,
            "table": table,
            "data": {name: found.digest for name, found in data.items()},
            "weights": {shown(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in weights},
            **settings,
        }
        if output.markdown is not None:
            check_document(output.markdown, table)

    @property
    def resolution(self) -> str:
        """Of the recordings."""
        return str(next(iter(self.data.values())).settings["resolution"])

    @property
    def seeds(self) -> list[int]:
        """Every sequence that is measured."""
        return [seed for found in self.data.values() for seed in found.seeds]

    def measure(
        self,
        task: Callable[[int], Any],
        load: Callable[[Path], Any],
        progress: Callable[[int], None] = lambda finished: None,
    ) -> dict[str, list[Any]]:
        """Run ``task`` on every sequence that is not finished; all results, by part of the data.

        Raises:
            ValueError: damaged data, unless ``on_error="skip"``; then, a part of which nothing is left.
            OSError, ValueError: as ``nl_env.runs.open_folder``.
        """
        output = self.output
        folder = open_folder(output.folder, self.settings, overwrite=output.overwrite, resume=output.resume)
        results = run_sequences(
            task,
            load,
            self.seeds,
            folder,
            workers=output.workers,
            progress=progress,
            broken=self._leave_out if output.on_error == "skip" else None,
        )
        by_seed = {result.seed: result for result in results}
        parts = {
            name: [by_seed[seed] for seed in found.seeds if seed in by_seed]
            for name, found in self.data.items()
        }
        for name, part in parts.items():
            if not part:
                reasons = "; ".join(self.left_out[seed] for seed in self.data[name].seeds)
                raise ValueError(f"{name}: found no sequence that can be read ({reasons})")
        return parts

    def _leave_out(self, seed: int, error: ValueError) -> None:
        self.left_out[seed] = str(error)
        warnings.warn(f"left out: {error}", stacklevel=2)

    def publish(self, sections: Sequence[Section], figures: Any, command: str, notes: str) -> str:
        """Write ``results.json`` and ``table.md``, update the document; the text of the tables."""
        parts = "; ".join(
            f"{len(set(found.seeds) - self.left_out.keys())} {found.split} sequences ("
            + ", ".join(f"{name} {value}" for name, value in found.settings.items())
            + ")"
            for found in self.data.values()
        )
        reasons = [reason for found in self.data.values() for reason in found.left_out]
        reasons += [self.left_out[seed] for seed in sorted(self.left_out)]
        missing = f" Left out: {'; '.join(reasons)}." if reasons else ""
        head = f"```\n{command}\n```\n\n{parts}.{missing} {notes} Machine: {machine()}."
        content = {
            "command": command,
            "machine": machine(),
            "settings": self.settings,
            "left_out": reasons,
            "figures": figures,
        }
        text = json.dumps(jsonable(content), indent=1, allow_nan=False) + "\n"
        write_text(self.output.folder / "results.json", text)
        page = f"# {self.table}\n\n{head}\n\n{markdown(sections, '##')}\n"
        write_text(self.output.folder / "table.md", page)
        if self.output.markdown is not None:
            update_document(self.output.markdown, self.table, f"{head}\n\n{markdown(sections)}")
        return f"{head}\n\n{markdown(sections)}"


def shown(path: Path) -> str:
    """A path as results name it: from the working folder, where it lies inside."""
    here = Path.cwd()
    return os.path.relpath(path, here) if path.resolve().is_relative_to(here) else str(path)
