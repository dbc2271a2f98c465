"""Stored traces in place of sensors and extrapolator: the same observations and errors, no depth frames."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from nl_env.config import LidarConfig
from nl_env.observations import IMAGE_OFFSET
from nl_env.trace_files import open_trace, read_source, trace_files
from nl_env.trace_source import ExtrapolatorIdentity, TraceSource, file_digest
from nl_env.traces import SequenceTrace
from nl_env.types import SLICE_US, Camera, EgoState, Sample


class TraceFolder:
    """The stored traces of some recordings, refused where they are of anything else.

    What all traces have in common is checked at once, the recording of each when it is first opened. Copies
    sent to other processes open the files anew.

    Args:
        folder: as ``scripts/precompute.py`` writes it.
        recordings: files of the recordings by seed.
        extrapolator: that must have made the traces.
        lidar: that must have been used.
        min_depth: of the full-image metrics, m.

    Raises:
        FileNotFoundError: no such folder, or no trace of a recording.
        ValueError: a trace that is damaged, or of another extrapolator or LiDAR.
    """

    def __init__(
        self,
        folder: Path,
        recordings: Mapping[int, Path],
        extrapolator: ExtrapolatorIdentity,
        lidar: LidarConfig,
        min_depth: float = 1.0,
    ) -> None:
        self.folder = folder
        self._recordings = dict(recordings)
        files = trace_files(folder)
        missing = [seed for seed in recordings if seed not in files]
        if missing:
            raise FileNotFoundError(
                f"tables: found no trace of {len(missing)} of {len(recordings)} recordings in {folder} "
                f"(such as {missing[0]}); make them with scripts/precompute.py --resume"
            )
        self._files = {seed: files[seed] for seed in recordings}
        self._expected = TraceSource.of("", extrapolator, lidar, min_depth)
        for path in self._files.values():
            source = read_source(path)
            replace(self._expected, recording=source.recording).check(source, path)
        self._opened: dict[int, SequenceTrace] = {}

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seeds of the recordings."""
        return tuple(self._files)

    def __getitem__(self, seed: int) -> SequenceTrace:
        """The trace of ``seed``; raises ``ValueError`` if its recording changed since, or it is damaged."""
        if seed not in self._opened:
            expected = replace(self._expected, recording=file_digest(self._recordings[seed]))
            self._opened[seed] = open_trace(self._files[seed], expected)
        return self._opened[seed]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": {}}


class TraceSample(Sample):
    """What a trace knows of a sample; asking it for a depth frame or the bins raises ``RuntimeError``.

    Event sums are clipped to [-128, 127], as observations show them. Poses are NaN.
    """

    _traces: TraceFolder  # not the trace itself: copies sent to other processes open it anew
    _seed: int

    def __init__(self, traces: TraceFolder, seed: int, index: int) -> None:
        trace = traces[seed]
        state = EgoState(
            np.full((4, 4), np.nan),
            np.full(6, np.nan),
            float(trace.ego_speed[index]),
            float(trace.shortest_distance[index]),
            int(trace.new_actors[index]),
        )
        self.__dict__.update(  # past the frozen fields
            _traces=traces,
            _seed=seed,
            index=index,
            t=index * SLICE_US,
            event_count=int(trace.event_count[index]),
            state=state,
        )

    @cached_property
    def event_frame(self) -> NDArray[np.int16]:
        """``(H, W)`` int16, the event frame as far as the observation shows it."""
        return self._traces[self._seed].images[self.index].astype(np.int16) - np.int16(IMAGE_OFFSET)

    @property
    def active_fraction(self) -> float:
        """Share of pixels whose event frame is not zero."""
        return float(self._traces[self._seed].active_fraction[self.index])

    @property
    def has_lidar(self) -> bool:
        """Whether a LiDAR frame arrives."""
        return bool(self._traces[self._seed].lidar[self.index])

    @property
    def bins(self) -> NDArray[np.int16]:
        """Not stored."""
        no_frames("bins")

    @property
    def depth(self) -> NDArray[np.float32]:
        """Not stored."""
        no_frames("depth")

    @property
    def lidar(self) -> NDArray[np.float32] | None:
        """Not stored."""
        no_frames("lidar")


class TraceStream:
    """Replays stored traces slice by slice, as :class:`nl_env.types.SensorStream`, without depth frames.

    Args:
        traces: of the recordings to replay.
        camera, max_depth: of the recordings.
        slices: index of the last slice of every recording.
        lidar_period: slices between LiDAR frames.
    """

    def __init__(
        self, traces: TraceFolder, camera: Camera, max_depth: float, slices: int, lidar_period: int
    ) -> None:
        self.traces = traces
        self.camera = camera
        self.max_depth = max_depth
        self.slices = slices
        self.lidar_period = lidar_period
        self._seed: int | None = None
        self._index = 0

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seeds of the recordings."""
        return self.traces.seeds

    @property
    def trace(self) -> SequenceTrace:
        """Of the running sequence; raises ``RuntimeError`` before ``reset``."""
        if self._seed is None:
            raise RuntimeError("no sequence is running; call reset(seed) first")
        return self.traces[self._seed]

    def reset(self, seed: int) -> Sample:
        """Start the trace of ``seed`` and return sample 0; ``ValueError`` where there is none."""
        self.open(seed)
        self._seed, self._index = seed, 0
        return TraceSample(self.traces, seed, 0)

    def open(self, seed: int) -> SequenceTrace:
        """The trace of ``seed``; raises ``ValueError`` where there is none, or of another size."""
        if seed not in self.traces.seeds:
            seeds = self.seeds
            raise ValueError(
                f"seed: found {seed}, expected one of the {len(seeds)} recorded sequences "
                f"({seeds[0]} to {seeds[-1]}, from {self.traces.folder})"
            )
        trace = self.traces[seed]
        found = (trace.slices, *trace.images.shape[1:], trace.lidar_period)
        expected = (self.slices, *self.camera.shape, self.lidar_period)
        if found != expected:
            raise ValueError(
                f"{self.traces.folder}: found a trace of seed {seed} with (slices, H, W, LiDAR period) "
                f"{found}, expected {expected} as the recordings have; precompute it again"
            )
        return trace

    def advance(self) -> Sample:
        """The next slice; raises ``RuntimeError`` before ``reset`` or past the last sample."""
        if self._seed is None:
            raise RuntimeError("no sequence is running; call reset(seed) first")
        if self._index == self.slices:
            raise RuntimeError(f"the sequence ended at slice {self.slices}; call reset(seed) for another")
        self._index += 1
        return TraceSample(self.traces, self._seed, self._index)

    def intensity(self) -> NDArray[np.float32]:
        """Not stored."""
        no_frames("intensity")

    def describe(self) -> dict[str, Any]:
        """Scenario, style, weather and seed of the running sequence, JSON-ready."""
        return dict(self.trace.description)

    def close(self) -> None:
        """Stop the sequence; may be called twice."""
        self._seed = None


class TabulatedDepth:
    """A :class:`nl_env.held_depth.HeldDepth` that looks the errors up in the traces of ``stream``.

    Args:
        stream: whose samples are settled.
        metrics: the metrics that are wanted.
    """

    def __init__(self, stream: TraceStream, metrics: Iterable[str]) -> None:
        self._stream = stream
        self._metrics = tuple(metrics)

    @property
    def depth(self) -> NDArray[np.float32]:
        """Not stored."""
        no_frames("depth")

    @property
    def prior(self) -> NDArray[np.float32]:
        """Not stored."""
        no_frames("prior_depth")

    def start(self) -> None:
        """Nothing to forget."""

    def settle(self, sample: Sample, triggered: bool, age: int) -> Mapping[str, float]:
        """The errors at ``sample``'s slice of the frame made ``age`` slices before."""
        errors = self._stream.trace.errors
        return {name: float(errors[name][sample.index, age]) for name in self._metrics}


def no_frames(what: str) -> NoReturn:
    """Raise the error of whoever asks a stored trace for a frame."""
    raise RuntimeError(
        f"{what}: stored traces hold errors and event frames, no {what}; "
        "make the environment with errors='compute'"
    )
