"""What is in files of depth maps and poses of other projects."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from nl_env import colours
from nl_env.importing import DepthMaps, PoseTrack, depth_in, holds_poses
from nl_env.inspection.findings import MIN_DEPTH, TILES, Findings, Reading


def inspect_ground_truth(path: Path, reading: Reading) -> Iterator[Findings]:
    """The depth maps of each camera and the poses of an HDF5 file; nothing if it has neither.

    Raises:
        FileNotFoundError, ValueError: a missing or unreadable HDF5 file.
    """
    for camera in depth_in(path):
        yield _inspect_depth(path, camera, reading)
    if holds_poses(path):
        yield _inspect_poses(path)


def _inspect_depth(path: Path, camera: str, reading: Reading) -> Findings:
    found = Findings("depth maps", path, {"camera": camera, "megabytes": path.stat().st_size / 1e6})
    try:
        maps = DepthMaps(path, camera)
    except ValueError as error:
        found.problems.append(str(error))
        return found
    seconds = (int(maps.times[-1]) - int(maps.times[0])) / 1e6
    found.facts |= {
        "maps": len(maps),
        "resolution": f"{maps.shape[0]}x{maps.shape[1]}",
        "first_us": int(maps.times[0]),
        "seconds": seconds,
        "maps_per_second": (len(maps) - 1) / seconds if seconds else 0.0,
    }
    if reading.verify:
        for k in range(len(maps)):
            found.attempt(partial(maps.read, k))
    if reading.pictures:
        for k in np.unique(np.linspace(0, len(maps) - 1, TILES).astype(int)).tolist():
            found.attempt(partial(_add_picture, found, maps, k, reading.max_depth))
    maps.close()
    return found


def _add_picture(found: Findings, maps: DepthMaps, k: int, max_depth: float) -> None:
    found.pictures.append(colours.depth(maps.read(k), MIN_DEPTH, max_depth))


def _inspect_poses(path: Path) -> Findings:
    found = Findings("poses", path)
    try:
        track = PoseTrack(path, camera=None)
    except ValueError as error:
        found.problems.append(str(error))
        return found
    steps = np.linalg.norm(np.diff(track.poses[:, :3, 3], axis=0), axis=1)
    durations = np.diff(track.times) / 1e6
    found.facts = {
        "poses": len(track),
        "first_us": int(track.times[0]),
        "seconds": float(durations.sum()),
        "largest_gap_ms": float(durations.max()) * 1e3,
        "metres": float(steps.sum()),
        "largest_speed": float((steps / durations).max()),
    }
    return found
