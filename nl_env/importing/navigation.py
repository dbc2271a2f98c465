"""Ego speed from satellite and inertial navigation, as EvTTC publishes it beside its events."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nl_env.elidar.hdf5 import Hdf5Reader
from nl_env.importing.ms_indexed import load_filters
from nl_env.importing.poses import MAX_GAP_US, Motion
from nl_env.importing.source import checked_times

GROUP = "integratedNavigation/data"
VELOCITY, TIMES = f"{GROUP}/velocity", f"{GROUP}/ts"

MAX_SPEED = 100.0
"""m/s; the data set does not say its unit, and what is faster than this is in another one."""


class NavigationTrack:
    """``integratedNavigation/data/velocity`` and ``ts`` of an EvTTC file; a source of speed, not of poses.

    Velocities are read as m/s along the axes of the world, times as us on the events' clock.

    Args:
        path: the HDF5 file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no velocities, other shapes than ``(N, 3)`` and ``(N,)`` with two or more, speeds that no
            car has, or times that do not ascend.

    Attributes:
        times: ``(N,)`` int64, us.
        speeds: ``(N,)`` float64, m/s.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        load_filters()
        with Hdf5Reader(self.path) as reader:
            shapes = reader.dataset(VELOCITY).shape, reader.dataset(TIMES).shape
            if len(shapes[0]) != 2 or shapes[0][1] != 3 or shapes[1] != shapes[0][:1] or shapes[1][0] < 2:
                raise ValueError(
                    f"{self.path}: found {VELOCITY} {shapes[0]} and {TIMES} {shapes[1]}, "
                    "expected (N, 3) and (N,), at least 2"
                )
            self.times: NDArray[np.int64] = checked_times(
                f"{self.path}: {TIMES}", reader.read(TIMES, slice(None))
            )
            velocities = reader.read(VELOCITY, slice(None)).astype(np.float64)
        self.speeds: NDArray[np.float64] = np.linalg.norm(velocities, axis=1)
        fine = self.speeds <= MAX_SPEED  # not where it is NaN
        if not fine.all():
            k = int(np.argmin(fine))
            raise ValueError(
                f"{self.path}: {VELOCITY}[{k}]: found {velocities[k].tolist()}, "
                f"expected a velocity of at most {MAX_SPEED:g} m/s"
            )

    def __len__(self) -> int:
        return len(self.times)

    def motion(self, times: NDArray[np.int64]) -> Motion:
        """The speed at ``times``, us, between the two around each; no poses.

        Nothing is known outside the track, and where two speeds are more than ``MAX_GAP_US`` apart.
        """
        after = np.searchsorted(self.times, times, side="right").clip(1, len(self.times) - 1)
        first, last = self.times[after - 1], self.times[after]
        known = (times >= first) & (times <= last) & (last - first <= MAX_GAP_US)
        motion = Motion.unknown(len(times))
        motion.speed[known] = np.interp(times[known], self.times, self.speeds)
        return motion


def holds_navigation(path: Path) -> bool:
    """Whether an HDF5 file has EvTTC's velocities; raises as :class:`nl_env.elidar.hdf5.Hdf5Reader`."""
    with Hdf5Reader(path) as reader:
        return VELOCITY in reader.file
