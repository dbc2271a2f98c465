"""Error against frame rate as curves: what each family of policies reaches, and how much of the possible.

A family's curve (:mod:`nl_env.curves`) is the hull of its operating points and those of holding always and of
triggering always.

*Regret* compares curves over all frame rates from the LiDAR's own to one frame per slice: the area between a
family's curve and the optimal oracle's, divided by the area between periodic triggering's and the oracle's.
Periodic triggering has regret 1, the oracle 0. "Periodic" here is the best that spreading triggers evenly can
do: the hull of the families :data:`PERIODIC`.

Every sequence counts the same, all policies play the same sequences, and the bootstrap draws sequences for
all of them at once: intervals of differences are paired.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nl_env.curves import Curve, OperatingPoints, Points
from nl_env.evaluation import CONFIDENCE, Estimate, share

PERIODIC = ("periodic", "evenly")
"""Families whose common curve has regret 1."""
ENDS = ("never", "always")
"""Policies that bound every curve."""
MATCHED_RATES = (20.0, 27.8, 40.6, 47.3)
"""Effective frame rates at which families are compared, Hz: the paper's lowest, mean and highest, and 20."""
BASELINE = "keyframe-cnn"
"""The paper's detector; differences from it are reported where it took part."""
CURVE_STEP = 0.5
"""Spacing of the curves in reports, Hz."""


@dataclass(frozen=True)
class Matched:
    """A family at one effective frame rate, interpolated on its curve.

    Attributes:
        rate: Hz.
        error: held-depth error.
        saved: error of periodic triggering at that rate minus the family's, paired.
        below_baseline: error of the :data:`BASELINE` minus the family's, paired; None without the baseline.
        closed: share of the gap between periodic triggering and the oracle that the family closes.
    """

    rate: float
    error: Estimate
    saved: Estimate
    below_baseline: Estimate | None
    closed: Estimate


@dataclass(frozen=True)
class FamilyCurve:
    """A family of policies against periodic triggering and the oracle.

    Attributes:
        family: its name.
        runs: trainings whose curves were averaged; 1 for what is not trained.
        regret: see the module; the interval is over sequences.
        regret_low, regret_high: lowest and highest regret of one training.
        matched: one per rate of :data:`MATCHED_RATES` within the curves.
        rate: ``(n,)`` Hz, every :data:`CURVE_STEP`.
        error, error_low, error_high: ``(n,)`` mean error at those rates, and its interval over sequences.
        rate_for_periodic: Hz at which the family reaches the error of periodic triggering at
            :data:`MATCHED_RATES` ``[2]``, the mean rate of the paper's rule.
    """

    family: str
    runs: int
    regret: Estimate
    regret_low: float
    regret_high: float
    matched: tuple[Matched, ...]
    rate: Points
    error: Points
    error_low: Points
    error_high: Points
    rate_for_periodic: Estimate


@dataclass(frozen=True)
class Frontier:
    """All families, the oracle and periodic triggering among them, by ascending regret."""

    families: tuple[FamilyCurve, ...]

    def __getitem__(self, family: str) -> FamilyCurve:
        for curve in self.families:
            if curve.family == family:
                return curve
        raise KeyError(family)


ORACLE = "oracle"
"""Name of the optimal oracle's curve."""
PERIODIC_CURVE = "periodic"
"""Name of the common curve of :data:`PERIODIC`."""


def frontier(
    families: Mapping[str, Sequence[OperatingPoints]],
    oracle: OperatingPoints,
    ends: OperatingPoints,
    resamples: NDArray[np.int64],
) -> Frontier:
    """Curves, regrets and matched operating points of ``families``.

    Args:
        families: operating points of each family, one entry for each training; those of :data:`PERIODIC` are
            the reference, and at least one of them is needed.
        oracle: of :func:`oracle_points`.
        ends: holding always and triggering always.
        resamples: ``(n, sequences)`` bootstrap indices.

    Raises:
        ValueError: no family of :data:`PERIODIC`.
    """
    sequences = ends.rate.shape[1]
    weights = _weights(resamples, sequences)
    periodic = [points for name in PERIODIC for points in families.get(name, ())]
    if not periodic:
        raise ValueError(
            f"families: found {sorted(families)}, expected one of {', '.join(PERIODIC)} among them"
        )
    groups: dict[str, Sequence[OperatingPoints]] = {PERIODIC_CURVE: [periodic[0].joined(*periodic[1:])]}
    groups |= {name: points for name, points in families.items() if name not in PERIODIC}
    low, high = (float(rate) for rate in np.sort(ends.rate.mean(axis=1))[[0, -1]])
    grid = np.linspace(low, high, round((high - low) / CURVE_STEP) + 1)
    rates = np.concatenate([grid, [rate for rate in MATCHED_RATES if low <= rate <= high]])

    sampled = {
        name: [_Sampled.of(points.joined(ends), weights, rates, low, high) for points in runs]
        for name, runs in groups.items()
    }
    reference = sampled[PERIODIC_CURVE][0]
    floor = _Sampled.of(oracle.joined(ends), weights, rates, low, high)
    target = _column(reference.errors, rates, MATCHED_RATES[2])
    baseline = _mean_errors(sampled[BASELINE]) if BASELINE in sampled else None
    every = {**sampled, ORACLE: [floor]}
    summaries = [
        _summary(name, runs, reference, floor, baseline, rates, len(grid), target)
        for name, runs in every.items()
    ]
    return Frontier(tuple(sorted(summaries, key=lambda curve: curve.regret.mean)))


@dataclass(frozen=True)
class _Sampled:
    """One curve on all sequences (row 0) and on every resample."""

    curves: list[Curve]
    errors: Points
    """``(1 + n, rates)``."""
    areas: Points
    """``(1 + n,)``."""

    @classmethod
    def of(cls, points: OperatingPoints, weights: Points, rates: Points, low: float, high: float) -> _Sampled:
        curves = points.curves(weights)
        return cls(
            curves,
            np.array([curve.at(rates) for curve in curves]),
            np.array([curve.area(low, high) for curve in curves]),
        )


def _summary(
    name: str,
    runs: Sequence[_Sampled],
    periodic: _Sampled,
    oracle: _Sampled,
    baseline: Points | None,
    rates: Points,
    shown: int,
    target: Points | None,
) -> FamilyCurve:
    errors = _mean_errors(runs)
    gap = periodic.areas - oracle.areas
    regrets = np.array([share(run.areas - oracle.areas, gap) for run in runs])
    low, high = _interval(errors[:, :shown])
    reached = np.full(len(errors), math.nan)
    if target is not None:
        reached = np.mean(
            [[c.rate_for(t) for c, t in zip(run.curves, target, strict=True)] for run in runs], axis=0
        )
    return FamilyCurve(
        family=name,
        runs=len(runs),
        regret=_estimate(regrets.mean(axis=0)),
        regret_low=float(regrets[:, 0].min()),
        regret_high=float(regrets[:, 0].max()),
        matched=tuple(
            Matched(
                rate=float(rates[i]),
                error=_estimate(errors[:, i]),
                saved=_estimate(periodic.errors[:, i] - errors[:, i]),
                below_baseline=None if baseline is None else _estimate(baseline[:, i] - errors[:, i]),
                closed=_estimate(
                    share(periodic.errors[:, i] - errors[:, i], periodic.errors[:, i] - oracle.errors[:, i])
                ),
            )
            for i in range(shown, len(rates))
        ),
        rate=rates[:shown],
        error=errors[0, :shown],
        error_low=low,
        error_high=high,
        rate_for_periodic=_estimate(reached),
    )


def _weights(resamples: NDArray[np.int64], sequences: int) -> Points:
    """``(1 + n, sequences)``: all sequences alike, then how often each resample drew them."""
    if resamples.ndim != 2 or resamples.shape[1] != sequences:
        raise ValueError(f"resamples: found shape {resamples.shape}, expected (n, {sequences})")
    drawn = np.array([np.bincount(row, minlength=sequences) for row in resamples])
    return np.concatenate([np.ones((1, sequences)), drawn]) / sequences


def _mean_errors(runs: Sequence[_Sampled]) -> Points:
    """``(1 + n, rates)`` mean over trainings."""
    return np.mean([run.errors for run in runs], axis=0)


def _column(errors: Points, rates: Points, rate: float) -> Points | None:
    found = np.flatnonzero(rates == rate)
    return errors[:, found[-1]] if len(found) else None


def _interval(values: Points) -> tuple[Points, Points]:
    """Percentiles over the resamples, rows 1.. of ``values``."""
    low, high = np.nanquantile(values[1:], [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], axis=0)
    return low, high


def _estimate(values: Points) -> Estimate:
    """Row 0 is the estimate, the others its resamples; nan when nothing could be computed."""
    if not np.isfinite(values[1:]).any() or not math.isfinite(values[0]):
        return Estimate(math.nan, math.nan, math.nan)
    low, high = _interval(values)
    return Estimate(float(values[0]), float(low), float(high))
