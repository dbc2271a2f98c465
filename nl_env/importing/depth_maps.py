"""Depth maps with their times, as M3ED publishes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nl_env.config import choice
from nl_env.elidar.hdf5 import Hdf5Reader
from nl_env.importing.ms_indexed import CAMERAS, load_filters

TIMES = "ts"


class DepthMaps:
    """``depth/prophesee/CAMERA`` and ``ts`` of an M3ED depth file, or plain ``depth`` and ``ts``.

    Depth is z-depth in metres at the pixels of the event camera, times are us on the events' clock. Read
    map by map.

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
        names = (f"depth/prophesee/{camera}", "depth")
        file = self._reader.file
        self._name = next((name for name in names if name in file and hasattr(file[name], "shape")), names[0])
        depth, times = self._reader.dataset(self._name), self._reader.dataset(TIMES)
        if depth.ndim != 3 or times.shape != depth.shape[:1] or len(depth) == 0:
            raise ValueError(
                f"{self.path}: found {self._name} {depth.shape} and {TIMES} {times.shape}, "
                "expected (N, H, W) and (N,)"
            )
        if times.dtype.kind not in "iu":
            raise ValueError(f"{self.path}: {TIMES}: found {times.dtype}, expected integers, us")
        self.shape: tuple[int, int] = (int(depth.shape[1]), int(depth.shape[2]))
        self.times: NDArray[np.int64] = self._reader.read(TIMES, slice(None)).astype(np.int64)
        wrong = np.diff(self.times, prepend=-1) <= 0  # a negative time, too
        if wrong.any():
            k = int(np.argmax(wrong))
            raise ValueError(
                f"{self.path}: {TIMES}[{k}]: found {self.times[k]} us, "
                "expected times that ascend from 0 without repeating"
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
