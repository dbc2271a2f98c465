"""The extrapolation release: pairs of depth frames and the voxel grid of the events between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nl_env.config import choice, number
from nl_env.elidar.hdf5 import Hdf5Reader
from nl_env.elidar.layout import RANGE, SPLITS
from nl_env.elidar.metadata import ON_ERROR, Problem, SequencePairs, read_metadata
from nl_env.elidar.timeline import frame_ticks
from nl_env.types import BINS


@dataclass(frozen=True, eq=False)
class Pair:
    """One row of the CSV with its data.

    Attributes:
        sequence: sequence name.
        prior: ``(H, W)`` float32 m, depth frame before; 0 = no return.
        voxel: ``(5, H, W)`` float32, signed event sums between the two frames (Eq. 2).
        truth: ``(H, W)`` float32 m, depth frame to predict.
        duration: time between the frames, ticks of 5 ms.
    """

    sequence: str
    prior: NDArray[np.float32]
    voxel: NDArray[np.float32]
    truth: NDArray[np.float32]
    duration: int


class ExtrapolationData:
    """Pairs of an extrapolation HDF5 and its CSV; ``len`` and indexing as a list of :class:`Pair`.

    Reads what is asked for and nothing else, whatever the types and chunks of the datasets: depth frames
    ``(N, 1, H, W)`` or ``(N, H, W)``, voxel grids ``(M, 5, H, W)``, flat rows ``(M, 5 H W)`` or rows of
    variable length. Pickles as its paths; each process opens the file for itself.

    Args:
        hdf5, metadata: the two files.
        split: ``"train"``, ``"test"`` or None for both.
        sequences: names of the sequences wanted, or None for all.
        max_depth: depths beyond are no return, m: 200 outdoors, 9 indoors.
        on_error: ``"skip"`` leaves out sequences whose rows or datasets do not fit and lists them in
            ``problems``; ``"raise"`` refuses them.

    Attributes:
        metadata: the CSV.
        shape: ``(H, W)``.
        sequences: the rows of each sequence in use, by name.
        ticks: tick of each depth frame, by name (:func:`nl_env.elidar.timeline.frame_ticks`).
        problems: what was left out.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a file cannot be used; the message says which, where, what was found and expected.
    """

    def __init__(
        self,
        hdf5: Path,
        metadata: Path,
        *,
        split: str | None = None,
        sequences: Sequence[str] | None = None,
        max_depth: float = RANGE,
        on_error: str = "raise",
    ) -> None:
        choice("split", split, (None, *SPLITS))
        choice("on_error", on_error, ON_ERROR)
        number("max_depth", max_depth, 0.1, 10_000.0)
        self._reader = Hdf5Reader(hdf5)
        self.metadata = metadata
        self.max_depth = float(max_depth)
        table = read_metadata(metadata, on_error=on_error)
        problems = list(table.problems)
        known = {pairs.name for pairs in table.sequences} | {problem.sequence for problem in problems}
        for name in sequences or ():
            if name not in known:
                raise ValueError(f"sequences: found {name!r}, which is not in {metadata}")
        self.sequences: dict[str, SequencePairs] = {}
        self.ticks: dict[str, NDArray[np.int64]] = {}
        self.shape: tuple[int, int] = (0, 0)
        for pairs in table.sequences:
            if split not in (None, pairs.split) or (sequences is not None and pairs.name not in sequences):
                continue
            try:
                ticks = frame_ticks(pairs)
                self._check(pairs)
            except ValueError as error:
                if on_error == "raise":
                    raise
                problems.append(Problem(pairs.name, str(error)))
            else:
                self.sequences[pairs.name] = pairs
                self.ticks[pairs.name] = ticks
        self.problems = tuple(problems)
        if not self.sequences:
            why = f": {problems[0].message}" if problems else ""
            raise ValueError(f"{metadata}: found no usable sequence of split {split or 'train or test'}{why}")
        self._starts = np.cumsum([0, *map(len, self.sequences.values())])
        self._names = tuple(self.sequences)

    def __len__(self) -> int:
        return int(self._starts[-1])

    def place(self, index: int) -> tuple[str, int]:
        """Sequence and row of pair ``index``; raises ``IndexError``."""
        if not 0 <= index < len(self):
            raise IndexError(f"pair: found {index}, expected 0 to {len(self) - 1}")
        place = int(np.searchsorted(self._starts, index, side="right")) - 1
        return self._names[place], int(index - self._starts[place])

    def __getitem__(self, index: int) -> Pair:
        name, row = self.place(index)
        pairs = self.sequences[name]
        return Pair(
            name,
            self.depth(name, int(pairs.prior[row])),
            self.voxel(name, int(pairs.events_id[row])),
            self.depth(name, int(pairs.truth[row])),
            int(pairs.duration[row]),
        )

    @property
    def path(self) -> Path:
        """The HDF5 file."""
        return self._reader.path

    @property
    def durations(self) -> NDArray[np.int64]:
        """``(len,)`` int64, gap of every pair in ticks of 5 ms."""
        return np.concatenate([pairs.duration for pairs in self.sequences.values()])

    def depth(self, sequence: str, frame: int) -> NDArray[np.float32]:
        """Depth frame ``frame`` of a sequence: ``(H, W)`` float32 m, 0 where nothing is in range.

        Raises:
            ValueError: no such frame, damaged data, or depths that are negative, NaN or infinite.
        """
        dataset = f"{sequence}/depth_frames"
        depth = self._reader.read(dataset, frame).astype(np.float32).reshape(self.shape)
        if not (np.isfinite(depth).all() and depth.min() >= 0):
            raise ValueError(
                f"{self.path}: {dataset}[{frame}]: found depths from {np.nanmin(depth)} to {np.nanmax(depth)}"
                f" ({np.count_nonzero(~np.isfinite(depth))} not finite), expected metres, 0 or more"
            )
        depth[depth > self.max_depth] = 0
        return depth

    def voxel(self, sequence: str, events_id: int) -> NDArray[np.float32]:
        """Voxel grid ``events_id`` of a sequence: ``(5, H, W)`` float32 signed event counts.

        Raises:
            ValueError: no such grid, damaged data, a grid of another size, or NaN or infinity in it.
        """
        dataset = f"{sequence}/events"
        grid = self._reader.read(dataset, events_id).astype(np.float32)
        if grid.size != BINS * self.shape[0] * self.shape[1]:
            raise ValueError(
                f"{self.path}: {dataset}[{events_id}]: found {grid.size} values, "
                f"expected {(BINS, *self.shape)}"
            )
        if not np.isfinite(grid).all():
            raise ValueError(
                f"{self.path}: {dataset}[{events_id}]: found NaN or infinity, expected event counts"
            )
        return grid.reshape(BINS, *self.shape)

    def close(self) -> None:
        """Close the file; it opens again when it is needed."""
        self._reader.close()

    def _check(self, pairs: SequencePairs) -> None:
        """Shapes of a sequence's datasets, and its ids against their lengths."""
        depth = self._reader.dataset(f"{pairs.name}/depth_frames")
        events = self._reader.dataset(f"{pairs.name}/events")
        if depth.ndim not in (3, 4) or (depth.ndim == 4 and depth.shape[1] != 1):
            raise self._shape_error(depth, "(N, 1, H, W)")
        height, width = (int(size) for size in depth.shape[-2:])
        if self.shape not in ((0, 0), (height, width)):
            raise self._shape_error(depth, f"{self.shape} images as in the other sequences")
        grids = (events.shape[0] if events.shape else 0, BINS, height, width)
        flat = (grids[0], BINS * height * width)
        if events.shape not in (grids, flat, flat[:1]) or (events.ndim == 1 and events.dtype.kind != "O"):
            raise self._shape_error(events, f"{('M', *grids[1:])} or flat {('M', flat[1])}")
        columns = (
            ("prior_depth_frame_id", pairs.prior, depth),
            ("gt_depth_frame_id", pairs.truth, depth),
            ("events_id", pairs.events_id, events),
        )
        for column, ids, dataset in columns:
            row = int(np.argmax(ids))
            if ids[row] >= len(dataset):
                raise ValueError(
                    f"{pairs.source}: {pairs.name}: line {pairs.lines[row]}: found {column} {ids[row]}, "
                    f"expected at most {len(dataset) - 1}, the last in {self.path}: {dataset.name}"
                )
        self.shape = (height, width)

    def _shape_error(self, dataset: object, expected: str) -> ValueError:
        name, shape = getattr(dataset, "name", "?"), getattr(dataset, "shape", "?")
        return ValueError(f"{self.path}: {name}: found shape {shape}, expected {expected}")
