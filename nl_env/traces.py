"""One pass over a sequence that answers every trigger policy: the table of held-depth errors.

Within a LiDAR interval the depth a consumer holds at slice k depends only on the slice k - a at which it was
produced. With P slices between LiDAR frames there are at most P such frames per slice, so one run of the
sensors and of the extrapolator gives the error of every schedule of triggers, the optimal one included.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.depth.metrics import METRIC_NAMES, all_metrics
from nl_env.history import SensorHistory
from nl_env.keyframes import label_keyframe
from nl_env.observations import image_observation
from nl_env.statistics import slice_statistics
from nl_env.types import (
    BatchExtrapolator,
    DepthExtrapolator,
    Extrapolation,
    ExtrapolationInput,
    Sample,
    SensorStream,
)

BATCH = 4
"""Frames that are extrapolated together, at most: all of an interval at 10 Hz. More gain nothing on a CPU."""

PLAYER_ROWS = 120
"""Rows of the small frames kept for a player."""

NEAREST_SHARE = 0.005
"""The nearest depth that player frames tell apart, as a share of the range (1 m of 200 m)."""


@dataclass(frozen=True)
class PlayerFrames:
    """Small frames of a whole sequence for looking at it; depth is coded by :func:`code_depth`.

    Attributes:
        events: ``(K+1, h, w)`` uint8, image observations (128 = no change).
        truth: ``(K+1, h, w)`` uint8 codes of the true depth.
        produced: ``(K+1, h, w)`` uint8 codes of the frame a trigger at that slice gives; the LiDAR frame
            where there is one.
        max_depth: sensor range, m.
    """

    events: NDArray[np.uint8]
    truth: NDArray[np.uint8]
    produced: NDArray[np.uint8]
    max_depth: float


@dataclass(frozen=True)
class SequenceTrace:
    """Everything policies see and are judged by on one sequence with one extrapolator; index 0 is t = 0.

    Attributes:
        seed: of the sequence.
        description: scenario, style, weather, as the stream describes them.
        lidar_period: slices between LiDAR frames (P).
        images: ``(K+1, H, W)`` uint8 image observations.
        event_count: ``(K+1,)`` int64 events per slice.
        active_fraction: ``(K+1,)`` share of pixels with a non-zero event frame.
        ego_speed: ``(K+1,)`` m/s.
        shortest_distance: ``(K+1,)`` m, ``inf`` without an actor.
        new_actors: ``(K+1,)`` int64.
        keyframe, keyframe_speed, keyframe_distance, keyframe_new: ``(K+1,)`` bool, label and causes.
        lidar: ``(K+1,)`` bool, slices with a LiDAR frame.
        errors: for every metric a ``(K+1, P)`` float64 table: ``errors[name][k, a]`` is the error at slice k
            of the frame produced at slice k - a of the same LiDAR interval; nan where k - a is before it.
        frames: small frames, when they were asked for.
    """

    seed: int
    description: dict[str, Any]
    lidar_period: int
    images: NDArray[np.uint8]
    event_count: NDArray[np.int64]
    active_fraction: NDArray[np.float64]
    ego_speed: NDArray[np.float64]
    shortest_distance: NDArray[np.float64]
    new_actors: NDArray[np.int64]
    keyframe: NDArray[np.bool_]
    keyframe_speed: NDArray[np.bool_]
    keyframe_distance: NDArray[np.bool_]
    keyframe_new: NDArray[np.bool_]
    lidar: NDArray[np.bool_]
    errors: Mapping[str, NDArray[np.float64]]
    frames: PlayerFrames | None = None

    @property
    def slices(self) -> int:
        """Index of the last slice (K)."""
        return len(self.lidar) - 1

    @cached_property
    def statistics(self) -> NDArray[np.float32]:
        """``(K+1, SLICE_STATISTICS)`` float32: :func:`nl_env.statistics.slice_statistics` of the images."""
        return slice_statistics(self.images)


def trace_sequence(
    stream: SensorStream,
    extrapolator: DepthExtrapolator,
    seed: int,
    *,
    min_depth: float = 1.0,
    keep_frames: bool = False,
) -> SequenceTrace:
    """Run sequence ``seed`` of ``stream`` once, extrapolating at every slice without a LiDAR frame.

    The extrapolator must be a function of its input: the environment, which calls it at triggered slices
    only, then gives the same numbers.

    Args:
        stream: sensors; left at the end of the sequence.
        extrapolator: makes the frame of every slice without a LiDAR frame.
        seed: sequence seed.
        min_depth: depths below are read as this one by the full-image metrics, m (1 outdoors, 0.1 indoors).
        keep_frames: keep small frames for a player (about 58 MB for 20 s).
    """
    extrapolator.reset()
    sample = stream.reset(seed)
    samples: list[tuple[Any, ...]] = []
    images = np.empty((stream.slices + 1, *stream.camera.shape), np.uint8)
    errors = {name: np.full((len(images), stream.lidar_period), np.nan) for name in METRIC_NAMES}
    small = _empty_player_frames(len(images), stream) if keep_frames else None
    history = SensorHistory(stream.camera, stream.max_depth, extrapolator)
    # Of the LiDAR interval so far: its true depths, and what the extrapolator may look at.
    truths: list[NDArray[np.float32]] = []
    wanted: list[ExtrapolationInput] = []

    for k in range(len(images)):
        if k > 0:
            sample = stream.advance()
        history.add(sample)
        if sample.lidar is not None:
            prior = Extrapolation(sample.lidar)
            truths, wanted = [sample.depth], []
        else:
            truths.append(sample.depth)
            wanted.append(history.inputs(sample))
        images[k] = image_observation(sample.event_frame)[0]
        samples.append(_scalars(sample))
        if len(truths) < stream.lidar_period and k < stream.slices:
            continue
        produced = [prior, *_extrapolate(extrapolator, wanted)]
        first = k + 1 - len(truths)
        for offset, truth in enumerate(truths):
            for age, held in enumerate(reversed(produced[: offset + 1])):
                for name, value in score(held, truth, stream.max_depth, min_depth).items():
                    errors[name][first + offset, age] = value
            if small is not None:
                _shrink_into(small, first + offset, images[first + offset], truth, produced[offset].depth)

    columns = {
        name: np.array(column) for name, column in zip(_SCALARS, zip(*samples, strict=True), strict=True)
    }
    return SequenceTrace(
        seed, stream.describe(), stream.lidar_period, images, **columns, errors=errors, frames=small
    )


def _extrapolate(
    extrapolator: DepthExtrapolator, wanted: Sequence[ExtrapolationInput]
) -> list[Extrapolation]:
    """The frames of ``wanted``, several at a time where the extrapolator can."""
    if not isinstance(extrapolator, BatchExtrapolator):
        return [extrapolator(inputs) for inputs in wanted]
    starts = range(0, len(wanted), BATCH)
    return [frame for start in starts for frame in extrapolator.batch(wanted[start : start + BATCH])]


def score(
    produced: Extrapolation, truth: NDArray[np.float32], max_depth: float, min_depth: float
) -> dict[str, float]:
    """Every metric of one held frame; the paper's use the depth if there were a return, where it is given."""
    return all_metrics(produced.depth, truth, max_depth, min_depth, produced.depth_if_return)


def code_depth(depth: NDArray[np.float32], max_depth: float) -> NDArray[np.uint8]:
    """One byte for display: 0 = no return, 1..255 = log scale over ``[NEAREST_SHARE, 1]`` of the range."""
    nearest = max_depth * NEAREST_SHARE
    share = np.log(np.maximum(depth, nearest) / nearest) / np.log(1 / NEAREST_SHARE)
    return np.where(depth > 0, 1 + np.rint(254 * np.minimum(share, 1)), 0).astype(np.uint8)


_SCALARS = (
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


def _scalars(sample: Sample) -> tuple[Any, ...]:
    """One row of the per-slice columns, in the order of ``_SCALARS``."""
    state, keyframe = sample.state, label_keyframe(sample.state)
    return (
        sample.event_count,
        sample.active_fraction,
        state.speed,
        state.shortest_distance,
        state.new_actors,
        keyframe.label,
        keyframe.speed,
        keyframe.distance,
        keyframe.new,
        sample.lidar is not None,
    )


def _empty_player_frames(frames: int, stream: SensorStream) -> PlayerFrames:
    height, width = stream.camera.shape
    rows = min(height, PLAYER_ROWS)
    shape = (frames, rows, width * rows // height)
    events, truth, produced = (np.empty(shape, np.uint8) for _ in range(3))
    return PlayerFrames(events, truth, produced, stream.max_depth)


def _shrink_into(
    small: PlayerFrames,
    k: int,
    image: NDArray[np.uint8],
    truth: NDArray[np.float32],
    produced: NDArray[np.float32],
) -> None:
    """Sample nearest pixels: averaging would invent depths between an object and what is behind it."""
    rows, columns = (
        (np.arange(n) * size + size // 2) // n
        for n, size in zip(small.events.shape[1:], image.shape, strict=True)
    )
    pixels = np.ix_(rows, columns)
    small.events[k] = image[pixels]
    small.truth[k] = code_depth(truth[pixels], small.max_depth)
    small.produced[k] = code_depth(produced[pixels], small.max_depth)
