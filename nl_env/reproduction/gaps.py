"""Error of depth extrapolators at the paper's five gaps, on one recorded sequence at a time.

A pair is a LiDAR frame, the one before it, the events since, and the true depth one gap later.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.config import choice
from nl_env.depth.extrapolators import make_extrapolator
from nl_env.depth.metrics import METRIC_NAMES
from nl_env.recording import Recording
from nl_env.reproduction.published import ADAPTIVE, GAPS_MS
from nl_env.sensors.lidar import Lidar
from nl_env.traces import score
from nl_env.types import SLICE_US, DepthExtrapolator, Extrapolation, ExtrapolationInput

GROUPS = (*map(str, GAPS_MS), ADAPTIVE)
"""The measured gaps: five fixed ones, in ms, and one drawn for each pair."""

MEAN = "mean"
"""Mean over the five fixed gaps."""

ADAPTIVE_STEP_US = 10_000
"""Drawn gaps are multiples of this, log-uniform from the shortest to the longest fixed gap."""

PAIRS_STREAM = 12
"""Spawn key that keeps the choice of pairs apart from everything else drawn with the sequence seed."""

CONTROLS = ("", "no events", "shuffled events")


@dataclass(frozen=True)
class Method:
    """What makes one depth frame of a pair.

    Attributes:
        row: row of the table; methods of one row are training seeds of the same thing.
        extrapolator: a name or a path to weights, as ``make_extrapolator`` takes it.
        odometry: give it the true poses.
        control: one of ``CONTROLS``: take its events away, or put their time bins in another order.
    """

    row: str
    extrapolator: str
    odometry: bool = False
    control: str = ""

    def make(self) -> DepthExtrapolator:
        """The extrapolator, with its events as ``control`` says; errors as ``make_extrapolator``."""
        choice("control", self.control, CONTROLS)
        made = make_extrapolator(self.extrapolator, odometry=self.odometry)
        return ChangedEvents(made, self.control) if self.control else made


class ChangedEvents:
    """Runs another extrapolator with its events removed, or with their five time bins in a random order.

    The order is drawn from the time asked for, never the true one: the frame stays a function of the input.
    """

    def __init__(self, extrapolator: DepthExtrapolator, control: str) -> None:
        self.history = extrapolator.history
        self.odometry = extrapolator.odometry
        self._extrapolator = extrapolator
        self._control = control

    def reset(self) -> None:
        """Forget the previous sequence."""
        self._extrapolator.reset()

    def __call__(self, inputs: ExtrapolationInput) -> Extrapolation:
        bins = np.concatenate(inputs.bins)
        if self._control == "no events":
            bins = np.zeros_like(bins)
        else:
            # The voxel grid's bin b is the sum of consecutive parts: move whole parts.
            parts = bins.reshape(-1, len(inputs.bins), *bins.shape[1:])
            rng = np.random.default_rng(inputs.t)
            order = rng.permutation(len(parts))
            while (order == np.arange(len(parts))).all():
                order = rng.permutation(len(parts))
            bins = parts[order].reshape(bins.shape)
        changed = tuple(np.split(bins, len(inputs.bins)))
        return self._extrapolator(
            ExtrapolationInput(
                t=inputs.t,
                camera=inputs.camera,
                max_depth=inputs.max_depth,
                lidar_frames=inputs.lidar_frames,
                lidar_times=inputs.lidar_times,
                bins=changed,
                poses=inputs.poses,
            )
        )


@dataclass(frozen=True)
class SequenceErrors:
    """Errors of every method on one sequence.

    Attributes:
        seed: of the sequence.
        description: scenario, style, weather.
        errors: ``(methods, groups, metrics)`` float64, means over the pairs.
    """

    seed: int
    description: dict[str, Any]
    errors: NDArray[np.float64]

    def save(self, path: Path) -> None:
        """Write everything to one ``.npz`` file (no pickle)."""
        header = json.dumps({"seed": self.seed, "description": self.description})
        np.savez_compressed(path, header=np.array(header), errors=self.errors)

    @classmethod
    def load(cls, path: Path) -> SequenceErrors:
        """Read what :meth:`save` wrote."""
        with np.load(path) as file:
            return cls(**json.loads(str(file["header"])), errors=file["errors"])


@dataclass(frozen=True)
class GapsTask:
    """The work of one process: every method on the pairs of one recording.

    Attributes:
        files: recording of each sequence seed.
        methods: what is compared, on the same pairs.
        pairs: LiDAR frames per sequence, at random times; each with every gap.
        min_depth: depths below are read as this one by the full-image metrics, m.
    """

    files: Mapping[int, Path]
    methods: tuple[Method, ...]
    pairs: int
    min_depth: float = 1.0

    def __call__(self, seed: int) -> SequenceErrors:
        """Measure the sequence of ``seed``; a recording without the needed depth raises ``ValueError``."""
        extrapolators = [method.make() for method in self.methods]
        with Recording(self.files[seed]) as recording:
            rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(PAIRS_STREAM,)))
            errors = [
                self._pair(recording, extrapolators, now, gaps) for now, gaps in self._times(recording, rng)
            ]
            return SequenceErrors(seed, recording.description, finite_mean(np.array(errors)))

    def _times(self, recording: Recording, rng: np.random.Generator) -> list[tuple[int, list[int]]]:
        """``(time of the LiDAR frame, gaps)`` of every pair, us; distinct frames while there are enough."""
        last = recording.slices * SLICE_US - GAPS_MS[-1] * 1000
        period = recording.lidar_period * SLICE_US
        frames = np.arange(period, last + 1, period)
        if not len(frames):
            raise ValueError(
                f"{self.files[recording.seed]}: found {recording.slices * SLICE_US / 1e6} s, "
                f"expected at least {(period + GAPS_MS[-1] * 1000) / 1e6} s"
            )
        chosen = np.sort(rng.choice(frames, self.pairs, replace=self.pairs > len(frames)))
        shortest, longest = (GAPS_MS[i] * 1000 // ADAPTIVE_STEP_US for i in (0, -1))
        drawn = np.exp(rng.uniform(np.log(shortest), np.log(longest), self.pairs)).round().astype(int)
        fixed = [gap * 1000 for gap in GAPS_MS]
        return [
            (int(now), [*fixed, int(steps) * ADAPTIVE_STEP_US])
            for now, steps in zip(chosen, drawn, strict=True)
        ]

    def _pair(
        self, recording: Recording, extrapolators: list[DepthExtrapolator], now: int, gaps: list[int]
    ) -> list[list[list[float]]]:
        """Metrics of every method (outer) at every gap of the LiDAR frame at ``now``."""
        lidar = Lidar(recording.config.lidar, recording.camera)
        times: tuple[int, ...] = (now - recording.lidar_period * SLICE_US, now)
        frames = tuple(lidar.measure(recording.depth(t)) for t in times)
        rows: list[list[list[float]]] = [[] for _ in extrapolators]
        for gap in gaps:
            t = now + gap
            truth = recording.depth(t)
            # One grid of five bins over the whole gap, which need not be a whole number of slices.
            bins = (recording.voxel(now, t).astype(np.int16),)
            for row, extrapolator in zip(rows, extrapolators, strict=True):
                kept = slice(-extrapolator.history, None)
                wanted = (*times[kept], t) if extrapolator.odometry else ()
                inputs = ExtrapolationInput(
                    t=t,
                    camera=recording.camera,
                    max_depth=recording.max_depth,
                    lidar_frames=frames[kept],
                    lidar_times=times[kept],
                    bins=bins,
                    poses=tuple(recording.pose(at) for at in wanted),
                )
                made = score(extrapolator(inputs), truth, recording.max_depth, self.min_depth)
                row.append([made[name] for name in METRIC_NAMES])
        return rows


def with_mean(errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Append the mean over the fixed gaps to ``(..., groups, metrics)``; its name is ``MEAN``."""
    mean = errors[..., : len(GAPS_MS), :].mean(axis=-2, keepdims=True)
    return np.concatenate([errors, mean], axis=-2)


def finite_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean over the first axis without nan (an image of nothing but sky); nan where all are."""
    count = np.isfinite(values).sum(axis=0)
    total = np.where(np.isfinite(values), values, 0.0).sum(axis=0)
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
