"""Writes a native recording from an event file, and from depth maps and poses where there are some."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from nl_env.config import SPLITS, DrivingConfig, LidarConfig, SceneConfig
from nl_env.importing.geometry import Crop, choose_crop
from nl_env.importing.navigation import NavigationTrack
from nl_env.importing.options import ImportOptions
from nl_env.importing.poses import Motion, PoseTrack
from nl_env.importing.source import DepthSource, EventSource
from nl_env.keyframes import SPEED_LIMIT
from nl_env.recording.schema import EVENT_FIELDS, LIBVER, Header
from nl_env.recording.writer import CheckedOutput, DatasetWriter, DeferredInterrupts
from nl_env.runs import replacing
from nl_env.sensors.lidar import encode
from nl_env.types import SLICE_US, TICK_US, TICKS_PER_SLICE

UNKNOWN_SPEED = -1.0
"""As on ELiDAR without its raw sequences."""
FIRST_SEED = SPLITS["test"].start + 100_000_000
"""Imported recordings are test sequences unless told otherwise, and far from the benchmark's."""


@dataclass(frozen=True)
class Imported:
    """What became of a file.

    Attributes:
        seed: of the recording.
        slices: K.
        crop: which pixels.
        events_read: in the time that was imported.
        events_kept: those in the crop.
        depth_slices: how many of the K + 1 slice ends have a depth map.
        depth_offset_ms: largest time between a slice's end and its depth map.
        pose_slices: how many of the slice ends have a pose.
        speed_slices: how many of them have a speed.
    """

    seed: int
    slices: int
    crop: Crop
    events_read: int
    events_kept: int
    depth_slices: int
    depth_offset_ms: float
    pose_slices: int
    speed_slices: int


def import_recording(
    source: EventSource,
    depth: DepthSource | None,
    path: Path,
    options: ImportOptions,
    track: PoseTrack | NavigationTrack | None = None,
) -> Imported:
    """Write a recording of ``source`` to ``path``, whole or not at all.

    The end of every slice that has a depth map within the tolerance gets that map. All others get an empty
    one (no return anywhere), as do all without ``depth``: nothing is interpolated. LiDAR frames must not be
    empty, so each needs a map. With ``track`` every slice's end has the speed, the first cause of a keyframe
    and, of poses, pose and twist, as far as the track reaches; the rest of the state is not known.

    Args:
        source: the events.
        depth: depth maps of the same sensor on the same clock, or None.
        path: the recording; replaced if it exists.
        options: which part, and how.
        track: poses of the camera or its speed on the same clock, or None.

    Raises:
        ValueError: an option, damage in a file, or too little of events, depth or poses; names which.
        OSError: the recording cannot be written; the message names it.
    """
    crop = choose_crop(source.shape, options.resolution, source.calibration, options.crop)
    config = _config(source, crop, options)
    start = _start(source, depth, config.scene.slices, options)
    maps, offset_us = _matched(depth, start, config, options)
    motion = _motion(track, start, config.scene.slices)
    with_pose = int(np.count_nonzero(motion.known))
    with_speed = int(np.count_nonzero(np.isfinite(motion.speed)))
    seed = derived_seed(source.path.name, options.start_s) if options.seed is None else options.seed
    with_depth = int(np.count_nonzero(maps >= 0))
    description = {
        "scenario": "imported",
        "style": "unknown",
        "weather": "unknown",
        "seed": seed,
        "source": source.path.name,
        "layout": source.layout,
        "start_us": start,
        "crop": [crop.left, crop.top, crop.shape[1] * crop.k, crop.shape[0] * crop.k],
        "binning": crop.k,
        "depth_source": None if depth is None else depth.path.name,
        "depth_slices": with_depth,
        "depth_offset_us": offset_us,
        "motion_source": None if track is None else track.path.name,
        "pose_slices": with_pose,
        "speed_slices": with_speed,
    }
    header = Header(seed, config, description)
    with _writing(path, header) as writer:
        read, kept = _write_events(source, crop, start, header, writer)
        for k, index in enumerate(maps.tolist()):
            metres = np.zeros(crop.shape, np.float32)
            if depth is not None and index >= 0:
                metres = crop.depth(depth.read(index))
            writer.append("depth/codes", encode(metres, options.max_depth)[None])
            writer.append("depth/t", [k * SLICE_US])
        _write_state(motion, writer)
    return Imported(
        seed, header.slices, crop, read, kept, with_depth, offset_us / 1000, with_pose, with_speed
    )


def derived_seed(name: str, start_s: float) -> int:
    """The seed of a recording that was not given one; a test sequence's."""
    room = SPLITS["test"].stop - FIRST_SEED
    return FIRST_SEED + zlib.crc32(f"{name} from {start_s!r} s".encode()) % room


def _config(source: EventSource, crop: Crop, options: ImportOptions) -> DrivingConfig:
    """The configuration that says the recording's size, duration, field of view and LiDAR."""
    focal = options.focal_px
    if focal is None:
        if source.calibration is None:
            raise ValueError(
                f"{source.path}: found no calibration, expected --focal-px, the focal length in pixels"
            )
        focal = source.calibration.focal
    return DrivingConfig(
        resolution=options.resolution,
        scene=SceneConfig(duration_s=options.duration_s, fov_deg=crop.fov_deg(focal)),
        lidar=LidarConfig(rate_hz=options.lidar_hz, max_depth=options.max_depth),
    )


def _start(source: EventSource, depth: DepthSource | None, slices: int, options: ImportOptions) -> int:
    """Time of slice 0, us; raises ``ValueError`` unless events last for ``slices`` from there."""
    first, last = source.span()
    start = first + round(options.start_s * 1e6)
    if depth is not None:
        if depth.shape != source.shape:
            raise ValueError(
                f"{depth.path}: found depth of {depth.shape}, expected the sensor's size, {source.shape}"
            )
        later = depth.times[depth.times >= start]
        if not len(later):
            raise ValueError(
                f"{depth.path}: found depth until {depth.times[-1]} us, expected some from {start} us on"
            )
        start = int(later[0])
    available = (last + 1 - start) / 1e6
    if available < slices * SLICE_US / 1e6:
        raise ValueError(
            f"{source.path}: found {max(available, 0.0):.2f} s of events from the start on, "
            f"expected {slices * SLICE_US / 1e6:.2f} s; give a shorter --duration-s or an earlier --start-s"
        )
    return start


def _matched(
    depth: DepthSource | None, start: int, config: DrivingConfig, options: ImportOptions
) -> tuple[NDArray[np.int64], int]:
    """The depth map of each slice's end, -1 for none, and the largest time between the two, us."""
    ends = start + SLICE_US * np.arange(config.scene.slices + 1)
    if depth is None:
        return np.full(len(ends), -1), 0
    after = np.searchsorted(depth.times, ends).clip(1, max(len(depth) - 1, 1))
    choices = np.stack([after - 1, np.minimum(after, len(depth) - 1)])
    distances = np.abs(depth.times[choices] - ends)
    best = distances.argmin(axis=0)
    slices = np.arange(len(ends))
    maps, offsets = choices[best, slices], distances[best, slices]
    found = offsets <= options.depth_tolerance_ms * 1000
    missing = np.flatnonzero(~found[:: config.lidar.period]) * config.lidar.period
    if len(missing):
        k = int(missing[0])
        raise ValueError(
            f"{depth.path}: found no depth for the LiDAR frame {k * SLICE_US / 1e6:.2f} s after the start "
            f"(the nearest is {offsets[k] / 1000:.1f} ms away; {len(missing)} frames lack it), expected one "
            f"within {options.depth_tolerance_ms:g} ms at {config.lidar.rate_hz} Hz; "
            "give another --lidar-hz, --start-s, --duration-s or --depth-tolerance-ms"
        )
    return np.where(found, maps, -1), int(offsets[found].max())


def _motion(track: PoseTrack | NavigationTrack | None, start: int, slices: int) -> Motion:
    """The motion at every slice's end; raises ``ValueError`` where a track says nothing of any."""
    ends = start + SLICE_US * np.arange(slices + 1)
    if track is None:
        return Motion.unknown(len(ends))
    motion = track.motion(ends)
    if not np.isfinite(motion.speed).any():
        raise ValueError(
            f"{track.path}: found poses or speeds from {track.times[0]} to {track.times[-1]} us, "
            f"expected some from {ends[0]} to {ends[-1]} us"
        )
    return motion


class _Writer:
    """The datasets of a recording that is being written."""

    def __init__(
        self, datasets: dict[str, DatasetWriter], output: CheckedOutput, interrupts: DeferredInterrupts
    ) -> None:
        self._datasets = datasets
        self._output = output
        self._interrupts = interrupts

    def append(self, name: str, rows: Any) -> None:
        """Add rows; raises what writing or Ctrl-C left to raise."""
        self._datasets[name].append(rows)
        self._output.check()
        self._interrupts.check()


@contextmanager
def _writing(path: Path, header: Header) -> Iterator[_Writer]:
    """A recording at ``path`` that appears when the block ends without an error."""
    try:
        with (
            replacing(path) as temporary,
            DeferredInterrupts() as interrupts,
            CheckedOutput(temporary) as output,
        ):
            with h5py.File(output, "w", libver=LIBVER) as file:
                datasets = {
                    name: DatasetWriter(file, name, column) for name, column in header.columns.items()
                }
                yield _Writer(datasets, output, interrupts)
                for dataset in datasets.values():
                    dataset.finish()
                header.write(file)
            output.check()
    except OSError as error:
        raise OSError(f"{path}: cannot write the recording ({error})") from error


def _write_events(
    source: EventSource, crop: Crop, start: int, header: Header, writer: _Writer
) -> tuple[int, int]:
    """Write the events and their indices; how many were read, and kept."""
    ticks = header.slices * TICKS_PER_SLICE
    counts = np.zeros(ticks, np.int64)
    read = 0
    for block in source.blocks(start, start + ticks * TICK_US):
        read += len(block)
        events = crop.events(block)
        events["t"] -= start
        counts += np.bincount(events["t"] // TICK_US, minlength=ticks)
        for name in EVENT_FIELDS:
            writer.append(f"events/{name}", events[name])
    index = np.concatenate([[0], np.cumsum(counts)])
    writer.append("events/tick_index", index)
    writer.append("events/slice_index", index[::TICKS_PER_SLICE])
    return read, int(index[-1])


def _write_state(motion: Motion, writer: _Writer) -> None:
    """The motion where it is known; nothing here says other actors, and so no keyframe that they cause."""
    rows = len(motion.speed)
    speed = np.where(np.isfinite(motion.speed), motion.speed, UNKNOWN_SPEED)
    writer.append("depth/pose", motion.pose)
    writer.append("depth/twist", motion.twist)
    writer.append("state/speed", speed)
    writer.append("state/shortest_distance", np.full(rows, math.inf))
    writer.append("state/new_actors", np.zeros(rows, np.int64))
    writer.append("state/keyframe_speed", speed > SPEED_LIMIT)
    for cause in ("distance", "new"):
        writer.append(f"state/keyframe_{cause}", np.zeros(rows, np.bool_))
