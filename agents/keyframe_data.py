"""Event frames, keyframe labels and what causes them, cut out of recordings to train and judge detectors.

Every slice of a recording becomes one row of an uncompressed file per sequence, so that training reads any
run of slices through a memory map.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.actor_maps import actor_maps, grid
from agents.keyframe_networks import CAUSES, MOTIONS, RANGES
from nl_env.config import DrivingConfig, from_dict
from nl_env.recording import Recording
from nl_env.representations import event_frame
from nl_env.runs import SETTINGS_FILE, open_folder, run_sequences
from nl_env.types import SLICE_US

MANIFEST = "manifest.json"
"""Beside the recordings: what there is, written when all of it is finished."""

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
        workers: processes of one thread each; the files do not depend on it.
        progress: called with the number of newly finished sequences.

    Raises:
        FileNotFoundError: no manifest: nothing recorded there, or not finished.
        ValueError: ``folder`` holds slices of other recordings, or a recording is damaged.
        OSError: ``folder`` cannot be written.
    """
    path = recordings / MANIFEST
    if not path.is_file():
        raise FileNotFoundError(
            f"recordings: found no {MANIFEST} in {str(recordings)!r}; record.py writes it"
        )
    text = path.read_bytes()
    manifest = json.loads(text)
    seeds = [int(seed) for seed in manifest["seeds"]]
    entries = {int(entry["seed"]): entry for entry in manifest["sequences"]}
    identity = {
        "manifest_sha256": hashlib.sha256(text).hexdigest(),
        "split": manifest["split"],
        "seeds": seeds,
        "weathers": [entries[seed]["description"]["weather"] for seed in seeds],
        "config": manifest["config"],
    }
    files = {seed: recordings / entry["file"] for seed, entry in entries.items()}
    checkpoints = open_folder(folder, identity, resume=True)
    run_sequences(
        _CutSequence(files),
        _Cut.load,
        seeds,
        checkpoints,
        workers=workers,
        suffix=".npy",
        progress=progress,
    )
    return Slices(folder)


class Slices:
    """The slices that :func:`build_slices` cut: sequences of equal length, read from disk as needed.

    Files are mapped at the first access, once per process; pickling carries the path alone.

    Args:
        folder: as given to :func:`build_slices`.

    Raises:
        FileNotFoundError: ``folder`` holds no slices.
        ValueError: a file that is truncated or holds something else (at its first access).
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        marker = self.folder / SETTINGS_FILE
        if not marker.is_file():
            raise FileNotFoundError(f"slices: found no {SETTINGS_FILE} in {str(self.folder)!r}")
        self.identity: dict[str, Any] = json.loads(marker.read_text(encoding="utf-8"))
        config = from_dict(DrivingConfig, self.identity["config"])
        self.shape = config.camera.shape
        self.length = config.scene.slices
        self.seeds: list[int] = self.identity["seeds"]
        self.weathers: list[str] = self.identity["weathers"]
        self._sequences: dict[int, NDArray[np.void]] = {}

    def __len__(self) -> int:
        """Number of sequences."""
        return len(self.seeds)

    def sequence(self, number: int) -> NDArray[np.void]:
        """``(length,)`` rows of :func:`slice_dtype`, mapped from the file."""
        if number not in self._sequences:
            path = self.folder / "sequences" / f"{self.seeds[number]}.npy"
            found = _Cut.load(path).rows
            expected = slice_dtype(self.shape)
            if found.dtype != expected or found.shape != (self.length,):
                raise ValueError(
                    f"slices: found {found.shape} of other contents in {str(path)!r}, "
                    f"expected {(self.length,)} slices of {self.shape}"
                )
            self._sequences[number] = found
        return self._sequences[number]

    def causes(self, number: int) -> NDArray[np.bool_]:
        """``(length, 3)`` bool, the causes of every slice: speed, distance, new."""
        rows = self.sequence(number)
        return np.stack([rows["speed"], rows["distance"], rows["new"]], axis=1)

    def __getstate__(self) -> dict[str, Any]:
        return {"folder": self.folder}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["folder"])  # type: ignore[misc]


@dataclass(frozen=True)
class _Cut:
    """The slices of one sequence and their file."""

    rows: NDArray[np.void]

    def save(self, path: Path) -> None:
        """Write uncompressed."""
        np.save(path, self.rows, allow_pickle=False)

    @classmethod
    def load(cls, path: Path) -> _Cut:
        """Map what :meth:`save` wrote."""
        try:
            return cls(np.load(path, mmap_mode="r", allow_pickle=False))
        except FileNotFoundError:
            raise
        except (ValueError, EOFError, OSError) as cause:
            raise ValueError(f"slices: found no whole array in {str(path)!r} ({cause})") from cause


@dataclass(frozen=True)
class _CutSequence:
    """The work of one process."""

    files: dict[int, Path]

    def __call__(self, seed: int) -> _Cut:
        """Cut the sequence of ``seed``."""
        with Recording(self.files[seed]) as recording:
            return _Cut(cut_slices(recording))
