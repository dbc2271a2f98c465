"""Replays recordings as the stream they were recorded from, bit for bit."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.config import DrivingConfig, LidarConfig
from nl_env.recording import Recording
from nl_env.sensors.lidar import Lidar
from nl_env.types import SLICE_US, EgoState, Sample


class RecordedSample(Sample):
    """A sample whose bins are read when somebody asks for them."""

    _recording: Recording

    def __init__(
        self,
        recording: Recording,
        index: int,
        depth: NDArray[np.float32],
        lidar: NDArray[np.float32] | None,
        state: EgoState,
    ) -> None:
        self.__dict__.update(  # past the frozen fields
            _recording=recording,
            index=index,
            t=index * SLICE_US,
            event_frame=recording.event_frame(index),
            event_count=recording.event_count(index),
            depth=depth,
            lidar=lidar,
            state=state,
        )

    @cached_property
    def bins(self) -> NDArray[np.int16]:
        """``(5, H, W)`` int16, signed event sums in the five 4 ms bins of ``[t - SLICE_US, t)``."""
        return self._recording.bins(self.index)


class RecordingStream:
    """Recorded sequences, one sample per 20 ms slice; a :class:`nl_env.types.SensorStream`.

    Samples equal those of ``SyntheticStream(config)`` in every bit. All files must have been recorded with
    one configuration. Files are opened when their sequence starts.

    Args:
        source: a recording, several, or a folder: of recordings, or as ``scripts/record.py`` writes it.
        lidar: another LiDAR rate or beam pattern than the recorded one; the range must be the same.

    Raises:
        FileNotFoundError: no such file, or a folder without recordings.
        ValueError: a damaged file, two recordings of one seed, or a LiDAR of another range.
    """

    def __init__(self, source: str | Path | Iterable[str | Path], lidar: LidarConfig | None = None) -> None:
        self._files = _files_by_seed(source)
        with Recording(next(iter(self._files.values()))) as first:
            self._recorded = first.config
        self.config = self._recorded if lidar is None else replace(self._recorded, lidar=lidar)
        if self.config.lidar.max_depth != self._recorded.lidar.max_depth:
            raise ValueError(
                f"lidar: found a range of {self.config.lidar.max_depth} m, "
                f"expected the recorded {self._recorded.lidar.max_depth} m"
            )
        self.camera = self.config.camera
        self.slices = self.config.scene.slices
        self.lidar_period = self.config.lidar.period
        self.max_depth = self.config.lidar.max_depth
        self._lidar = Lidar(self.config.lidar, self.camera)
        self._recording: Recording | None = None
        self._index = 0

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seeds of the recorded sequences, ascending."""
        return tuple(self._files)

    @property
    def files(self) -> dict[int, Path]:
        """Files of the recorded sequences by ascending seed."""
        return dict(self._files)

    def reset(self, seed: int) -> Sample:
        """Start the recording of ``seed`` and return sample 0.

        Raises:
            ValueError: no recording of that seed, or a damaged file, or one of another configuration.
        """
        if seed not in self._files:
            seeds = self.seeds
            raise ValueError(
                f"seed: found {seed}, expected one of the {len(seeds)} recorded sequences "
                f"({seeds[0]} to {seeds[-1]}, from {self._files[seeds[0]].parent})"
            )
        self.close()
        recording = Recording(self._files[seed])
        _check(recording, seed, self._recorded)
        self._recording = recording
        self._index = 0
        return self._sample(recording)

    def advance(self) -> Sample:
        """Read the next 20 ms; raises ``RuntimeError`` before ``reset`` or past the last sample."""
        recording = self._running()
        if self._index == self.slices:
            raise RuntimeError(f"the sequence ended at slice {self.slices}; call reset(seed) for another")
        self._index += 1
        return self._sample(recording)

    def intensity(self) -> NDArray[np.float32]:
        """``(H, W)`` float32 in [0, 1], the recorded 8-bit picture; ``ValueError`` if there is none."""
        return self._running().intensity(self._index).astype(np.float32) / np.float32(255)

    def describe(self) -> dict[str, Any]:
        """Scenario, style, weather and seed of the running sequence, JSON-ready."""
        return self._running().description

    def close(self) -> None:
        """Close the file; may be called twice."""
        if self._recording is not None:
            self._recording.close()
        self._recording = None

    def _running(self) -> Recording:
        if self._recording is None:
            raise RuntimeError("no sequence is running; call reset(seed) first")
        return self._recording

    def _sample(self, recording: Recording) -> Sample:
        k = self._index
        depth = recording.depth(k * SLICE_US)
        lidar = self._lidar.measure(depth) if k % self.lidar_period == 0 else None
        return RecordedSample(recording, k, depth, lidar, recording.state(k))


def _check(recording: Recording, seed: int, config: DrivingConfig) -> None:
    if recording.seed != seed:
        raise ValueError(f"{recording.path}: found the sequence of seed {recording.seed}, expected {seed}")
    if recording.config != config:
        raise ValueError(
            f"{recording.path}: found the configuration {recording.config}, "
            f"expected that of the other files, {config}"
        )


def _files_by_seed(source: str | Path | Iterable[str | Path]) -> dict[int, Path]:
    """Recordings by ascending seed; the name of the file gives it, or else its content."""
    files: dict[int, Path] = {}
    for path in _paths(source):
        if path.stem.isdecimal():
            seed = int(path.stem)
        else:
            with Recording(path) as recording:
                seed = recording.seed
        if seed in files:
            raise ValueError(f"{path}: found a second recording of seed {seed}, beside {files[seed]}")
        files[seed] = path
    return dict(sorted(files.items()))


def _paths(source: str | Path | Iterable[str | Path]) -> list[Path]:
    if not isinstance(source, (str, Path)):
        paths = [Path(path) for path in source]
        if not paths:
            raise ValueError("source: found no files, expected at least one recording")
        return paths
    path = Path(source)
    if not path.is_dir():
        return [path]
    folder = path / "sequences" if (path / "sequences").is_dir() else path
    paths = sorted(file for file in folder.glob("*.h5") if not file.name.startswith("."))
    if not paths:
        raise FileNotFoundError(f"{folder}: found no *.h5 file, expected recordings")
    return paths
