"""The extrapolation CSV: which depth frames and which voxel grid make a pair, and how far apart they are."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nl_env.config import choice
from nl_env.elidar.layout import METADATA_COLUMNS, SPLITS
from nl_env.runs import write_text

ON_ERROR = ("raise", "skip")
INT32_MAX = 2**31 - 1


@dataclass(frozen=True)
class Problem:
    """Why a sequence cannot be used."""

    sequence: str
    message: str


def warn_of(problems: Iterable[Problem]) -> None:
    """One warning for each sequence that was left out, with the reason."""
    for problem in problems:
        warnings.warn(f"left out {problem.sequence}: {problem.message}", stacklevel=3)


@dataclass(frozen=True, eq=False)
class SequencePairs:
    """The rows of one sequence, in the order of the file.

    Attributes:
        source: the CSV, for messages.
        name: sequence name.
        split: ``"train"`` or ``"test"``.
        lines: ``(n,)`` int64, line of each row in the CSV; the header is line 1.
        events_id: ``(n,)`` int64, voxel grid.
        prior: ``(n,)`` int64, depth frame before.
        truth: ``(n,)`` int64, depth frame to predict.
        duration: ``(n,)`` int64, time between them, ticks of 5 ms.
    """

    source: Path
    name: str
    split: str
    lines: NDArray[np.int64]
    events_id: NDArray[np.int64]
    prior: NDArray[np.int64]
    truth: NDArray[np.int64]
    duration: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.lines)


@dataclass(frozen=True, eq=False)
class Metadata:
    """A whole CSV.

    Attributes:
        path: the file.
        sequences: in order of first appearance.
        problems: sequences left out with ``on_error="skip"``.
    """

    path: Path
    sequences: tuple[SequencePairs, ...]
    problems: tuple[Problem, ...] = ()

    def __len__(self) -> int:
        return sum(map(len, self.sequences))


def read_metadata(path: Path, *, on_error: str = "raise") -> Metadata:
    """Read the extrapolation CSV.

    Args:
        path: comma-separated, with the columns ``METADATA_COLUMNS`` in any order; a byte order mark is fine.
        on_error: ``"skip"`` leaves sequences with a bad row out and lists them in ``problems``.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not such a CSV, or (with ``on_error="raise"``) a bad row: the message has its line.
    """
    choice("on_error", on_error, ON_ERROR)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected ELiDAR's extrapolation CSV")
    rows: dict[str, list[tuple[int, str, int, int, int, int]]] = {}
    broken: dict[str, str] = {}
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, strict=True)
            columns = _columns(path, next(reader, []))
            width = max(columns) + 1
            for row in reader:
                if not row:
                    continue
                if len(row) < width:
                    raise ValueError(
                        f"{path}: line {reader.line_num}: found {len(row)} columns, expected {width}"
                    )
                split, name, *numbers = (row[column] for column in columns)
                try:
                    entry = (reader.line_num, _split(split), *_numbers(numbers))
                except ValueError as error:
                    broken.setdefault(name, f"line {reader.line_num}: {error}")
                    continue
                rows.setdefault(name, []).append(entry)
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: found bytes that are not UTF-8 text, expected a CSV") from error
    except csv.Error as error:
        raise ValueError(f"{path}: not a CSV ({error})") from error
    sequences = []
    for name, entries in rows.items():
        splits = sorted({entry[1] for entry in entries})
        if len(splits) > 1:
            other = next(entry[0] for entry in entries if entry[1] != entries[0][1])
            broken.setdefault(name, f"line {other}: found splits {' and '.join(splits)}, expected one")
        if name not in broken:
            lines, _, *columns_ = zip(*entries, strict=True)
            arrays = (np.array(column, np.int64) for column in (lines, *columns_))
            sequences.append(SequencePairs(path, name, splits[0], *arrays))
    problems = tuple(Problem(name, f"{path}: {name}: {message}") for name, message in broken.items())
    if problems and on_error == "raise":
        raise ValueError(problems[0].message)
    if not sequences and not problems:
        raise ValueError(f"{path}: found a header and no row, expected one row a pair")
    return Metadata(path, tuple(sequences), problems)


def write_metadata(path: Path, sequences: Iterable[SequencePairs]) -> None:
    """Write the rows of ``sequences`` as ELiDAR's CSV, atomically."""
    lines = [",".join(METADATA_COLUMNS)]
    for pairs in sequences:
        columns = (pairs.events_id, pairs.prior, pairs.truth, pairs.duration)
        lines += (
            f"{pairs.split},{pairs.name},{events},{prior},{truth},{duration}"
            for events, prior, truth, duration in zip(*(c.tolist() for c in columns), strict=True)
        )
    write_text(path, "\n".join(lines) + "\n")


def _columns(path: Path, header: Sequence[str]) -> list[int]:
    """Place of each of ``METADATA_COLUMNS`` in the header."""
    wanted = ",".join(METADATA_COLUMNS)
    names = [name.strip() for name in header]
    if len(names) == 1 and len(names[0]) > len("sequence"):
        raise ValueError(f"{path}: found the header {names[0]!r} in one column, expected commas: {wanted}")
    missing = [name for name in METADATA_COLUMNS if name not in names]
    if missing:
        found = ",".join(names) or "an empty file"
        raise ValueError(f"{path}: found columns {found}, missing {', '.join(missing)}; expected {wanted}")
    return [names.index(name) for name in METADATA_COLUMNS]


def _split(text: str) -> str:
    choice("split", text, SPLITS)
    return text


def _numbers(texts: Sequence[str]) -> tuple[int, int, int, int]:
    """Ids and duration of a row; raises ``ValueError`` naming the column."""
    values = []
    for column, text in zip(METADATA_COLUMNS[2:], texts, strict=True):
        low = 1 if column == "duration" else 0
        try:
            value = int(text)
        except ValueError:
            raise ValueError(f"{column}: found {text!r}, expected an integer") from None
        if not low <= value <= INT32_MAX:
            raise ValueError(f"{column}: found {value}, expected an integer from {low}")
        values.append(value)
    events_id, prior, truth, duration = values
    return events_id, prior, truth, duration
