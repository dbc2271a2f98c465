"""Trigger policies and depth extrapolators together on recorded sequences, one sequence at a time.

One pass of an extrapolator over a sequence gives the error of every schedule of triggers
(``nl_env.traces``), so schedules are kept apart from errors and combined afterwards.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.depth.metrics import METRIC_NAMES
from nl_env.evaluation import EpisodeRecord, play
from nl_env.recording_stream import RecordingStream
from nl_env.reproduction.gaps import Method
from nl_env.traces import SequenceTrace, trace_sequence
from nl_env.types import Sample, SensorStream

Schedule = NDArray[np.bool_]
"""``(K+1,)``: whether a policy triggers at each slice; no effect at slices with a LiDAR frame."""

Decide = Callable[[SequenceTrace], Mapping[str, Schedule]]
"""Plays trigger policies on a sequence; their decisions must not depend on the extrapolator."""

_COLUMNS = (
    "event_count",
    "active_fraction",
    "ego_speed",
    "shortest_distance",
    "new_actors",
    "keyframe",
    "keyframe_speed",
    "keyframe_distance",
    "keyframe_new",
    "lidar",
)


@dataclass(frozen=True)
class SequenceRun:
    """One sequence: what happened, when each policy triggers, and every extrapolator's errors.

    Attributes:
        seed: of the sequence.
        description: scenario, style, weather.
        lidar_period: slices between LiDAR frames.
        columns: the per-slice columns of the trace, ``(K+1,)`` each.
        schedules: by policy.
        errors: by extrapolator, ``(metrics, K+1, P)`` float64 as in ``SequenceTrace.errors``.
    """

    seed: int
    description: dict[str, Any]
    lidar_period: int
    columns: Mapping[str, Any]
    schedules: Mapping[str, Schedule]
    errors: Mapping[str, NDArray[np.float64]]

    @property
    def slices(self) -> int:
        """Index of the last slice (K)."""
        return len(self.columns["lidar"]) - 1

    @property
    def free(self) -> Schedule:
        """``(K+1,)``: slices after t = 0 without a LiDAR frame."""
        free = ~self.columns["lidar"]
        free[0] = False
        return free

    def play(self, policy: str, schedule: Schedule, extrapolator: str) -> EpisodeRecord:
        """What the consumer gets when ``extrapolator`` runs at the slices of ``schedule``."""
        tables = self.errors[extrapolator]
        trace = SequenceTrace(
            seed=self.seed,
            description=self.description,
            lidar_period=self.lidar_period,
            images=np.zeros((self.slices + 1, 1, 1), np.uint8),
            **self.columns,
            errors=dict(zip(METRIC_NAMES, tables, strict=True)),
        )
        return play(Scheduled(schedule), trace, policy)

    def save(self, path: Path) -> None:
        """Write everything to one ``.npz`` file (no pickle)."""
        header = {
            "seed": self.seed,
            "description": self.description,
            "lidar_period": self.lidar_period,
            "policies": list(self.schedules),
            "extrapolators": list(self.errors),
        }
        np.savez_compressed(
            path,
            header=np.array(json.dumps(header)),
            schedules=np.array(list(self.schedules.values())),
            errors=np.array(list(self.errors.values())),
            **self.columns,
        )

    @classmethod
    def load(cls, path: Path) -> SequenceRun:
        """Read what :meth:`save` wrote."""
        with np.load(path) as file:
            header = json.loads(str(file["header"]))
            return cls(
                seed=header["seed"],
                description=header["description"],
                lidar_period=header["lidar_period"],
                columns={name: file[name] for name in _COLUMNS},
                schedules=dict(zip(header["policies"], file["schedules"], strict=True)),
                errors=dict(zip(header["extrapolators"], file["errors"], strict=True)),
            )


class Scheduled:
    """A trigger policy that follows a schedule made before; its state counts slices."""

    def __init__(self, schedule: Schedule) -> None:
        self._schedule = schedule

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[int, int]:
        """Answer for the slice after the last one asked for."""
        index = 1 if state is None else state + 1
        return int(self._schedule[index]), index


class FirstSlices:
    """The beginning of another stream's sequences."""

    def __init__(self, stream: SensorStream, slices: int) -> None:
        self._stream = stream
        self._wanted = slices
        self.camera = stream.camera
        self.slices = min(slices, stream.slices)
        self.lidar_period = stream.lidar_period
        self.max_depth = stream.max_depth

    def reset(self, seed: int) -> Sample:
        """Start the sequence of ``seed``."""
        sample = self._stream.reset(seed)
        self.slices = min(self._wanted, self._stream.slices)
        return sample

    def advance(self) -> Sample:
        """Return the next sample."""
        return self._stream.advance()

    def intensity(self) -> NDArray[np.float32]:
        """As the stream's own."""
        return self._stream.intensity()

    def describe(self) -> dict[str, Any]:
        """As the stream's own."""
        return self._stream.describe()

    def close(self) -> None:
        """Close the stream."""
        self._stream.close()


@dataclass(frozen=True)
class EndToEndTask:
    """The work of one process: one recorded sequence with every extrapolator.

    Attributes:
        files: recording of each sequence seed.
        methods: the extrapolators, by their rows.
        decide: plays the policies.
        slices: length that sequences are cut to, or None.
    """

    files: Mapping[int, Path]
    methods: tuple[Method, ...]
    decide: Decide
    slices: int | None = None

    def __call__(self, seed: int) -> SequenceRun:
        """Run the sequence of ``seed``."""
        recording = RecordingStream([self.files[seed]])
        stream = recording if self.slices is None else FirstSlices(recording, self.slices)
        errors: dict[str, NDArray[np.float64]] = {}
        trace: SequenceTrace | None = None
        for method in self.methods:
            latest = trace_sequence(stream, method.make(), seed)
            errors[method.row] = np.array([latest.errors[name] for name in METRIC_NAMES])
            trace = trace or latest
        stream.close()
        assert trace is not None
        return SequenceRun(
            seed=seed,
            description=trace.description,
            lidar_period=trace.lidar_period,
            columns={name: getattr(trace, name) for name in _COLUMNS},
            schedules=self.decide(trace),
            errors=errors,
        )
