"""Event frames, keyframe labels and what causes them, cut out of recordings to train and judge detectors.

Every slice of a recording becomes one row of an uncompressed file per sequence, so that training reads any
run of slices through a memory map.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from agents.actor_maps import actor_maps, grid
from agents.keyframe_networks import CAUSES, MOTIONS, RANGES
from nl_env.config import DrivingConfig, from_dict
from nl_env.recording import Recording
from nl_env.recording.cut_set import CutSet, cut
from nl_env.recording.manifest import read_manifest
from nl_env.representations import event_frame
from nl_env.types import SLICE_US

COUNT_LIMIT = 127
"""Frames are stored as int8, and the environment's image cuts them at the same place. No pixel of the
synthetic sensors came near it in 20 ms."""


def slice_dtype(shape: tuple[int, int]) -> np.dtype[np.void]:
    """One slice of sensors of ``shape`` (H, W).

    ``frame``: event frame (Eq. 1); ``lidar``: a LiDAR frame arrives; ``speed``, ``distance``, ``new``: the
    causes of a keyframe; ``actors``: :func:`agents.actor_maps.actor_maps`; ``motion``: ego speed, 10 m/s, and
    yaw rate, 0.5 rad/s, to the right.
    """
    return np.dtype(
        [
            ("frame", "<i1", shape),
            *((name, "?") for name in ("lidar", *CAUSES)),
            ("actors", "?", (len(RANGES), *grid(shape))),
            ("motion", "<f4", (len(MOTIONS),)),
        ]
    )


def cut_slices(recording: Recording) -> NDArray[np.void]:
    """Slices 1..K of a recording, ``(K,)`` of :func:`slice_dtype`."""
    rows = np.zeros(recording.slices, slice_dtype(recording.camera.shape))
    for k, row in enumerate(rows, start=1):
        window = (k - 1) * SLICE_US, k * SLICE_US
        frame = event_frame(recording.events(*window), recording.camera.shape, *window)
        row["frame"] = np.clip(frame, -COUNT_LIMIT, COUNT_LIMIT)
        row["motion"] = recording.speed[k] / 10, recording.twist(k * SLICE_US)[4] / 0.5
    rows["lidar"] = np.arange(1, len(rows) + 1) % recording.lidar_period == 0
    rows["speed"] = recording.keyframe_speed[1:]
    rows["distance"] = recording.keyframe_distance[1:]
    rows["new"] = recording.keyframe_new[1:]
    rows["actors"] = actor_maps(recording)
    return rows


def build_slices(
    recordings: Path,
    folder: Path,
    *,
    workers: int = 0,
    progress: Callable[[int], None] = lambda finished: None,
) -> Slices:
    """Cut all recordings of a folder, or those that are missing.

    Args:
        recordings: output of ``scripts/record.py``.
        folder: where the slices go. One that holds these slices already is only opened.
        workers, progress: as :func:`nl_env.recording.cut_set.cut`.

    Raises:
        FileNotFoundError: no manifest: nothing recorded there, or not finished.
        ValueError: ``folder`` holds slices of other recordings, or a recording is damaged.
        OSError: ``folder`` cannot be written.
    """
    manifest = read_manifest(recordings)
    identity = {
        "manifest_sha256": manifest.sha256,
        "split": manifest.split,
        "seeds": list(manifest.entries),
        "weathers": [entry["description"]["weather"] for entry in manifest.entries.values()],
        "config": manifest.content["config"],
    }
    cut(folder, identity, _CutSlices(manifest.files), workers=workers, progress=progress)
    return Slices(folder)


class FrameSource(Protocol):
    """Sequences of labelled event frames, as the training of detectors takes them; ``len`` counts sequences.

    Attributes:
        shape: ``(H, W)``.
        length: slices of every sequence.
        seeds, weathers: of the sequences.
    """

    shape: tuple[int, int]
    length: int
    seeds: list[int]
    weathers: list[str]

    def __len__(self) -> int: ...

    def frames(self, number: int) -> Any:
        """Event frames of a sequence: a slice of it is ``(n, H, W)`` int8, and it has a length."""
        ...

    def causes(self, number: int) -> NDArray[np.bool_]:
        """``(length, 3)`` bool, the causes of every slice, or ``(length, 1)``, the label alone."""
        ...

    def lidar(self, number: int) -> NDArray[np.bool_]:
        """``(length,)`` bool, slices with a LiDAR frame."""
        ...

    @property
    def summary(self) -> dict[str, Any]:
        """Where they are from, for cards: JSON-ready."""
        ...


class MappedSlices(FrameSource):
    """A :class:`FrameSource` of rows of :func:`slice_dtype`, which also hold what a frame shows."""

    @abstractmethod
    def sequence(self, number: int) -> NDArray[Any]:
        """``(length,)`` rows of a sequence."""

    def frames(self, number: int) -> NDArray[np.int8]:
        """``(length, H, W)``, mapped from the file."""
        return np.asarray(self.sequence(number)["frame"])

    def lidar(self, number: int) -> NDArray[np.bool_]:
        """As :class:`FrameSource`."""
        return np.array(self.sequence(number)["lidar"])

    def causes(self, number: int) -> NDArray[np.bool_]:
        """``(length, 3)`` bool, the causes of every slice: speed, distance, new."""
        rows = self.sequence(number)
        return np.stack([rows["speed"], rows["distance"], rows["new"]], axis=1)


class Slices(CutSet, MappedSlices):
    """The slices that :func:`build_slices` cut: sequences of equal length, read from disk as needed.

    A :class:`FrameSource`; ``sequence`` gives ``(length,)`` rows of :func:`slice_dtype`.
    Errors as :class:`nl_env.recording.cut_set.CutSet`.
    """

    what = "slices"

    def __init__(self, folder: str | Path) -> None:
        super().__init__(folder)
        config = from_dict(DrivingConfig, self.identity["config"])
        self.shape = config.camera.shape
        self.length = config.scene.slices
        self.weathers: list[str] = self.identity["weathers"]

    def __len__(self) -> int:
        """Number of sequences."""
        return len(self.seeds)

    def expected(self, number: int) -> tuple[np.dtype[Any], tuple[int, ...]]:
        """Sequences of one length."""
        return slice_dtype(self.shape), (self.length,)

    @property
    def settings(self) -> dict[str, Any]:
        """What slices that are learnt from together have in common: split and generator configuration."""
        return {"split": self.identity["split"], **self.identity["config"]}

    @property
    def summary(self) -> dict[str, Any]:
        """As :class:`FrameSource`."""
        return {
            "split": self.identity["split"],
            "sequences": len(self),
            "slices": self.length,
            "first_seed": self.seeds[0],
            "manifest_sha256": self.identity["manifest_sha256"],
        }


class JoinedSlices(MappedSlices):
    """The slices of several folders, one after the other; a :class:`FrameSource`.

    Args:
        parts: of one split and one generator configuration, without a sequence in common.

    Raises:
        ValueError: no parts, or one that does not fit to the first; the message names its folder.
    """

    def __init__(self, parts: Sequence[Slices]) -> None:
        if not parts:
            raise ValueError("slices: found no folder, expected at least one")
        first, known = parts[0], set[int]()
        for part in parts:
            for key, expected in first.settings.items():
                if (found := part.settings.get(key)) != expected:
                    raise ValueError(
                        f"slices: found {key} {found} in {str(part.folder)!r}, "
                        f"expected {expected} as in {str(first.folder)!r}"
                    )
            if again := known.intersection(part.seeds):
                raise ValueError(
                    f"slices: found sequence {min(again)} in {str(part.folder)!r}, "
                    "expected sequences that no other folder holds"
                )
            known.update(part.seeds)
        self.parts = tuple(parts)
        self.shape = first.shape
        self.length = first.length
        self.seeds = [seed for part in parts for seed in part.seeds]
        self.weathers = [weather for part in parts for weather in part.weathers]
        self._places = [(part, number) for part in parts for number in range(len(part))]

    def __len__(self) -> int:
        """Number of sequences."""
        return len(self._places)

    def sequence(self, number: int) -> NDArray[Any]:
        """As :class:`MappedSlices`."""
        part, within = self._places[number]
        return part.sequence(within)

    @property
    def summary(self) -> dict[str, Any]:
        """That of each part, and how many sequences they are together; of one part, its own."""
        if len(self.parts) == 1:
            return self.parts[0].summary
        return {
            "split": self.parts[0].settings["split"],
            "sequences": len(self),
            "slices": self.length,
            "folders": [part.summary for part in self.parts],
        }


@dataclass(frozen=True)
class _CutSlices:
    """The work of one process."""

    files: Mapping[int, Path]

    def __call__(self, seed: int) -> NDArray[np.void]:
        """Cut the sequence of ``seed``."""
        with Recording(self.files[seed]) as recording:
            return cut_slices(recording)
