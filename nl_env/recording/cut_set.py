"""Cut sets: arrays that are made out of sequences once and then read through memory maps.

A training reads the same small parts of large files thousands of times, in random order. They are cut out
beforehand, into one uncompressed file per sequence.
"""

from __future__ import annotations

import json
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from nl_env.runs import SETTINGS_FILE, open_folder, run_sequences


class CutSet:
    """The arrays of one folder, one for each sequence.

    Files are mapped at the first access, once per process; pickling carries the path alone.

    Args:
        folder: as given to :func:`cut`.

    Attributes:
        identity: what the arrays were cut from and how.
        seeds: of the sequences; a sequence's number is its place here.

    Raises:
        FileNotFoundError: ``folder`` holds no cut set.
        ValueError: a file that is truncated or holds something else (at its first access).
    """

    what: ClassVar[str] = "arrays"
    """What is cut, for messages."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        marker = self.folder / SETTINGS_FILE
        if not marker.is_file():
            raise FileNotFoundError(f"{self.what}: found no {SETTINGS_FILE} in {str(self.folder)!r}")
        self.identity: dict[str, Any] = json.loads(marker.read_text(encoding="utf-8"))
        self.seeds: list[int] = self.identity["seeds"]
        self._arrays: dict[int, NDArray[Any]] = {}

    @abstractmethod
    def expected(self, number: int) -> tuple[np.dtype[Any], tuple[int, ...]]:
        """Type and shape of the array of a sequence."""

    def sequence(self, number: int) -> NDArray[Any]:
        """The array of a sequence, mapped from its file."""
        if number not in self._arrays:
            path = self.folder / "sequences" / f"{self.seeds[number]}.npy"
            found = _ArrayFile.load(path).array
            dtype, shape = self.expected(number)
            if found.dtype != dtype or found.shape != shape:
                raise ValueError(
                    f"{self.what}: found {found.shape} of other contents in {str(path)!r}, "
                    f"expected {shape} {self.what} of {dtype.itemsize} bytes"
                )
            self._arrays[number] = found
        return self._arrays[number]

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.folder,)


def cut(
    folder: Path,
    identity: dict[str, Any],
    task: Callable[[int], NDArray[Any]],
    *,
    workers: int = 0,
    progress: Callable[[int], None] = lambda finished: None,
) -> None:
    """Make the arrays of a cut set, or those that are missing.

    Args:
        folder: where they go.
        identity: everything that determines them, JSON-ready; ``"seeds"`` lists the sequences.
        task: makes the array of a seed; picklable with workers.
        workers: processes of one thread each; the files do not depend on it.
        progress: called with the number of newly finished sequences.

    Raises:
        ValueError: ``folder`` holds arrays of another identity.
        OSError: ``folder`` cannot be written.
    """
    checkpoints = open_folder(folder, identity, resume=True)
    seeds = identity["seeds"]
    run_sequences(
        _Task(task), _ArrayFile.load, seeds, checkpoints, workers=workers, suffix=".npy", progress=progress
    )


@dataclass(frozen=True)
class _ArrayFile:
    """An array and its file."""

    array: NDArray[Any]

    def save(self, path: Path) -> None:
        """Write uncompressed."""
        np.save(path, self.array, allow_pickle=False)

    @classmethod
    def load(cls, path: Path) -> _ArrayFile:
        """Map what :meth:`save` wrote."""
        try:
            return cls(np.load(path, mmap_mode="r", allow_pickle=False))
        except FileNotFoundError:
            raise
        except (ValueError, EOFError, OSError) as cause:
            raise ValueError(f"found no whole array in {str(path)!r} ({cause})") from cause


@dataclass(frozen=True)
class _Task:
    """The work of one process."""

    task: Callable[[int], NDArray[Any]]

    def __call__(self, seed: int) -> _ArrayFile:
        return _ArrayFile(self.task(seed))
