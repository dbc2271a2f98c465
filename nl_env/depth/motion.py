"""Ego motion between two depth frames: a small projective ICP on inverse depth.

Every pixel of the old frame is moved, projected into the new one, and compared with the surface found
there. The residual is the difference of inverse depth along the ray; linearised with the new frame's
inverse-depth slope it is the point-to-plane distance of projective ICP, and it stays finite for the
sky, whose outline is good evidence outdoors. Coarse to fine, from several starts, with bounded
weights against moving objects, edges and disocclusions.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from nl_env.depth.motion_kernels import FINEST_WIDTH, align, costs_ahead, halved
from nl_env.depth.threads import together, usable_threads
from nl_env.depth.warp import inverse_depth
from nl_env.types import Camera

STRIDE = 2
"""The finest level compares every second pixel of every second row."""

SCALES = (0.005, 0.01, 0.02, 0.05)
"""Relative residual from which a pixel is an outlier, finest level first. Blurred edges bias the
estimate towards longer motions, so the finest levels trust clean surfaces only."""

ITERATIONS = 15
"""Gauss-Newton steps a level at most."""

CONVERGED = 3e-4
"""A level ends when the largest component of its step (m, rad) is below this."""

STARTS = (0.0, 1.0, 2.0, 3.0)
"""Metres forward from the guess that the coarsest level is tried from; the best one is refined.
Small motions are found from any of them, fast driving (30 m/s at 10 Hz) needs the far ones."""

AHEAD_STEP, AHEAD_MOST = 0.25, 3.25
"""Metres forward from the guess that are compared once more at the finest level. Blurred by the coarser
ones, a road between rows of distant trees looks best when nothing moves at all: fast drives would be
taken for standing still."""

_DAMPING = np.array([1e-6, 1e-6, 1e-6, 1e-4, 1e-4, 1e-4])
"""Added to the mean normal equations: what the frames do not determine stays at the start."""


def se3_exp(twist: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rigid motion ``(4, 4)`` of a twist ``(6,)``: translation part (m), then rotation vector (rad)."""
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(twist[3:]).as_matrix()
    motion[:3, 3] = _mean_rotation(twist[3:]) @ twist[:3]
    return motion


def se3_log(motion: NDArray[np.float64]) -> NDArray[np.float64]:
    """The twist ``(6,)`` of a rigid motion ``(4, 4)``; the inverse of :func:`se3_exp`."""
    rotation = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    return np.concatenate([np.linalg.solve(_mean_rotation(rotation), motion[:3, 3]), rotation])


def continued(motion: NDArray[np.float64], fraction: float) -> NDArray[np.float64]:
    """Constant velocity: the motion over ``fraction`` times the duration of ``motion`` (4x4)."""
    return se3_exp(fraction * se3_log(motion))


def estimate_motion(
    old: NDArray[np.float32],
    new: NDArray[np.float32],
    camera: Camera,
    max_depth: float,
    guess: NDArray[np.float64] | None = None,
    *,
    threads: int | None = None,
) -> NDArray[np.float64]:
    """Rigid motion that takes points from the old frame's camera to the new frame's.

    Directions the frames do not determine (the way along a featureless road; everything, when a
    frame has no return) stay at ``guess``.

    Args:
        old, new: ``(H, W)`` float32 m, 0 = no return.
        camera: intrinsics of both.
        max_depth: sensor range, m.
        guess: ``(4, 4)`` start, for instance the previous motion; default standing still.
        threads: at most, see :func:`nl_env.depth.threads.usable_threads`; the result is the same.

    Returns:
        ``(4, 4)`` float64.

    Raises:
        ValueError: a frame does not have the camera's shape or ``guess`` is not ``(4, 4)``.
    """
    for name, frame in (("old", old), ("new", new)):
        if frame.shape != camera.shape:
            raise ValueError(f"{name}: found shape {frame.shape}, expected the camera's, {camera.shape}")
    start = np.eye(4) if guess is None else np.ascontiguousarray(guess, np.float64)
    if start.shape != (4, 4):
        raise ValueError(f"guess: found shape {start.shape}, expected (4, 4)")

    threads = usable_threads(camera.shape, threads)
    sources = _pyramid(inverse_depth(np.ascontiguousarray(old, np.float32), max_depth))
    targets = _pyramid(inverse_depth(np.ascontiguousarray(new, np.float32), max_depth))
    levels = [
        (source, target, _intrinsics(camera, source.shape[0]), scale, STRIDE if source is sources[0] else 1)
        for source, target, scale in zip(sources, targets, SCALES, strict=False)
    ]
    *finer, coarsest = levels
    starts = [_ahead(start, metres) for metres in STARTS]
    aligned = [(math.inf, start)] * len(starts)

    def try_starts(first: int) -> None:
        for k in range(first, len(starts), threads):
            aligned[k] = align(*coarsest, starts[k], ITERATIONS, CONVERGED, _DAMPING)

    together([partial(try_starts, first) for first in range(threads)], threads)
    cost, motion = min(aligned, key=lambda trial: trial[0])
    for level in reversed(finer):
        cost, motion = align(*level, motion, ITERATIONS, CONVERGED, _DAMPING)
    finest = levels[0]
    places = start[2, 3] - np.arange(0.0, AHEAD_MOST + AHEAD_STEP / 2, AHEAD_STEP)
    costs = np.empty(len(places))

    def compare(first: int) -> None:
        costs_ahead(*finest, motion, places[first::threads], costs[first::threads])

    together([partial(compare, first) for first in range(threads)], threads)
    other = motion.copy()
    other[2, 3] = places[np.argmin(np.nan_to_num(costs, nan=np.inf))]
    other_cost, other = align(*finest, other, ITERATIONS, CONVERGED, _DAMPING)
    return other if other_cost < cost else motion


class IntervalMotion:
    """:func:`estimate_motion` between two LiDAR frames, kept until other frames come."""

    def __init__(self) -> None:
        self._frames: tuple[NDArray[np.float32], ...] = ()
        self._motion, self._twist = np.eye(4), np.zeros(6)

    def __call__(
        self,
        previous: NDArray[np.float32],
        last: NDArray[np.float32],
        camera: Camera,
        max_depth: float,
        threads: int | None = None,
    ) -> NDArray[np.float64]:
        """Motion ``(4, 4)`` from ``previous`` to ``last``, which are told apart by identity."""
        if not (self._frames and self._frames[0] is previous and self._frames[1] is last):
            self._motion = estimate_motion(previous, last, camera, max_depth, threads=threads)
            self._twist = se3_log(self._motion)
            self._frames = (previous, last)
        return self._motion

    def continued(self, fraction: float) -> NDArray[np.float64]:
        """:func:`continued` for the motion that was asked for last."""
        return se3_exp(fraction * self._twist)


def _ahead(motion: NDArray[np.float64], metres: float) -> NDArray[np.float64]:
    """``motion``, and then this many metres along the optical axis."""
    ahead = motion.copy()
    ahead[2, 3] -= metres
    return ahead


def _mean_rotation(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """The mean rotation matrix on the way to a rotation vector: ``t = V v`` in the SE(3) exponential."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-4:
        return np.eye(3) + cross / 2 + cross @ cross / 6
    cosine = (1 - math.cos(angle)) / angle**2
    sine = (angle - math.sin(angle)) / angle**3
    return np.eye(3) + cosine * cross + sine * cross @ cross


def _intrinsics(camera: Camera, rows: int) -> NDArray[np.float64]:
    """``fx, fy, cx, cy`` of the camera at the pyramid level with this many rows."""
    factor = 2.0 ** round(math.log2(camera.height / rows))
    return np.array(
        [
            camera.fx / factor,
            camera.fy / factor,
            (camera.cx + 0.5) / factor - 0.5,
            (camera.cy + 0.5) / factor - 0.5,
        ]
    )


def _pyramid(image: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """Box-averaged halvings, finest first; a plane's inverse depth stays exact when averaged."""
    while image.shape[1] > FINEST_WIDTH:
        image = halved(image)
    levels = [image]
    while len(levels) < len(SCALES) and min(levels[-1].shape) >= 16:
        levels.append(halved(levels[-1]))
    return levels
