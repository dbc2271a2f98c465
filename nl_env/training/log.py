"""What a training says while it runs: ``log.jsonl``, TensorBoard where installed, a bar or plain lines."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

from nl_env.runs import write_text

LOG_FILE, EVENTS_FOLDER = "log.jsonl", "tensorboard"
LINE_EVERY_S = 30.0
"""Seconds between plain lines where there is no terminal."""


class Log:
    """Scalars by step, to files and to standard error.

    Args:
        folder: of the run; a log that is there is cut after step ``first``.
        first: steps done before.
        total: steps in all.
        tensorboard: also write TensorBoard events, where the package is installed.
        quiet: print nothing.
    """

    def __init__(self, folder: Path, first: int, total: int, tensorboard: bool, quiet: bool) -> None:
        path = folder / LOG_FILE
        kept = [line for line in _lines(path) if json.loads(line)["step"] <= first]
        write_text(path, "".join(f"{line}\n" for line in kept))
        self._file = open(path, "a", encoding="utf-8")
        self._writer = _summary_writer(folder, first) if tensorboard else None
        self._quiet = quiet
        self._bar = None if quiet else _progress_bar(first, total)
        self._first, self._total = first, total
        self._began = self._printed = time.monotonic()

    def step(self, step: int) -> None:
        """One more step is done."""
        if self._bar is not None:
            self._bar.update(1)

    def scalars(self, step: int, group: str, values: dict[str, float]) -> None:
        """``values`` after ``step`` steps; ``group`` is "train" or "validation"."""
        rounded = {name: float(f"{value:.6g}") for name, value in values.items()}
        self._file.write(json.dumps({"step": step, "group": group, **rounded}) + "\n")
        self._file.flush()
        if self._writer is not None:
            for name, value in values.items():
                self._writer.add_scalar(f"{group}/{name}", value, step)
        text = f"{group} " + ", ".join(f"{name} {value:.4g}" for name, value in values.items())
        if self._bar is not None:
            if group == "train":
                self._bar.set_postfix_str(f"loss {values['loss']:.4g}", refresh=False)
            else:
                self._bar.write(f"step {step}: {text}", file=sys.stderr)
        elif not self._quiet:
            now = time.monotonic()
            if group != "train" or now - self._printed > LINE_EVERY_S:
                self._printed = now
                done = max(step - self._first, 1)
                left = (self._total - step) * (now - self._began) / done
                print(
                    f"step {step}/{self._total}, {left / 60:.1f} min left: {text}",
                    file=sys.stderr,
                    flush=True,
                )

    def close(self) -> None:
        """Close the files."""
        self._file.close()
        if self._writer is not None:
            self._writer.close()
        if self._bar is not None:
            self._bar.close()


def _lines(path: Path) -> list[str]:
    """Whole lines of ``path``: a killed run may have left half of one at the end."""
    if not path.is_file():
        return []
    return path.read_text(encoding="utf-8").rpartition("\n")[0].splitlines()


def _summary_writer(folder: Path, first: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder / EVENTS_FOLDER), purge_step=first + 1)


def _progress_bar(first: int, total: int) -> Any:
    if not sys.stderr.isatty():
        return None
    try:
        from tqdm import tqdm
    except ImportError:
        return None
    return tqdm(total=total, initial=first, unit="step", dynamic_ncols=True)
