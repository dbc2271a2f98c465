"""Camera poses with their times, as M3ED publishes them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from nl_env.config import choice
from nl_env.elidar.hdf5 import Hdf5Reader
from nl_env.importing.ms_indexed import CAMERAS, load_filters
from nl_env.importing.source import checked_times

POSES, TIMES = "Cn_T_C0", "ts"
CAMERA_ATTRIBUTE = "cam_name"
"""Attribute of the file: whose poses they are, e.g. ``/prophesee/left``."""

MAX_GAP_US = 250_000
"""Poses farther apart say nothing about what lies between; M3ED has ten a second."""
RIGID_TOLERANCE = 1e-3

LEVEL_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""From the axes of the first camera (x right, y down, z forward) to a world with z up."""


@dataclass(frozen=True)
class Motion:
    """Where the camera is at some times, and how it moves.

    Attributes:
        pose: ``(n, 4, 4)`` float64, camera to world; NaN where it is not known.
        twist: ``(n, 6)`` float64, camera-frame linear (m/s) and angular (rad/s) velocity; NaN likewise.
        speed: ``(n,)`` float64, m/s; NaN where it is not known.
        known: ``(n,)`` bool, whether there is a pose.
    """

    pose: NDArray[np.float64]
    twist: NDArray[np.float64]
    speed: NDArray[np.float64]
    known: NDArray[np.bool_]

    @classmethod
    def unknown(cls, n: int) -> Motion:
        """Of ``n`` times of which nothing is known."""
        nan = np.nan
        return cls(np.full((n, 4, 4), nan), np.full((n, 6), nan), np.full(n, nan), np.zeros(n, np.bool_))


class PoseTrack:
    """``Cn_T_C0`` and ``ts`` of an M3ED pose or depth file: from the first camera's frame to the n-th's.

    Args:
        path: the HDF5 file.
        camera: ``"left"`` or ``"right"``: a file that says it holds the other camera's poses is refused; None
            takes either.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no poses, other shapes than ``(N, 4, 4)`` and ``(N,)`` with two poses or more, matrices
            that are no rigid motions, or times that do not ascend.

    Attributes:
        times: ``(N,)`` int64, us on the events' clock.
        poses: ``(N, 4, 4)`` float64, camera to world. The world is the first camera's frame with z up and x
            forward, so it is level if that camera was.
    """

    def __init__(self, path: str | Path, camera: str | None = "left") -> None:
        choice("camera", camera, (*CAMERAS, None))
        self.path = Path(path)
        load_filters()
        with Hdf5Reader(self.path) as reader:
            said = reader.file.attrs.get(CAMERA_ATTRIBUTE, camera)
            name = said.decode(errors="replace") if isinstance(said, bytes) else str(said)
            if camera is not None and name.split("/")[-1] != camera:
                raise ValueError(f"{self.path}: found poses of {name}, expected the {camera} camera's")
            shapes = reader.dataset(POSES).shape, reader.dataset(TIMES).shape
            if (
                len(shapes[0]) != 3
                or shapes[0][1:] != (4, 4)
                or shapes[1] != shapes[0][:1]
                or shapes[1][0] < 2
            ):
                raise ValueError(
                    f"{self.path}: found {POSES} {shapes[0]} and {TIMES} {shapes[1]}, "
                    "expected (N, 4, 4) and (N,), at least 2"
                )
            self.times = checked_times(f"{self.path}: {TIMES}", reader.read(TIMES, slice(None)))
            motions = reader.read(POSES, slice(None)).astype(np.float64)
        self._refuse_unless_rigid(motions)
        turns = motions[:, :3, :3].transpose(0, 2, 1)  # of the inverse: camera to first camera
        self.poses = np.tile(np.eye(4), (len(motions), 1, 1))
        self.poses[:, :3, :3] = LEVEL_AXES @ turns
        self.poses[:, :3, 3] = np.einsum("ij,njk,nk->ni", LEVEL_AXES, turns, -motions[:, :3, 3])

    def __len__(self) -> int:
        return len(self.times)

    def motion(self, times: NDArray[np.int64]) -> Motion:
        """Pose and velocity at ``times``, us, from the two poses around each.

        In between, the camera moves along a straight line and turns about one axis, both evenly: the
        velocities are differences of two poses. Nothing is known outside the track, and where two poses are
        more than ``MAX_GAP_US`` apart.
        """
        after = np.searchsorted(self.times, times, side="right").clip(1, len(self.times) - 1)
        first, last = self.times[after - 1], self.times[after]
        known = (times >= first) & (times <= last) & (last - first <= MAX_GAP_US)
        old, new = self.poses[after - 1], self.poses[after]
        seconds = (last - first)[:, None] * 1e-6
        share = ((times - first) / (last - first))[:, None]
        turned = Rotation.from_matrix(old[:, :3, :3])
        turn = (turned.inv() * Rotation.from_matrix(new[:, :3, :3])).as_rotvec()
        now = turned * Rotation.from_rotvec(share * turn)
        pose = np.tile(np.eye(4), (len(times), 1, 1))
        pose[:, :3, :3] = now.as_matrix()
        way = new[:, :3, 3] - old[:, :3, 3]
        pose[:, :3, 3] = old[:, :3, 3] + share * way
        twist = np.concatenate([now.inv().apply(way / seconds), turn / seconds], axis=1)
        speed = np.linalg.norm(way, axis=1) / seconds[:, 0]
        for values in (pose, twist, speed):
            values[~known] = np.nan
        return Motion(pose, twist, speed, known)

    def _refuse_unless_rigid(self, motions: NDArray[np.float64]) -> None:
        turns = motions[:, :3, :3]
        with np.errstate(invalid="ignore", over="ignore"):  # NaN and infinity are found by the comparison
            skew = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
            row = np.abs(motions[:, 3] - [0, 0, 0, 1]).max(axis=1)
            fine = (skew < RIGID_TOLERANCE) & (row < RIGID_TOLERANCE) & np.isfinite(motions).all(axis=(1, 2))
        fine[fine] &= np.linalg.det(turns[fine]) > 0
        if not fine.all():
            k = int(np.argmin(fine))
            raise ValueError(
                f"{self.path}: {POSES}[{k}]: found {motions[k].tolist()}, "
                "expected a rotation and a translation"
            )


def holds_poses(path: Path) -> bool:
    """Whether an HDF5 file has M3ED's poses; raises as :class:`nl_env.elidar.hdf5.Hdf5Reader`."""
    with Hdf5Reader(path) as reader:
        return POSES in reader.file
