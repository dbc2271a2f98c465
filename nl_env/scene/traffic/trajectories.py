"""What a finished traffic simulation is: lanes, actors, and where each of them is at any microsecond.

Trajectories are uniform cubic B-splines whose control points are the simulated poses. Unlike an interpolating
spline such a curve never overshoots: it is twice differentiable (so the acceleration, which pitches the ego's
body, is continuous), stays in the hull of its control points, and is exactly at rest when the vehicle is. It
keeps within ``acceleration * step^2 / 6`` of the simulated positions, 2 mm at 3 m/s^2.

World frame: x, y in metres, z up, right-handed; headings in radians, counter-clockwise from x.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

from nl_env.types import SLICE_US

KNOT_US = 62_500
"""Time between control points, and step of the traffic simulation (16 Hz)."""

LINE_TYPES = ("none", "dashed", "solid")
ACTOR_KINDS = ("car", "truck", "pedestrian")


@njit(cache=True, error_model="numpy")
def evaluate(knots, position, rate):
    """``(3, n)``: value, first and second derivative of n cubic B-splines at ``position`` (in knots).

    ``knots`` is ``(K, n)``, row k belongs to position ``k - 1``; ``rate`` is knots per second. Everything is
    written in differences of knots, so that equal knots give exactly constant values.
    """
    first = int(position)
    u = position - first
    v = 1.0 - u
    out = np.empty((3, knots.shape[1]))
    for j in range(knots.shape[1]):
        at = knots[first + 1, j]
        before, after = at - knots[first, j], knots[first + 2, j] - at
        beyond = knots[first + 3, j] - knots[first + 2, j]
        pull = (4.0 - 6.0 * v * v + 3.0 * v**3) * after - v**3 * before + u**3 * (after + beyond)
        out[0, j] = at + pull / 6.0
        out[1, j] = rate * (v * v * before + (1.0 + 2.0 * u * v) * after + u * u * beyond) / 2.0
        out[2, j] = rate * rate * (v * (after - before) + u * (beyond - after))
    return out


@dataclass(frozen=True, eq=False)
class Lane:
    """A lane's centre line near the ego's path.

    Attributes:
        points: ``(N, 2)`` float64, m, about every 2 m in driving direction.
        headings: ``(N,)`` float64, rad.
        width: m.
        left, right: line painted on either side as seen by its driver, one of ``LINE_TYPES``.
    """

    points: NDArray[np.float64]
    headings: NDArray[np.float64]
    width: float
    left: str
    right: str


@dataclass(frozen=True)
class Actor:
    """A moving object: one of ``ACTOR_KINDS`` and its bounding box, m."""

    kind: str
    length: float
    width: float
    height: float


@dataclass(frozen=True)
class Crossing:
    """A pedestrian crossing with a light: its middle on the ego's lane, and the heading of that lane."""

    x: float
    y: float
    heading: float


@dataclass(frozen=True)
class EgoMotion:
    """The ego vehicle's centre at one instant.

    Attributes:
        x, y: position, m.
        heading: rad.
        speed: norm of the velocity, m/s.
        acceleration: rate of change of the speed, m/s^2; lateral acceleration is speed times yaw rate.
        yaw_rate: rad/s.
    """

    x: float
    y: float
    heading: float
    speed: float
    acceleration: float
    yaw_rate: float


class Tracks:
    """Poses of several bodies over time.

    Args:
        knots: ``(K, n, 3)`` float64, x, y and unwrapped heading; row k holds for time ``(k - 1) * KNOT_US``.
    """

    def __init__(self, knots: NDArray[np.float64]) -> None:
        self.bodies = knots.shape[1]
        self._rows = np.ascontiguousarray(knots, dtype=np.float64).reshape(len(knots), 3 * self.bodies)
        self._last: tuple[float, NDArray[np.float64]] | None = None

    def at(self, t_us: float) -> NDArray[np.float64]:
        """``(3, n, 3)``: poses, their first and their second derivative (per second) at ``t_us``.

        Not to be written to: camera, labels and renderer ask for the same instant, which is evaluated once.
        """
        last = self._last
        if last is None or last[0] != t_us:
            found = evaluate(self._rows, t_us / KNOT_US, 1e6 / KNOT_US).reshape(3, self.bodies, 3)
            self._last = last = (t_us, found)
        return last[1]

    def sample(self, times_us: NDArray[np.int64]) -> NDArray[np.float64]:
        """``(T, n, 3)`` poses at ``times_us``."""
        return np.stack([self.at(t)[0] for t in times_us.tolist()])


@dataclass(frozen=True, eq=False)
class Traffic:
    """A simulated sequence; build one with :func:`nl_env.scene.traffic.simulate`.

    Times are microseconds in ``[0, duration_us]``; one slice beyond the end is accepted, anything else raises
    ``ValueError``.

    Attributes:
        scenario: one of ``nl_env.config.SCENARIOS``.
        seed: what it was drawn from.
        duration_us: length of the sequence.
        lanes: every lane within 220 m of the ego's path.
        crossings: pedestrian crossings on the ego's way.
        actors: surrounding vehicles and pedestrians, without the ego.
        ego_size: length and width of the ego, m.
        ego_track: one body. ``actor_tracks``: one body per actor.
    """

    scenario: str
    seed: int
    duration_us: int
    lanes: tuple[Lane, ...]
    crossings: tuple[Crossing, ...]
    actors: tuple[Actor, ...]
    ego_size: tuple[float, float]
    ego_track: Tracks
    actor_tracks: Tracks

    def ego(self, t_us: int) -> EgoMotion:
        """Motion of the ego at ``t_us``."""
        self._check(t_us)
        (x, y, heading), (vx, vy, yaw_rate), (ax, ay, _) = self.ego_track.at(t_us)[:, 0].tolist()
        speed = math.hypot(vx, vy)
        acceleration = (vx * ax + vy * ay) / speed if speed > 1e-6 else 0.0
        return EgoMotion(x, y, heading, speed, acceleration, yaw_rate)

    def actor_states(self, t_us: int) -> NDArray[np.float64]:
        """``(n, 4)`` float64: x, y, heading and speed of every one of ``actors`` at ``t_us``."""
        self._check(t_us)
        poses, rates, _ = self.actor_tracks.at(t_us)
        states = np.empty((self.actor_tracks.bodies, 4))
        states[:, :3] = poses
        np.hypot(rates[:, 0], rates[:, 1], out=states[:, 3])
        return states

    def ego_path(self) -> NDArray[np.float64]:
        """``(M, 2)`` float64 positions of the ego every 0.1 s, both ends included."""
        return self.ego_track.sample(np.arange(0, self.duration_us + 1, 100_000))[:, 0, :2]

    def shortest_distance(self, t_us: int) -> float:
        """From the ego's outline to the nearest actor's, m; 0 if they touch, ``inf`` without actors."""
        self._check(t_us)
        ego = self.ego_track.at(t_us)[0, 0]
        return float(nearest(ego, self._ego_size, self.actor_tracks.at(t_us)[0], self._sizes))

    @cached_property
    def _ego_size(self) -> NDArray[np.float64]:
        return np.array(self.ego_size)

    @cached_property
    def _sizes(self) -> NDArray[np.float64]:
        return np.array([(actor.length, actor.width) for actor in self.actors]).reshape(-1, 2)

    def _check(self, t_us: int) -> None:
        if not 0 <= t_us <= self.duration_us + SLICE_US:
            raise ValueError(f"t_us: found {t_us!r}, expected a time in [0, {self.duration_us}] us")


@njit(cache=True, error_model="numpy", inline="always")
def point_distance(x, y, pose, size):
    """Distance of the point (x, y) to the rectangle ``size`` (length, width) at ``pose`` (x, y, heading)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    along = abs(c * (x - pose[0]) + s * (y - pose[1])) - size[0] / 2
    aside = abs(c * (y - pose[1]) - s * (x - pose[0])) - size[1] / 2
    return math.hypot(max(along, 0.0), max(aside, 0.0))


@njit(cache=True, error_model="numpy")
def corner_distance(a, size_a, b, size_b):
    """Smallest distance of the corners of rectangle a to rectangle b."""
    c, s = math.cos(a[2]), math.sin(a[2])
    best = np.inf
    for i in (-0.5, 0.5):
        for j in (-0.5, 0.5):
            x = a[0] + c * i * size_a[0] - s * j * size_a[1]
            y = a[1] + s * i * size_a[0] + c * j * size_a[1]
            best = min(best, point_distance(x, y, b, size_b))
    return best


@njit(cache=True, error_model="numpy")
def separated(a, size_a, b, size_b):
    """Whether a side of rectangle a separates it from rectangle b."""
    c, s = math.cos(b[2] - a[2]), math.sin(b[2] - a[2])
    dx, dy = b[0] - a[0], b[1] - a[1]
    along = abs(math.cos(a[2]) * dx + math.sin(a[2]) * dy)
    aside = abs(math.cos(a[2]) * dy - math.sin(a[2]) * dx)
    reach_along = (abs(c) * size_b[0] + abs(s) * size_b[1]) / 2
    reach_aside = (abs(s) * size_b[0] + abs(c) * size_b[1]) / 2
    return along > size_a[0] / 2 + reach_along or aside > size_a[1] / 2 + reach_aside


@njit(cache=True, error_model="numpy")
def rectangle_distance(a, size_a, b, size_b):
    """Distance between two oriented rectangles: 0 if they overlap, else from a corner of one to the other."""
    if not (separated(a, size_a, b, size_b) or separated(b, size_b, a, size_a)):
        return 0.0
    return min(corner_distance(a, size_a, b, size_b), corner_distance(b, size_b, a, size_a))


@njit(cache=True, error_model="numpy")
def nearest(pose, size, poses, sizes):
    """Smallest :func:`rectangle_distance` from one rectangle to ``n`` others, ``inf`` if n is 0."""
    best = np.inf
    for k in range(len(poses)):
        apart = math.hypot(poses[k, 0] - pose[0], poses[k, 1] - pose[1])
        if apart - (size[0] + size[1] + sizes[k, 0] + sizes[k, 1]) / 2 < best:
            best = min(best, rectangle_distance(pose, size, poses[k], sizes[k]))
    return best


@njit(cache=True, error_model="numpy")
def overlaps(poses, sizes):
    """``(n, n)`` bool: which of n bodies overlap at any of T instants; ``poses`` is ``(T, n, 3)``."""
    n = poses.shape[1]
    met = np.zeros((n, n), dtype=np.bool_)
    for i in range(n):
        for j in range(i):
            reach = (sizes[i, 0] + sizes[i, 1] + sizes[j, 0] + sizes[j, 1]) / 2
            for t in range(len(poses)):
                apart = math.hypot(poses[t, i, 0] - poses[t, j, 0], poses[t, i, 1] - poses[t, j, 1])
                if apart < reach and rectangle_distance(poses[t, i], sizes[i], poses[t, j], sizes[j]) == 0.0:
                    met[i, j] = met[j, i] = True
                    break
    return met
