"""Long work as separate commands: logs and records of the finished ones, so that a repeated run continues."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from nl_env.runs import THREAD_VARIABLES, write_text


@dataclass(frozen=True)
class Step:
    """One command.

    Attributes:
        name: of its log and of its record.
        command: script and arguments.
    """

    name: str
    command: tuple[str, ...]


class Runner:
    """Runs steps, keeps their logs, and remembers which are finished.

    Args:
        folder: of the logs and records.
        root: where the commands are started.
    """

    def __init__(self, folder: Path, root: Path) -> None:
        self.folder = folder
        self.root = root
        folder.mkdir(parents=True, exist_ok=True)

    def run(self, steps: Sequence[Step], jobs: int) -> None:
        """Run what is not finished, ``jobs`` at a time.

        Raises:
            RuntimeError: a step failed; the others of its stage are finished first.
        """
        waiting = [step for step in steps if not self.finished(step)]
        with ThreadPoolExecutor(jobs) as pool:
            running = [pool.submit(self._run, step) for step in waiting]
            try:
                failed = [step.name for step, ok in zip(waiting, running, strict=True) if not ok.result()]
            except BaseException:
                pool.shutdown(cancel_futures=True)  # an interrupt ends the commands under way by itself
                raise
        if failed:
            raise RuntimeError(f"failed: {', '.join(failed)}; see the logs in {self.folder}")

    def finished(self, step: Step) -> bool:
        """Whether exactly this command has ended well before."""
        record = self._record(step)
        return record.is_file() and json.loads(record.read_text(encoding="utf-8"))["command"] == list(
            step.command
        )

    def _record(self, step: Step) -> Path:
        return self.folder / f"{step.name}.json"

    def _run(self, step: Step) -> bool:
        print(f"{step.name}: python {shlex.join(step.command)}", flush=True)
        threads = dict.fromkeys(THREAD_VARIABLES, "1")
        began = time.monotonic()
        with open(self.folder / f"{step.name}.log", "ab") as log:
            ended = subprocess.run(
                [sys.executable, *step.command],
                cwd=self.root,
                env={**os.environ, **threads},
                stdout=log,
                stderr=subprocess.STDOUT,
                check=False,
            )
        seconds = round(time.monotonic() - began, 1)
        if ended.returncode == 0:
            content = {"command": list(step.command), "seconds": seconds}
            write_text(self._record(step), json.dumps(content, indent=1) + "\n")
        print(f"{step.name}: exit status {ended.returncode} after {seconds} s", flush=True)
        return ended.returncode == 0
