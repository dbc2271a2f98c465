"""ELiDAR's event frames as data for keyframe detectors, read when they are needed.

Detectors without a memory learn from the labelled frames of the slicing HDF5, those with one from the raw
sequences.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.keyframe_data import COUNT_LIMIT
from agents.keyframe_networks import CAUSES
from nl_env.config import number
from nl_env.depth.elidar_pairs import held_out as held_out_names
from nl_env.elidar import ElidarFiles, parse_sequence_name, read_sequence_list
from nl_env.elidar.metadata import warn_of
from nl_env.elidar.slicing import EventFrames, RawSequence, SlicingData, readable_sequences

BLOCKS = 10
"""Held-out frames are this many runs of neighbours, evenly spread: neighbours may be of one sequence."""

PIECE = 333
"""Slices that sequences are cut into, because those of the release differ in length: 999 or 1,499."""


class ElidarFrames:
    """Some frames of one split of the slicing HDF5; a :class:`agents.keyframe_data.FrameSource`.

    The file does not say which frames belong to a sequence, so they count as a single one, and intervals
    over sequences have no width. Of the label's causes nothing is known, and neither is which slices had a
    LiDAR frame: every fifth frame stands for one, as the frames were drawn at random.

    Args:
        data: the split.
        chosen: ``(n,)`` int64, the frames in use.
    """

    def __init__(self, data: SlicingData, chosen: NDArray[np.int64]) -> None:
        self.data = data
        self.chosen = chosen
        self.shape = data.shape
        self.length = len(chosen)
        self.seeds = [0]
        self.weathers = ["unknown"]

    @property
    def summary(self) -> dict[str, Any]:
        """File and number of frames, for cards: JSON-ready."""
        return {
            "release": "ELiDAR slicing",
            "file": self.data.path.name,
            "split": self.data.split,
            "frames": self.length,
            "first_frame": int(self.chosen[0]),
        }

    def __len__(self) -> int:
        """Number of sequences."""
        return 1

    def frames(self, number: int) -> EventFrames:
        """The event frames, cut at the counts that recordings are cut at."""
        return self.data.frames(self.chosen, -COUNT_LIMIT)

    def causes(self, number: int) -> NDArray[np.bool_]:
        """``(length, 1)`` bool, the label alone."""
        return self.data.scores[self.chosen][:, None] > 0.5

    def lidar(self, number: int) -> NDArray[np.bool_]:
        """``(length,)`` bool, every fifth."""
        return np.arange(1, self.length + 1) % 5 == 0


def open_elidar_frames(hdf5: Path, held_out: float) -> tuple[ElidarFrames, ElidarFrames]:
    """Training frames and held-out ones of the training split; the test split is left alone.

    Args:
        hdf5: the slicing HDF5.
        held_out: share of the frames that choose the best weights and the thresholds.

    Raises:
        FileNotFoundError, ValueError: as :class:`nl_env.elidar.SlicingData`, or too few frames.
    """
    number("held_out", held_out, 0.001, 0.5)
    data = SlicingData(hdf5, "train")
    if len(data) < 2 * BLOCKS:
        raise ValueError(f"{hdf5}: found {len(data)} training frames, expected at least {2 * BLOCKS}")
    position = np.arange(len(data)) * BLOCKS / len(data) % 1
    out = np.abs(position - 0.5) < held_out / 2
    out |= ~out.any() & (np.arange(len(data)) == len(data) // 2)
    return ElidarFrames(data, np.flatnonzero(~out)), ElidarFrames(data, np.flatnonzero(out))


class ElidarSequences:
    """Raw sequences in pieces of equal length; a :class:`agents.keyframe_data.FrameSource`.

    A piece is followed from an empty memory. Slices after the last whole piece are left out. Causes are
    known where those of every sequence explain its label.

    Args:
        files: of the sequences.

    Raises:
        ValueError: a file that cannot be used, sequences of different sizes, or none of ``PIECE`` slices.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        raw = [RawSequence(path) for path in files]
        self._pieces = [
            (sequence, start) for sequence in raw for start in range(0, len(sequence) - PIECE + 1, PIECE)
        ]
        if not self._pieces:
            raise ValueError(f"{files[0]}: found {len(raw[0])} slices, expected at least {PIECE}")
        self.shape = raw[0].shape
        for sequence in raw:
            if sequence.shape != self.shape:
                raise ValueError(
                    f"{sequence.path}: found images {sequence.shape}, "
                    f"expected {self.shape} as in {raw[0].path}"
                )
            sequence.close()
        self.names = [path.stem for path in files]
        self.length = PIECE
        self.seeds = list(range(len(self._pieces)))
        self.weathers = [parse_sequence_name(s.path.stem).weather or "unknown" for s, _ in self._pieces]
        self._explained = all(sequence.causes.shape[1] == len(CAUSES) for sequence in raw)

    @property
    def summary(self) -> dict[str, Any]:
        """Sequences and pieces, for cards: JSON-ready."""
        return {
            "release": "ELiDAR raw sequences",
            "sequences": self.names,
            "pieces": len(self),
            "slices": self.length,
        }

    def __len__(self) -> int:
        """Number of pieces."""
        return len(self._pieces)

    def frames(self, number: int) -> EventFrames:
        """The event frames of a piece."""
        sequence, start = self._pieces[number]
        chosen = np.arange(start, start + PIECE)
        return EventFrames(sequence.frame, chosen, self.shape, -COUNT_LIMIT)

    def causes(self, number: int) -> NDArray[np.bool_]:
        """``(length, 3)`` bool, or ``(length, 1)``, the label alone."""
        sequence, start = self._pieces[number]
        causes = sequence.causes if self._explained else sequence.keyframe[:, None]
        return causes[start : start + PIECE]

    def lidar(self, number: int) -> NDArray[np.bool_]:
        """``(length,)`` bool, every fifth slice of the sequence: 10 Hz."""
        start = self._pieces[number][1]
        return np.arange(start + 1, start + PIECE + 1) % 5 == 0


def open_elidar_sequences(
    files: ElidarFiles, held_out: float, on_error: str = "raise"
) -> tuple[ElidarSequences, ElidarSequences]:
    """Training sequences and held-out ones of the slicing release's training list; others are left alone.

    Args:
        files: of the release.
        held_out: share of the sequences that choose the best weights and the thresholds.
        on_error: ``"skip"`` leaves out sequences that cannot be opened and warns of each.

    Raises:
        FileNotFoundError: no list, or none of its sequences.
        ValueError: as :class:`ElidarSequences`, or too few sequences.
    """
    number("held_out", held_out, 0.001, 0.5)
    names = read_sequence_list(files.lists["train"]) if "train" in files.lists else ()
    names = tuple(name for name in names if name in files.raw)
    if not names:
        raise FileNotFoundError(
            f"{files.folder}: found no raw training sequences, expected train_sequences.txt and their .npz: "
            "a detector with a memory learns from whole sequences"
        )
    readable, problems = readable_sequences({name: files.raw[name] for name in names}, on_error=on_error)
    warn_of(problems)
    chosen = held_out_names(list(readable), held_out)
    kept = [name for name in readable if name not in chosen]
    return ElidarSequences([files.raw[n] for n in kept]), ElidarSequences([files.raw[n] for n in chosen])
