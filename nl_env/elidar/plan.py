"""What an export looks like: names of sequences, their split, and which depth frames make a pair."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.config import SPLITS as SEED_SPLITS
from nl_env.elidar.layout import DURATIONS, SPLITS

WALKS = 3
"""Chains of pairs through a sequence. The released rows are three: each starts at tick 0, the truth of one
row is the prior of the next, and every gap is drawn evenly from those that still fit."""

TOWNS: dict[str, str] = {
    "u-turn": "Town01",
    "exit": "Town02",
    "roundabout": "Town03",
    "highway": "Town04",
    "intersection": "Town05",
    "merge": "Town06",
    "two-way": "Town07",
}
"""Stand-ins: which town an exported name carries for each scenario."""
UNKNOWN_TOWN = "Town10HD"
RELEASED_SPELLING = {"MidRainNoon": "MidRainyNoon"}


@dataclass(frozen=True, eq=False)
class PairPlan:
    """Which pairs of a sequence are exported.

    Attributes:
        ticks: ``(frames,)`` int64, tick of each depth frame.
        prior, truth: ``(n,)`` int64, indices of depth frames, sorted by prior.
        duration: ``(n,)`` int64, ticks between them.
    """

    ticks: NDArray[np.int64]
    prior: NDArray[np.int64]
    truth: NDArray[np.int64]
    duration: NDArray[np.int64]


def draw_pairs(ticks: int, rng: np.random.Generator) -> PairPlan:
    """Draw the pairs of a sequence of ``ticks`` ticks as the release does: random walks from tick 0.

    Raises:
        ValueError: a sequence too short for a single pair.
    """
    if ticks <= min(DURATIONS):
        raise ValueError(f"ticks: found {ticks}, expected more than {min(DURATIONS)}")
    rows: list[tuple[int, int]] = []
    for _ in range(WALKS):
        tick = 0
        while fitting := [duration for duration in DURATIONS if tick + duration < ticks]:
            duration = int(rng.choice(fitting))
            rows.append((tick, duration))
            tick += duration
    rows.sort(key=lambda row: row[0])  # stable: walks stay in order where they meet
    start, duration_ = np.array(rows, np.int64).T
    all_ticks = np.unique(np.concatenate([start, start + duration_]))
    return PairPlan(
        all_ticks,
        np.searchsorted(all_ticks, start),
        np.searchsorted(all_ticks, start + duration_),
        duration_,
    )


def sequence_names(descriptions: Iterable[Mapping[str, Any]]) -> list[str]:
    """ELiDAR names for sequences with these descriptions (``scenario``, ``weather``), all different.

    The first sequence of a scenario and weather is named ``Town05_Opt_ClearNoon``, later ones
    ``Town05_Opt_00``, ``_01``, ...: the two forms of the release.
    """
    taken: set[str] = set()
    numbers: dict[str, int] = defaultdict(int)
    names = []
    for description in descriptions:
        town = TOWNS.get(str(description.get("scenario")), UNKNOWN_TOWN)
        weather = description.get("weather")
        name = f"{town}_Opt_{RELEASED_SPELLING.get(str(weather), weather)}"
        if weather is None or name in taken:
            name = f"{town}_Opt_{numbers[town]:02d}"
            numbers[town] += 1
        taken.add(name)
        names.append(name)
    return names


def split_of_seed(seed: int) -> str:
    """``"train"`` or ``"test"``; the release has no validation split, so such a sequence is refused."""
    split = next((name for name, seeds in SEED_SPLITS.items() if seed in seeds), None)
    if split not in SPLITS:
        raise ValueError(f"seed: found {seed} of split {split!r}, expected one of {' or '.join(SPLITS)}")
    return split
