"""ELiDAR's extrapolation pairs as examples to learn from, read one by one.

The release has neither poses nor a LiDAR frame before the prior. The time line has other depth frames, and
the one nearest to 100 ms before the prior stands for it (:func:`nl_env.elidar.previous_frame`); where there
is none, as at the start of a sequence, no motion is known, and the network sees the prior and the events
alone. Between the two frames the motion is what ICP finds, which needs the field of view that the files do
not say; it takes longer than reading a pair, so it is found once and kept in a cut set.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.config import choice, number
from nl_env.depth.examples import Example
from nl_env.depth.features import Scene
from nl_env.depth.motion import continued, estimate_motion
from nl_env.elidar import ElidarFiles, ExtrapolationData, previous_frame
from nl_env.elidar.layout import RANGE
from nl_env.elidar.metadata import ON_ERROR, warn_of
from nl_env.recording.cut_set import CutSet, cut
from nl_env.types import TICK_US, Camera

VERSION = 1
"""Changes with how the motion is estimated and with which frame is the previous one."""


@dataclass(frozen=True)
class ElidarOptions:
    """How the extrapolation release is read. Invalid values raise ``ValueError``."""

    held_out: float = 0.1
    """Share of the training sequences that choose the best weights; the release has no validation split."""
    fov: float = 75.0
    """Horizontal field of view, degrees, which the files do not say."""
    max_depth: float = RANGE
    """Range, m: 200 outdoors, 9 indoors."""
    on_error: str = "raise"
    """raise, or skip: broken sequences are left out, with a warning for each."""

    def __post_init__(self) -> None:
        number("held_out", self.held_out, 0.001, 0.5)
        number("fov", self.fov, 20.0, 120.0)
        number("max_depth", self.max_depth, 0.1, 10_000.0)
        choice("on_error", self.on_error, ON_ERROR)


def held_out(names: Sequence[str], share: float) -> list[str]:
    """``share`` of the names, evenly spread, at least one.

    Raises:
        ValueError: fewer than two names.
    """
    if len(names) < 2:
        raise ValueError(f"held_out: found {len(names)} training sequence, expected at least 2")
    count = max(1, round(share * len(names)))
    return [names[(2 * k + 1) * len(names) // (2 * count)] for k in range(count)]


class ElidarPairs:
    """A :class:`nl_env.depth.examples.PairSource` of ELiDAR's files; bounded memory, pickles as paths.

    Args:
        data: the pairs.
        fov_deg: horizontal field of view.
        motions: between previous frame and prior; None leaves the previous frames out, which the paper's
            network does not look at.
    """

    poses = False

    def __init__(self, data: ExtrapolationData, fov_deg: float, motions: LastMotions | None = None) -> None:
        self.data, self.motions = data, motions
        self.camera, self.max_depth = Camera.from_fov(*data.shape, fov_deg), data.max_depth
        self.gaps = len(np.unique(data.durations))

    @property
    def summary(self) -> dict[str, Any]:
        """Files and sequences, for cards: JSON-ready."""
        return {
            "release": "ELiDAR extrapolation",
            "file": self.data.path.name,
            "metadata_sha256": digest(self.data.metadata),
            "sequences": len(self.data.sequences),
            "names": list(self.data.sequences),
            "pairs": len(self),
            "max_depth": self.max_depth,
            "focal_length_px": self.camera.fx,
        }

    def __len__(self) -> int:
        return len(self.data)

    def example(
        self, index: int, motion: NDArray[np.float64] | None = None, *, odometry: bool = False
    ) -> Example:
        """As :meth:`nl_env.depth.examples.PairSource.example`; ``odometry`` is refused."""
        if odometry:
            raise ValueError("odometry: ELiDAR holds no poses, expected False")
        pair = self.data[index]
        name, row = self.data.place(index)
        ticks, frame = self.data.ticks[name], int(self.data.sequences[name].prior[row])
        before = None if self.motions is None else previous_frame(ticks, frame)
        last, previous = np.eye(4), None
        if before is not None and self.motions is not None:
            last, previous = np.array(self.motions.of(name)[frame]), self.data.depth(name, before)
        if motion is None:
            period = 1 if before is None else int(ticks[frame] - ticks[before])
            motion = continued(last, pair.duration / period)
        gap = pair.duration * TICK_US * 1e-6
        scene = Scene(self.camera, self.max_depth, pair.prior, previous, last, pair.voxel, gap)
        return Example(scene, motion, np.full((4, 4), np.nan), pair.truth)


class LastMotions(CutSet):
    """Motions between each depth frame and the one before, ``(frames, 4, 4)`` a sequence.

    Standing still where there is no frame before. Errors as :class:`nl_env.recording.cut_set.CutSet`.
    """

    what = "motions"

    def __init__(self, folder: str | Path) -> None:
        super().__init__(folder)
        self._numbers = {name: number for number, name in enumerate(self.identity["sequences"])}
        self._frames: list[int] = self.identity["frames"]

    def expected(self, number: int) -> tuple[np.dtype[Any], tuple[int, ...]]:
        """One motion for each depth frame."""
        return np.dtype(np.float64), (self._frames[number], 4, 4)

    def of(self, name: str) -> NDArray[np.float64]:
        """The motions of a sequence."""
        return self.sequence(self._numbers[name])


def find_last_motions(
    data: ExtrapolationData,
    fov_deg: float,
    folder: Path,
    *,
    workers: int = 0,
    progress: Callable[[int], None] = lambda finished: None,
) -> LastMotions:
    """Estimate the motions of all sequences of ``data``, or those that are missing in ``folder``.

    Raises:
        ValueError: ``folder`` holds motions of other data or another field of view, or damaged depth.
        OSError: ``folder`` cannot be written.
    """
    names = list(data.sequences)
    identity = {
        "version": VERSION,
        "metadata_sha256": digest(data.metadata),
        "hdf5_bytes": data.path.stat().st_size,
        "sequences": names,
        "frames": [len(data.ticks[name]) for name in names],
        "seeds": list(range(len(names))),
        "fov_deg": fov_deg,
        "max_depth": data.max_depth,
    }
    task = _Motions(data, tuple(names), Camera.from_fov(*data.shape, fov_deg))
    cut(folder, identity, task, workers=workers, progress=progress)
    return LastMotions(folder)


@dataclass(frozen=True)
class _Motions:
    """The work of one process."""

    data: ExtrapolationData
    names: tuple[str, ...]
    camera: Camera

    def __call__(self, number: int) -> NDArray[np.float64]:
        """Motions of one sequence; frames that are no prior are left standing still."""
        name, far = self.names[number], self.data.max_depth
        ticks = self.data.ticks[name]
        motions = np.tile(np.eye(4), (len(ticks), 1, 1))
        for frame in np.unique(self.data.sequences[name].prior).tolist():
            before = previous_frame(ticks, frame)
            if before is not None:
                old, new = (self.data.depth(name, k) for k in (before, frame))
                motions[frame] = estimate_motion(old, new, self.camera, far)
        return motions


def open_elidar_pairs(
    files: ElidarFiles,
    options: ElidarOptions,
    motions: Path | None = None,
    *,
    workers: int = 0,
    progress: Callable[[int], None] = lambda finished: None,
) -> tuple[ElidarPairs, ElidarPairs]:
    """Training pairs and held-out ones of the training split; the test split is left alone.

    Args:
        files: of the release.
        options: as they say.
        motions: folder of :func:`find_last_motions`; None does without.
        workers, progress: of the motions.

    Raises:
        FileNotFoundError, ValueError: as :class:`nl_env.elidar.ExtrapolationData`, or too few sequences.
    """
    hdf5, metadata = files.require_pairs()
    every = ExtrapolationData(
        hdf5, metadata, split="train", max_depth=options.max_depth, on_error=options.on_error
    )
    warn_of(every.problems)
    names = list(every.sequences)
    chosen = held_out(names, options.held_out)
    parts = ([name for name in names if name not in chosen], chosen)
    found = None
    if motions is not None:
        found = find_last_motions(every, options.fov, motions, workers=workers, progress=progress)
    training, validation = (
        ElidarPairs(
            ExtrapolationData(
                hdf5, metadata, sequences=part, max_depth=options.max_depth, on_error=options.on_error
            ),
            options.fov,
            found,
        )
        for part in parts
    )
    return training, validation


def digest(path: Path) -> str:
    """SHA-256 of a small file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
