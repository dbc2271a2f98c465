"""What the generator has to reach, checked against a summary."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

from nl_env.depth.metrics import PAPER_METRICS
from nl_env.realism import published
from nl_env.realism.network import CONTROLS
from nl_env.realism.summary import Mean, Summary

RMSE_TOLERANCE = 0.10
ABS_REL_TOLERANCE = {20: 0.15, 50: 0.15, 100: 0.15, 200: 0.15, 500: 0.20}
DELTA_TOLERANCE = {20: 0.01, 50: 0.01, 100: 0.01, 200: 0.01, 500: 0.03}
PRIOR_SKY_TOLERANCE = 0.30
NETWORK_TOLERANCE = 0.10
CONTROL_GAIN = 0.10
"""A control may be this much better than Repeat; smoothing the prior at edges alone gains a few percent."""
DEPTH_CHANGE_GAP_MS = 100


@dataclass(frozen=True)
class Target:
    """A figure and the closed range it has to be in."""

    name: str
    value: float
    low: float
    high: float

    @property
    def met(self) -> bool | None:
        """None where it was not measured."""
        return None if math.isnan(self.value) else self.low <= self.value <= self.high


def targets(summary: Summary) -> list[Target]:
    """Every target, in the order of the tables."""
    return [*_repeat(summary), *_motion(summary), *_keyframes(summary), *_network(summary)]


def _around(name: str, mean: Mean, centre: float, tolerance: float) -> Target:
    return Target(name, mean.value, centre * (1 - tolerance), centre * (1 + tolerance))


def _repeat(summary: Summary) -> Iterator[Target]:
    for row in summary.gaps:
        gap = row.gap_ms
        known = dict(zip(PAPER_METRICS, published.REPEAT[gap], strict=True))
        delta, tolerance = row.repeat["delta_1"].value, DELTA_TOLERANCE[gap]
        yield _around(f"Repeat RMSE, {gap} ms (m)", row.repeat["rmse"], known["rmse"], RMSE_TOLERANCE)
        yield _around(
            f"Repeat AbsRel, {gap} ms", row.repeat["abs_rel"], known["abs_rel"], ABS_REL_TOLERANCE[gap]
        )
        yield Target(
            f"Repeat delta < 1.25, {gap} ms",
            delta,
            known["delta_1"] - tolerance,
            known["delta_1"] + tolerance,
        )
        yield _around(f"prior is sky, {gap} ms", row.prior_sky, published.PRIOR_SKY[gap], PRIOR_SKY_TOLERANCE)


def _motion(summary: Summary) -> Iterator[Target]:
    slow, fast = summary.speeds[0], summary.speeds[-1]
    at = published.GAPS_MS.index(DEPTH_CHANGE_GAP_MS)
    yield Target("depth change over 100 ms, below 10 km/h (m)", slow.depth_change[at].value, 0.0, 1.0)
    yield Target("depth change over 100 ms, from 50 km/h (m)", fast.depth_change[at].value, 2.0, 2.8)
    active = [row.active.value for row in summary.gaps]
    rises = min(b - a for a, b in pairwise(active))
    yield Target("least rise of active pixels from one window to the next", rises, 0.0, 1.0)
    gain = fast.active[at].value - slow.active[at].value
    yield Target("rise of active pixels from below 10 to 50 km/h and more, 100 ms", gain, 0.0, 1.0)


def _keyframes(summary: Summary) -> Iterator[Target]:
    yield Target("mean effective rate under the rule (Hz)", summary.keyframes.rate.value, 36.0, 45.0)
    yield Target("share of sequences between 20 and 50 Hz", summary.keyframes.rate_inside, 0.8, 1.0)


def _network(summary: Summary) -> Iterator[Target]:
    for row in summary.network:
        gap = row.gap_ms
        rmse = row.network["rmse"]
        yield _around(f"checkpoint RMSE, {gap} ms (m)", rmse, published.NETWORK_RMSE[gap], NETWORK_TOLERANCE)
    for row in summary.network:
        gap = row.gap_ms
        for name in CONTROLS[1:]:
            ratio = row.rmse_ratio[name]
            yield Target(f"RMSE over Repeat's, {name}, {gap} ms", ratio, 1 - CONTROL_GAIN, math.inf)
    if summary.batch_norms is not None:
        distance = summary.batch_norms
        yield Target("batch-norm distance, mean", distance.network, 0.0, 0.03)
        yield Target("batch-norm distance, event stem", distance.event_stem, 0.0, 0.05)
        yield Target("batch-norm distance, depth stem", distance.depth_stem, 0.0, 0.05)
