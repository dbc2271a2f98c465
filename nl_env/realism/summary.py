"""Averages over worlds, with standard errors, of everything the realism command prints."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nl_env.depth.metrics import METRIC_NAMES
from nl_env.realism.network import CONTROLS, batch_norm_distance
from nl_env.realism.published import GAPS_MS
from nl_env.realism.world import WorldReport
from nl_env.types import SLICE_US

SPEED_BANDS_KMH = ((0.0, 10.0), (10.0, 20.0), (20.0, 30.0), (30.0, 40.0), (40.0, 50.0), (50.0, math.inf))
"""Ego speeds that are shown apart, km/h."""
CAUSES = ("speed", "distance", "new actor")


@dataclass(frozen=True)
class Mean:
    """A mean and its standard error over worlds; nan where there is nothing (one world has no error)."""

    value: float
    error: float


@dataclass(frozen=True)
class GapRow:
    """One gap; metrics by name, the same pairs in each dictionary.

    Attributes:
        gap_ms: prior to truth.
        repeat: metrics of the prior.
        prior_sky: share of valid pixels whose prior is sky.
        depth_change: mean absolute change of depth, m.
        active: share of pixels with an event within the gap.
    """

    gap_ms: int
    repeat: dict[str, Mean]
    prior_sky: Mean
    depth_change: Mean
    active: Mean


@dataclass(frozen=True)
class SpeedRow:
    """Pairs whose ego speed is in ``[low, high)`` km/h: depth change (m) and active pixels at each gap."""

    low_kmh: float
    high_kmh: float
    pairs: int
    depth_change: tuple[Mean, ...]
    active: tuple[Mean, ...]


@dataclass(frozen=True)
class GroupRow:
    """Worlds of one scenario or style: Repeat RMSE (m) and delta < 1.25 at each gap, frame rate (Hz)."""

    name: str
    worlds: int
    rmse: tuple[float, ...]
    delta_1: tuple[float, ...]
    rate: float


@dataclass(frozen=True)
class KeyframeSummary:
    """Labels of the keyframe rule and the effective frame rate they give.

    Attributes:
        share: of slices that are keyframes.
        causes: by cause, share of the keyframes that have it.
        alone: by cause, share of the keyframes that have no other.
        rate: effective frame rate over sequences, Hz; ``rate_min`` and ``rate_max`` are the extremes.
        rate_inside: share of sequences between 20 and 50 Hz, both included.
    """

    share: Mean
    causes: dict[str, float]
    alone: dict[str, float]
    rate: Mean
    rate_min: float
    rate_max: float
    rate_inside: float


@dataclass(frozen=True)
class NetworkRow:
    """The checkpoint at one gap.

    Attributes:
        gap_ms: prior to truth.
        pairs: number of pairs it ran on.
        network, repeat: metrics of the checkpoint and of the prior on those pairs.
        control_pairs: number of pairs the controls ran on.
        rmse_ratio: RMSE over Repeat's on those pairs, by name out of ``CONTROLS``.
    """

    gap_ms: int
    pairs: int
    network: dict[str, Mean]
    repeat: dict[str, Mean]
    control_pairs: int
    rmse_ratio: dict[str, float]


@dataclass(frozen=True)
class BatchNormDistance:
    """Mean distance over the layers of the event stem, of the depth stem, and of the whole network."""

    event_stem: float
    depth_stem: float
    network: float
    layers: dict[str, float]


@dataclass(frozen=True)
class Summary:
    """Everything; ``network`` is empty and ``batch_norms`` None without a checkpoint."""

    worlds: int
    pairs: int
    gaps: tuple[GapRow, ...]
    speeds: tuple[SpeedRow, ...]
    groups: tuple[GroupRow, ...]
    keyframes: KeyframeSummary
    statistics: dict[str, float]
    network: tuple[NetworkRow, ...]
    batch_norms: BatchNormDistance | None


def summarise(
    reports: Sequence[WorldReport], checkpoint: str | None = None, lidar_period: int = 5
) -> Summary:
    """Average over worlds.

    Args:
        reports: at least one world.
        checkpoint: the file the worlds were measured with, for the batch-norm distance.
        lidar_period: slices between LiDAR frames, for the effective frame rate.

    Raises:
        ValueError: no world.
    """
    if not reports:
        raise ValueError("reports: found none, expected at least one world")
    probed = sum(r.probed for r in reports)
    rates = np.array([effective_rate(r.labels, lidar_period) for r in reports])
    return Summary(
        worlds=len(reports),
        pairs=len(reports[0].speed),
        gaps=tuple(_gap_row(reports, g) for g in range(len(GAPS_MS))),
        speeds=tuple(_speed_row(reports, low, high) for low, high in SPEED_BANDS_KMH),
        groups=_groups(reports, rates),
        keyframes=_keyframes(reports, rates),
        statistics=_statistics(reports),
        network=tuple(_network_row(reports, g) for g in range(len(GAPS_MS))) if probed else (),
        batch_norms=_batch_norms(checkpoint, reports, probed) if checkpoint and probed else None,
    )


def clustered_mean(worlds: Sequence[NDArray[np.float64]]) -> Mean:
    """Mean over all values and its standard error over worlds; nan values are left out.

    Worlds may hold different numbers of values: this is the ratio estimator of a cluster sample, and with
    equal numbers the standard error of the mean of the worlds' means.
    """
    kept = [values[np.isfinite(values)] for values in worlds]
    kept = [values for values in kept if values.size]
    total = sum(values.size for values in kept)
    if total == 0:
        return Mean(math.nan, math.nan)
    mean = sum(float(values.sum()) for values in kept) / total
    if len(kept) == 1:
        return Mean(mean, math.nan)
    residuals = np.array([float((values - mean).sum()) for values in kept])
    return Mean(mean, math.sqrt(len(kept) / (len(kept) - 1) * float((residuals**2).sum())) / total)


def effective_rate(keyframes: NDArray[np.bool_], lidar_period: int) -> float:
    """Depth frames per second, Hz, when every keyframe of slices 1, 2, ... triggers an extrapolation."""
    slices = np.arange(1, len(keyframes) + 1)
    frames = np.count_nonzero(keyframes | (slices % lidar_period == 0))
    return frames * 1e6 / (len(keyframes) * SLICE_US)


def _metrics(worlds: Sequence[NDArray[np.float64]]) -> dict[str, Mean]:
    """Metrics by name out of ``(P, M)`` arrays, one per world."""
    return {name: clustered_mean([w[:, m] for w in worlds]) for m, name in enumerate(METRIC_NAMES)}


def _gap_row(reports: Sequence[WorldReport], g: int) -> GapRow:
    return GapRow(
        gap_ms=GAPS_MS[g],
        repeat=_metrics([r.repeat[:, g] for r in reports]),
        prior_sky=clustered_mean([r.prior_sky[:, g] for r in reports]),
        depth_change=clustered_mean([r.depth_change[:, g] for r in reports]),
        active=clustered_mean([r.active[:, g] for r in reports]),
    )


def _speed_row(reports: Sequence[WorldReport], low: float, high: float) -> SpeedRow:
    chosen = [(3.6 * r.speed >= low) & (3.6 * r.speed < high) for r in reports]

    def by_gap(values: Callable[[WorldReport], NDArray[np.float64]]) -> tuple[Mean, ...]:
        return tuple(
            clustered_mean([values(r)[k, g] for r, k in zip(reports, chosen, strict=True)])
            for g in range(len(GAPS_MS))
        )

    pairs = int(sum(k.sum() for k in chosen))
    return SpeedRow(low, high, pairs, by_gap(lambda r: r.depth_change), by_gap(lambda r: r.active))


def _groups(reports: Sequence[WorldReport], rates: NDArray[np.float64]) -> tuple[GroupRow, ...]:
    """By scenario, then by style."""
    rows = []
    for part in (0, 1):
        for name in sorted({r.description[part] for r in reports}):
            members = [i for i, r in enumerate(reports) if r.description[part] == name]
            repeat = np.nanmean(np.concatenate([reports[i].repeat for i in members]), axis=0)
            rmse, delta = (tuple(repeat[:, METRIC_NAMES.index(m)].tolist()) for m in ("rmse", "delta_1"))
            rows.append(GroupRow(name, len(members), rmse, delta, float(rates[members].mean())))
    return tuple(rows)


def _keyframes(reports: Sequence[WorldReport], rates: NDArray[np.float64]) -> KeyframeSummary:
    causes = np.concatenate([r.keyframes for r in reports])
    found = max(int(causes.any(axis=1).sum()), 1)
    alone = causes & (causes.sum(axis=1, keepdims=True) == 1)
    return KeyframeSummary(
        share=clustered_mean([r.labels.astype(np.float64) for r in reports]),
        causes={name: float(causes[:, i].sum()) / found for i, name in enumerate(CAUSES)},
        alone={name: float(alone[:, i].sum()) / found for i, name in enumerate(CAUSES)},
        rate=clustered_mean([np.array([rate]) for rate in rates]),
        rate_min=float(rates.min()),
        rate_max=float(rates.max()),
        rate_inside=float(((rates >= 20) & (rates <= 50)).mean()),
    )


def _statistics(reports: Sequence[WorldReport]) -> dict[str, float]:
    """By the names of ``published.CHECKPOINT_MEMORY``; moments are pooled as batch norms pool them."""
    mean, square = np.concatenate([r.depth_moments for r in reports]).mean(axis=0)
    top, bottom, left, right = np.concatenate([r.border for r in reports]).mean(axis=0)
    near, far = np.sqrt(np.concatenate([r.steps for r in reports]).mean(axis=0))
    bins = np.concatenate([r.bins for r in reports])
    simulated = np.isfinite(bins).all(axis=(1, 2))
    power, active, product = bins[simulated].mean(axis=(0, 1)) if simulated.any() else (math.nan,) * 3
    return {
        "depth mean, sky = 0 (m)": float(mean),
        "depth standard deviation, sky = 0 (m)": math.sqrt(square - mean**2),
        "depth mean of the top row (m)": float(top),
        "depth mean of the bottom row (m)": float(bottom),
        "depth mean of the left column (m)": float(left),
        "depth mean of the right column (m)": float(right),
        "RMS difference of neighbours, 1 px (m)": float(near),
        "RMS difference of neighbours, 2 px (m)": float(far),
        "pixels without depth": float(np.concatenate([r.no_return for r in reports]).mean()),
        "voxel bin standard deviation": math.sqrt(power),
        "active pixels per bin": float(active),
        "RMS count where active": math.sqrt(power / active) if active else math.nan,
        "correlation of adjacent bins": float(product / power) if power else math.nan,
    }


def _network_row(reports: Sequence[WorldReport], g: int) -> NetworkRow:
    """Repeat is averaged over the very pairs the network, or a control, ran on."""
    rmse = METRIC_NAMES.index("rmse")
    ran = [np.isfinite(r.network[:, g, 0, rmse]) for r in reports]
    tried = [np.isfinite(r.network[:, g, -1, rmse]) for r in reports]
    ours = np.concatenate([r.network[k, g, :, rmse] for r, k in zip(reports, tried, strict=True)])
    prior = np.concatenate([r.repeat[k, g, rmse] for r, k in zip(reports, tried, strict=True)])
    ratio = ours.mean(axis=0) / prior.mean() if len(prior) else np.full(len(CONTROLS), math.nan)
    return NetworkRow(
        gap_ms=GAPS_MS[g],
        pairs=int(sum(k.sum() for k in ran)),
        network=_metrics([r.network[k, g, 0] for r, k in zip(reports, ran, strict=True)]),
        repeat=_metrics([r.repeat[k, g] for r, k in zip(reports, ran, strict=True)]),
        control_pairs=len(prior),
        rmse_ratio=dict(zip(CONTROLS, ratio.tolist(), strict=True)),
    )


def _batch_norms(checkpoint: str, reports: Sequence[WorldReport], probed: int) -> BatchNormDistance:
    moments = np.sum([r.moments for r in reports], axis=0)
    layers = dict(batch_norm_distance(checkpoint, moments, probed))

    def mean(prefix: str) -> float:
        return float(np.mean([d for name, d in layers.items() if name.startswith(prefix)]))

    return BatchNormDistance(mean("event_stem."), mean("depth_stem."), mean(""), layers)
