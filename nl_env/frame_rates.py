"""How the frame rate follows the scene: over time, by speed, and by what kind of drive it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nl_env.comparison import SequenceResult
from nl_env.types import SLICE_US

RATE_WINDOW_S = 1.0
"""Frames are counted over this long for every frame-rate curve."""
SPEED_BIN = 2.5
"""Width of the bins of the rate-against-speed curve, m/s."""
KINDS = ("scenario", "weather", "style")
"""Entries of a sequence's description by which frame rates are averaged."""


def rate_over_time(result: SequenceResult, policy: int) -> NDArray[np.float64]:
    """``(K,)`` effective frame rate around slices 1..K, Hz, in a centred window of ``RATE_WINDOW_S``."""
    frames = _frames_made(result, policy)
    window = np.ones(min(len(frames), int(RATE_WINDOW_S * 1e6) // SLICE_US))
    slices_seen = np.convolve(np.ones(len(frames)), window, mode="same")
    return np.convolve(frames, window, mode="same") / (slices_seen * SLICE_US / 1e6)


@dataclass(frozen=True)
class RateBySpeed:
    """Effective frame rate by ego speed; bins without a window are left out.

    Attributes:
        speed: ``(n,)`` centres of the bins, m/s.
        rate: ``(n,)`` mean effective rate, Hz.
        windows: ``(n,)`` int64, windows of ``RATE_WINDOW_S`` in each bin.
    """

    speed: NDArray[np.float64]
    rate: NDArray[np.float64]
    windows: NDArray[np.int64]


def rate_by_speed(results: Sequence[SequenceResult], policy: int) -> RateBySpeed:
    """Cut all sequences into windows and average the frame rate over windows of similar mean speed."""
    length = int(RATE_WINDOW_S * 1e6) // SLICE_US
    speeds, rates = [], []
    for result in results:
        windows = result.slices // length
        used = slice(0, windows * length)
        speeds.append(result.ego_speed[1:][used].reshape(windows, length).mean(axis=1))
        rates.append(_frames_made(result, policy)[used].reshape(windows, length).sum(axis=1) / RATE_WINDOW_S)
    bins = (np.concatenate(speeds) // SPEED_BIN).astype(np.int64)
    counts = np.bincount(bins)
    totals = np.bincount(bins, weights=np.concatenate(rates))
    filled = np.flatnonzero(counts)
    centres = np.add(filled, 0.5, dtype=np.float64) * SPEED_BIN
    return RateBySpeed(centres, totals[filled] / counts[filled], counts[filled])


@dataclass(frozen=True)
class RateByKind:
    """Effective frame rate by kind of drive.

    Attributes:
        kind: ``(n,)`` names, in alphabetical order.
        rate: ``(n,)`` mean effective rate over its sequences, Hz.
        low, high: ``(n,)`` lowest and highest rate of one sequence.
        sequences: ``(n,)`` their number.
    """

    kind: tuple[str, ...]
    rate: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    sequences: tuple[int, ...]


def rate_by_kind(results: Sequence[SequenceResult], policy: int, entry: str) -> RateByKind:
    """Average the frame rate over the sequences whose description says the same under ``entry``.

    Sequences that say nothing are left out.
    """
    rates: dict[str, list[float]] = {}
    for result in results:
        if entry in result.description:
            rates.setdefault(str(result.description[entry]), []).append(result.records[policy].effective_rate)
    found = sorted(rates.items())
    return RateByKind(
        tuple(kind for kind, _ in found),
        tuple(float(np.mean(values)) for _, values in found),
        tuple(min(values) for _, values in found),
        tuple(max(values) for _, values in found),
        tuple(len(values) for _, values in found),
    )


def _frames_made(result: SequenceResult, policy: int) -> NDArray[np.float64]:
    """``(K,)`` 1 at slices 1..K with a LiDAR or an extrapolated frame, else 0."""
    made = result.lidar[1:].astype(np.float64)
    made[np.array(result.records[policy].triggers, np.int64) - 1] = 1.0
    return made
