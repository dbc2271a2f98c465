"""Operating points, their curves of error against frame rate, and the optimal oracle's.

An operating point is a policy with its parameter. Between two of them a consumer can switch over time, which
gives every error and rate on the straight line between them (time-sharing): what points reach together is
their lower convex hull.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

ROUNDING = 1e-6
"""Differences between rates that mean nothing, Hz."""
PRICES = np.geomspace(1e-6, 1.0, 160)
"""Errors that a trigger must save to be worth it: the operating points of the optimal oracle."""

Points = NDArray[np.float64]


@dataclass(frozen=True)
class OperatingPoints:
    """What the policies of one family, trained once, reach on every sequence.

    Attributes:
        rate: ``(points, sequences)`` effective frame rate, Hz.
        error: ``(points, sequences)`` held-depth error.
    """

    rate: Points
    error: Points

    def __post_init__(self) -> None:
        if self.rate.ndim != 2 or self.rate.shape != self.error.shape or not self.rate.size:
            raise ValueError(
                f"points: found rates of shape {self.rate.shape} and errors of shape {self.error.shape}, "
                "expected both (points, sequences), at least one of each"
            )

    def joined(self, *others: OperatingPoints) -> OperatingPoints:
        """These points and those of ``others`` together."""
        every = (self, *others)
        return OperatingPoints(
            np.concatenate([points.rate for points in every]),
            np.concatenate([points.error for points in every]),
        )

    def curves(self, weights: Points) -> list[Curve]:
        """One hull for each row of ``weights`` ``(n, sequences)``, which sum to 1."""
        rates, errors = weights @ self.rate.T, weights @ self.error.T
        return [lower_hull(rate, error) for rate, error in zip(rates, errors, strict=True)]


@dataclass(frozen=True)
class Curve:
    """A convex, piecewise linear curve.

    Attributes:
        rate: ``(n,)`` strictly ascending, Hz.
        error: ``(n,)``.
    """

    rate: Points
    error: Points

    def at(self, rates: Points) -> Points:
        """Errors at ``rates``; nan outside the curve, where rounding is none."""
        ends = self.rate[[0, -1]]
        snapped = np.where(np.abs(rates - ends[0]) < ROUNDING, ends[0], rates)
        snapped = np.where(np.abs(rates - ends[1]) < ROUNDING, ends[1], snapped)
        return np.interp(snapped, self.rate, self.error, left=math.nan, right=math.nan)

    def area(self, low: float, high: float) -> float:
        """Exact integral between two rates; nan where the curve does not reach them."""
        inside = self.rate[(self.rate > low) & (self.rate < high)]
        rates = np.concatenate([[low], inside, [high]])
        errors = self.at(rates)
        return float(np.sum(np.diff(rates) * (errors[1:] + errors[:-1]) / 2))

    def rate_for(self, error: float) -> float:
        """Lowest rate at which the error is at most ``error``; nan where it never is."""
        reached = np.flatnonzero(self.error <= error)
        if not len(reached):
            return math.nan
        i = int(reached[0])
        if i == 0:
            return float(self.rate[0])
        part = (self.error[i - 1] - error) / (self.error[i - 1] - self.error[i])
        return float(self.rate[i - 1] + part * (self.rate[i] - self.rate[i - 1]))


def lower_hull(rate: Points, error: Points) -> Curve:
    """The lower convex hull of points ``(n,)``, from the lowest rate to the highest."""
    order = np.lexsort((error, rate))
    x: list[float] = []
    y: list[float] = []
    for i in order:
        px, py = float(rate[i]), float(error[i])
        if x and px == x[-1]:
            continue  # the lower of two points at one rate came first
        while len(x) > 1 and (y[-1] - y[-2]) * (px - x[-2]) >= (py - y[-2]) * (x[-1] - x[-2]):
            x.pop()
            y.pop()
        x.append(px)
        y.append(py)
    return Curve(np.array(x), np.array(y))


def oracle_points(
    floors: Sequence[Points], lidar_frames: int, slices: int, duration_s: float
) -> OperatingPoints:
    """The optimal oracle that pays one price per trigger in all sequences, for every price of :data:`PRICES`.

    Its hull is the least mean error at every mean rate, however triggers are spread over the sequences.

    Args:
        floors: per sequence ``(n + 1,)`` least sum of errors over its slices for 0..n triggers.
        lidar_frames, slices, duration_s: LiDAR frames and slices after t = 0 of every sequence; its length.
    """
    rates, errors = [], []
    for floor in floors:
        triggers = np.argmin(floor + PRICES[:, None] * np.arange(len(floor)), axis=1)
        rates.append((lidar_frames + triggers) / duration_s)
        errors.append(floor[triggers] / slices)
    return OperatingPoints(np.array(rates).T, np.array(errors).T)
