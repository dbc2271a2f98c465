"""Replays ELiDAR's extrapolation files: their own depth frames and voxel grids, at their own times."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.config import number
from nl_env.elidar import ElidarFiles, ExtrapolationData, RawSequence, find_files, read_sequence_list
from nl_env.elidar.layout import RANGE
from nl_env.elidar.metadata import warn_of
from nl_env.elidar.walks import find_walks
from nl_env.types import BINS, TICK_US, TICKS_PER_SLICE, Camera, EgoState, Sample

LIDAR_PERIOD = 2
"""Steps between LiDAR frames. A voxel grid is stored from one depth frame of a chain to the next, so it
starts at a LiDAR frame exactly for the step that follows one."""
PHASES = LIDAR_PERIOD
"""Each chain is replayed from its first and from its second frame: every stored pair is a decision once."""

UNKNOWN_SPEED = -1.0
"""Where no file says the ego speed; a NaN would not equal itself in ``info``."""
MATCHED_GRIDS = 3
"""Stored 20 ms grids that are compared with a raw sequence before the two are joined."""


@dataclass(frozen=True, eq=False)
class Episode:
    """One replay: a chain of pairs from a LiDAR frame on.

    Attributes:
        sequence: ELiDAR name.
        walk: which chain of the sequence.
        phase: 0 if LiDAR frames are the chain's even frames, 1 if they are the odd ones.
        rows: rows of the CSV, one per step.
    """

    sequence: str
    walk: int
    phase: int
    rows: NDArray[np.int64]


class ElidarStream:
    """ELiDAR's pairs as a stream of irregular steps; a :class:`nl_env.types.SensorStream`.

    A step leads from one stored depth frame to the next of its chain (:mod:`nl_env.elidar.walks`), 20 to
    500 ms later. Its events are the stored voxel grid of exactly that window, its event frame the sum of
    the grid's bins. Every second frame of the chain is a LiDAR frame, as in the paper's evaluation at fixed
    rates; at the others the agent decides, and the grid from the last LiDAR frame to there is the stored
    one. ``reset(k)`` replays ``episodes[k]``.

    Other windows are not available: a grid over two steps cannot be put together from two grids whose bins
    differ in length. Nor are event counts: ``event_count`` is the sum of the absolute values of the grid,
    which misses events that cancel. Poses are unknown (NaN). Ego speed, distance and new actors come from
    the raw sequences where the folder has them and they fit; otherwise the speed is -1, the distance
    infinite.

    Args:
        source: a folder, or files found already.
        split: ``"train"``, ``"test"`` or None for both.
        sequences: names, or None for all.
        max_depth: range, m: 200 outdoors, 9 indoors.
        fov_deg: horizontal field of view, which the files do not say.
        on_error: ``"skip"`` leaves out broken sequences, and labels that cannot be read; warns of each.

    Raises:
        FileNotFoundError, ValueError: as :class:`nl_env.elidar.ExtrapolationData`.
    """

    def __init__(
        self,
        source: str | Path | ElidarFiles,
        *,
        split: str | None = None,
        sequences: Sequence[str] | None = None,
        max_depth: float = RANGE,
        fov_deg: float = 75.0,
        on_error: str = "raise",
    ) -> None:
        number("fov_deg", fov_deg, 20.0, 120.0)
        files = source if isinstance(source, ElidarFiles) else find_files(Path(source))
        self.data = ExtrapolationData(
            *files.require_pairs(), split=split, sequences=sequences, max_depth=max_depth, on_error=on_error
        )
        warn_of(self.data.problems)
        self.on_error = on_error
        self.episodes = tuple(
            Episode(name, walk, phase, rows[phase:])
            for name, pairs in self.data.sequences.items()
            for walk, rows in enumerate(find_walks(pairs, self.data.ticks[name]))
            for phase in range(min(PHASES, len(rows)))
        )
        self.camera = Camera.from_fov(*self.data.shape, fov_deg)
        self.lidar_period = LIDAR_PERIOD
        self.max_depth = self.data.max_depth
        self.slices = 0
        self.files = files
        self._episode: Episode | None = None
        self._raw: RawSequence | None = None
        self._index = 0
        if split is not None:
            self._warn_of_mixed_splits(split)

    def reset(self, seed: int) -> Sample:
        """Start episode ``seed`` and return sample 0, a LiDAR frame.

        Raises:
            ValueError: no such episode.
        """
        if not 0 <= seed < len(self.episodes):
            raise ValueError(f"seed: found {seed}, expected an episode from 0 to {len(self.episodes) - 1}")
        self.close()
        episode = self.episodes[seed]
        self._episode = episode
        self._raw = self._joined(episode.sequence)
        self.slices = len(episode.rows)
        self._index = 0
        frame = int(self.data.sequences[episode.sequence].prior[episode.rows[0]])
        return self._sample(episode, frame, 0, np.zeros((BINS, *self.camera.shape), np.int16))

    def advance(self) -> Sample:
        """Read the next step; raises ``RuntimeError`` before ``reset`` or past the last sample."""
        episode = self._running()
        if self._index == self.slices:
            raise RuntimeError(f"the sequence ended at slice {self.slices}; call reset(seed) for another")
        pairs = self.data.sequences[episode.sequence]
        row = episode.rows[self._index]
        bins = self._bins(episode.sequence, int(pairs.events_id[row]))
        self._index += 1
        return self._sample(episode, int(pairs.truth[row]), int(pairs.duration[row]), bins)

    def intensity(self) -> NDArray[np.float32]:
        """``(H, W)`` float32, an even grey: ELiDAR holds no pictures."""
        self._running()
        return np.full(self.camera.shape, 0.5, np.float32)

    def describe(self) -> dict[str, Any]:
        """Sequence, chain, phase, and whether labels are joined, JSON-ready."""
        episode = self._running()
        return {
            "sequence": episode.sequence,
            "walk": episode.walk,
            "phase": episode.phase,
            "split": self.data.sequences[episode.sequence].split,
            "labels": self._raw is not None,
        }

    @property
    def times_us(self) -> list[int]:
        """Time of every sample of the running episode, us since the start of its sequence."""
        episode = self._running()
        pairs, ticks = self.data.sequences[episode.sequence], self.data.ticks[episode.sequence]
        frames = [pairs.prior[episode.rows[0]], *pairs.truth[episode.rows]]
        return [int(ticks[frame]) * TICK_US for frame in frames]

    def close(self) -> None:
        """Close the files; may be called twice."""
        self.data.close()
        if self._raw is not None:
            self._raw.close()
        self._raw = None
        self._episode = None

    def _running(self) -> Episode:
        if self._episode is None:
            raise RuntimeError("no sequence is running; call reset(seed) first")
        return self._episode

    def _bins(self, sequence: str, events_id: int) -> NDArray[np.int16]:
        """A stored grid as counts; ``ValueError`` where it is not whole numbers of events."""
        grid = self.data.voxel(sequence, events_id)
        bins = np.clip(np.rint(grid), -32_768, 32_767).astype(np.int16)
        if not np.array_equal(bins, grid):
            raise ValueError(
                f"{self.data.path}: {sequence}/events[{events_id}]: found values that are not whole numbers "
                f"({grid.min()} to {grid.max()}), expected signed sums of events"
            )
        return bins

    def _sample(self, episode: Episode, frame: int, duration: int, bins: NDArray[np.int16]) -> Sample:
        tick = int(self.data.ticks[episode.sequence][frame])
        depth = self.data.depth(episode.sequence, frame)
        return Sample(
            index=self._index,
            t=tick * TICK_US,
            bins=bins,
            event_frame=np.add.reduce(bins, axis=0, dtype=np.int16),
            event_count=int(np.abs(bins.astype(np.int64)).sum()),
            depth=depth,
            lidar=depth if self._index % self.lidar_period == 0 else None,
            state=self._state(tick - duration, tick),
        )

    def _state(self, start: int, tick: int) -> EgoState:
        """Ego state at ``tick``, with the actors new since ``start``."""
        speed, distance, new_actors = UNKNOWN_SPEED, float("inf"), 0
        if self._raw is not None:
            last = min(tick // TICKS_PER_SLICE, len(self._raw))  # raw slice k ends at tick 4 (k + 1)
            k = max(last - 1, 0)
            speed, distance = float(self._raw.ego_speed[k]), float(self._raw.shortest_distance[k])
            new_actors = int(self._raw.new_actors[start // TICKS_PER_SLICE : last].sum())
        return EgoState(np.full((4, 4), np.nan), np.full(6, np.nan), speed, distance, new_actors)

    def _joined(self, sequence: str) -> RawSequence | None:
        """The raw sequence, if there is one and its event frames are those of the voxel grids."""
        if sequence not in self.files.raw:
            return None
        try:
            raw = RawSequence(self.files.raw[sequence])
        except ValueError as error:
            if self.on_error == "raise":
                raise
            warnings.warn(f"{sequence} has no labels: {error}", stacklevel=2)
            return None
        pairs = self.data.sequences[sequence]
        starts = self.data.ticks[sequence][pairs.prior]
        aligned = np.flatnonzero((pairs.duration == TICKS_PER_SLICE) & (starts % TICKS_PER_SLICE == 0))
        for row in aligned[:MATCHED_GRIDS].tolist():
            k = int(starts[row]) // TICKS_PER_SLICE
            frame = self.data.voxel(sequence, int(pairs.events_id[row])).sum(axis=0)
            if k >= len(raw) or raw.shape != frame.shape or not np.array_equal(raw.frame(k), frame):
                warnings.warn(
                    f"{raw.path}: slice {k} is not the voxel grid of the same 20 ms in {self.data.path}; "
                    "the two are not joined",
                    stacklevel=2,
                )
                return None
        return raw

    def _warn_of_mixed_splits(self, split: str) -> None:
        """Say which sequences of ``split`` the slicing release puts into the other split."""
        other = "train" if split == "test" else "test"
        if other not in self.files.lists:
            return
        mixed = sorted(set(self.data.sequences) & set(read_sequence_list(self.files.lists[other])))
        if mixed:
            warnings.warn(
                f"{len(mixed)} of the {split} sequences are {other} sequences of the slicing release: an "
                f"end-to-end evaluation must leave them out or say so: {', '.join(mixed)}",
                stacklevel=3,
            )
