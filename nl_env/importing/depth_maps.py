"""Depth maps with their times, as M3ED publishes them."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from nl_env.config import choice
from nl_env.elidar.hdf5 import Hdf5Reader
from nl_env.importing.ms_indexed import CAMERAS, load_filters
from nl_env.importing.source import checked_times

TIMES = "ts"
PLAIN = "depth"
"""The maps of a file that is not M3ED's."""


def depth_in(path: Path) -> tuple[str, ...]:
    """The cameras that :class:`DepthMaps` finds maps of in an HDF5 file; plain ``depth`` is the left's.

    Raises:
        FileNotFoundError, ValueError: a missing or unreadable HDF5 file.
    """
    with Hdf5Reader(path) as reader:
        found = tuple(
            camera for camera in CAMERAS if isinstance(reader.file.get(_name(camera)), h5py.Dataset)
        )
        plain = isinstance(reader.file.get(PLAIN), h5py.Dataset) and TIMES in reader.file
    return found or CAMERAS[: int(plain)]


def _name(camera: str) -> str:
    """Where M3ED keeps a camera's maps."""
    return f"depth/prophesee/{camera}"


class DepthMaps:
    """``depth/prophesee/CAMERA`` and ``ts`` of an M3ED depth file, or plain ``depth`` and ``ts``.

    A :class:`nl_env.importing.DepthSource`. Depth is z-depth in metres at the pixels of the event camera,
    times are us on the events' clock, integers or (in M3ED) floats. Read map by map.

    Args:
        path: the HDF5 file.
        camera: ``"left"`` or ``"right"``.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no depth, other shapes than ``(N, H, W)`` and ``(N,)``, or times that do not ascend.

    Attributes:
        shape: ``(H, W)``.
        times: ``(N,)`` int64, us.
    """

    def __init__(self, path: str | Path, camera: str = "left") -> None:
        choice("camera", camera, CAMERAS)
        self.path = Path(path)
        load_filters()
        self._reader = Hdf5Reader(self.path)
        plain = isinstance(self._reader.file.get(PLAIN), h5py.Dataset)
        self._name = PLAIN if plain else _name(camera)
        depth, times = self._reader.dataset(self._name), self._reader.dataset(TIMES)
        if depth.ndim != 3 or times.shape != depth.shape[:1] or len(depth) == 0:
            raise ValueError(
                f"{self.path}: found {self._name} {depth.shape} and {TIMES} {times.shape}, "
                "expected (N, H, W) and (N,)"
            )
        self.shape: tuple[int, int] = (int(depth.shape[1]), int(depth.shape[2]))
        self.times: NDArray[np.int64] = checked_times(
            f"{self.path}: {TIMES}", self._reader.read(TIMES, slice(None))
        )

    def __len__(self) -> int:
        return len(self.times)

    def read(self, k: int) -> NDArray[np.float32]:
        """``(H, W)`` float32 m, map ``k``; 0 where the file has 0, infinity or NaN, which mean no return.

        Raises:
            ValueError: no such map, damage, or negative depth.
        """
        depth = self._reader.read(self._name, k).astype(np.float32)
        if np.any(depth < 0):
            lowest = depth[depth < 0].min()
            raise ValueError(f"{self.path}: {self._name}[{k}]: found {lowest} m, expected no negative depth")
        return np.where(np.isfinite(depth), depth, np.float32(0))

    def close(self) -> None:
        """Close the file; it opens again when it is needed. May be called twice."""
        self._reader.close()
