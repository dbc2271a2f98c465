"""What is in recordings, ELiDAR's files, files of real sensors or weights, and what is wrong with them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from nl_env.elidar import find_files
from nl_env.elidar.layout import HDF5_SUFFIXES, hdf5_kind
from nl_env.importing import EVENT_SUFFIXES, cameras_in
from nl_env.inspection.elidar import (
    inspect_elidar,
    inspect_lists,
    inspect_metadata,
    inspect_raw,
    inspect_slicing,
)
from nl_env.inspection.events import inspect_events
from nl_env.inspection.findings import Findings, Reading
from nl_env.inspection.ground_truth import inspect_ground_truth
from nl_env.inspection.native import inspect_recordings, inspect_weights

__all__ = ["Findings", "Reading", "inspect_path"]

WEIGHT_SUFFIXES = (".safetensors", ".pth", ".pt")


def inspect_path(path: Path, reading: Reading) -> list[Findings]:
    """Everything found at ``path``, a file or folder of any of these kinds.

    Raises:
        FileNotFoundError: nothing there, or a folder with nothing known in it.
        ValueError: a file that is none of the known kinds, or that cannot be read.
    """
    if path.is_dir():
        return list(_folder(path, reading))
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    if path.suffix in WEIGHT_SUFFIXES:
        return [inspect_weights(path)]
    if path.suffix == ".npz":
        return [inspect_raw({path.stem: path}, path, reading)]
    if path.suffix == ".csv":
        return [inspect_metadata(path)]
    if path.suffix == ".txt":
        return [inspect_lists({"sequences": path}, path)]
    if path.suffix.lower() in EVENT_SUFFIXES:
        return _real(path, reading)
    if path.suffix in HDF5_SUFFIXES:
        return list(_hdf5(path, reading))
    known = ", ".join((*HDF5_SUFFIXES, *EVENT_SUFFIXES, ".npz", ".csv", ".txt", *WEIGHT_SUFFIXES))
    raise ValueError(f"{path}: found {path.suffix or 'no suffix'}, expected a folder or one of {known}")


def _hdf5(path: Path, reading: Reading) -> Iterator[Findings]:
    kind = hdf5_kind(path)
    if kind == "recording":
        yield inspect_recordings([path], path, reading)
    elif kind == "slicing":
        yield inspect_slicing(path, reading)
    elif kind == "pairs":
        yield from inspect_elidar(find_files(path.parent), reading)
    elif found := _real(path, reading):
        yield from found
    else:
        raise ValueError(
            f"{path}: found an HDF5 file that is neither a recording nor one of ELiDAR's, "
            "and has no events, depth maps or poses"
        )


def _real(path: Path, reading: Reading) -> list[Findings]:
    """Events, or depth maps and poses; nothing if a file has none of them."""
    if cameras := cameras_in(path):
        return [inspect_events(path, camera, reading) for camera in cameras]
    return list(inspect_ground_truth(path, reading)) if path.suffix in HDF5_SUFFIXES else []


def _folder(folder: Path, reading: Reading) -> Iterator[Findings]:
    """Recordings, weights and files of real sensors wherever they are; ELiDAR's where there are none."""
    recordings, weights, unreadable = [], [], []
    real: list[Findings] = []
    for path in sorted(folder.rglob("*")):
        if path.name.startswith(".") or not path.is_file():
            continue
        if path.suffix in WEIGHT_SUFFIXES:
            weights.append(path)
        elif path.suffix.lower() in EVENT_SUFFIXES:
            real += _real(path, reading)
        elif path.suffix in HDF5_SUFFIXES:
            try:
                kind = hdf5_kind(path)
                if kind == "recording":
                    recordings.append(path)
                elif kind == "other":
                    real += _real(path, reading)
            except ValueError as error:
                unreadable.append(str(error))
    if recordings:
        found = inspect_recordings(recordings, folder, reading)
        found.problems += unreadable
        yield found
    yield from real
    if real and not recordings and unreadable:
        yield Findings("unreadable HDF5", folder, problems=unreadable)
    for path in weights:
        yield inspect_weights(path)
    if not recordings and not weights and not real:
        yield from inspect_elidar(find_files(folder), reading)
