"""Trigger policies and extrapolators together on ELiDAR.

The release has no depth at every slice, so sequences cannot be played. What it has is enough for the same
figures: the raw sequences say when a policy triggers, hence its frame rate, and every stored pair whose gap
a LiDAR frame at 10 Hz can have aged, 20 and 50 ms, is a moment at which the policy extrapolates or holds.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.depth.metrics import METRIC_NAMES
from nl_env.elidar import ExtrapolationData, RawSequence
from nl_env.evaluation import EnergyModel, EpisodeRecord
from nl_env.reproduction.elidar import LIDAR_PERIOD, Release, lidar_slices, pair_errors
from nl_env.reproduction.gaps import PAIRS_STREAM, Method, finite_mean
from nl_env.types import SLICE_US, TICKS_PER_SLICE

HELD = "repeat"
"""The method whose frame is held where a policy does not trigger: the LiDAR's."""

Decide = Callable[[RawSequence], Mapping[str, NDArray[np.bool_]]]
"""When each policy triggers: ``(slices,)`` by its name, slice 1 first."""


@dataclass(frozen=True)
class ElidarRun:
    """One sequence: when each policy triggers, and what that gives at the stored pairs.

    Attributes:
        seed: place among the test sequences.
        name: of the sequence.
        keyframes: ``(slices,)`` bool, the label.
        triggers: by policy, ``(slices,)`` bool.
        slices: ``(pairs,)`` int64, the slice (from 0) at whose end a pair's truth is.
        errors: by method, ``(pairs, metrics)`` float64.
    """

    seed: int
    name: str
    keyframes: NDArray[np.bool_]
    triggers: Mapping[str, NDArray[np.bool_]]
    slices: NDArray[np.int64]
    errors: Mapping[str, NDArray[np.float64]]

    def record(self, policy: str, extrapolator: str) -> EpisodeRecord:
        """What ``policy`` reaches with ``extrapolator``; held depth is averaged over the pairs."""
        called, lidar = self.triggers[policy], lidar_slices(len(self.keyframes))
        made = called & ~lidar
        free, labels = ~lidar, self.keyframes
        duration = len(called) * SLICE_US / 1e6
        frames = int(np.count_nonzero(lidar))
        triggered = called[self.slices]
        errors = self.errors[extrapolator]
        held = finite_mean(np.where(triggered[:, None], errors, self.errors[HELD]))
        produced = finite_mean(errors[triggered])
        return EpisodeRecord(
            policy=policy,
            seed=self.seed,
            duration_s=duration,
            triggers=tuple((np.flatnonzero(made) + 1).tolist()),
            effective_rate=(frames + np.count_nonzero(made)) / duration,
            held=dict(zip(METRIC_NAMES, held.tolist(), strict=True)),
            produced=dict(zip(METRIC_NAMES, produced.tolist(), strict=True)),
            true_positives=int(np.count_nonzero(made & labels)),
            false_positives=int(np.count_nonzero(made & ~labels)),
            false_negatives=int(np.count_nonzero(free & ~called & labels)),
            energy_j=EnergyModel().energy(frames, int(np.count_nonzero(made)), duration),
        )

    def save(self, path: Path) -> None:
        """Write everything to one ``.npz`` file (no pickle)."""
        header = {
            "seed": self.seed,
            "name": self.name,
            "policies": list(self.triggers),
            "methods": list(self.errors),
        }
        arrays: dict[str, Any] = {
            "keyframes": self.keyframes,
            "triggers": np.array(list(self.triggers.values())),
            "slices": self.slices,
            "errors": np.array(list(self.errors.values())),
        }
        np.savez_compressed(path, header=np.array(json.dumps(header)), **arrays)

    @classmethod
    def load(cls, path: Path) -> ElidarRun:
        """Read what :meth:`save` wrote."""
        with np.load(path) as file:
            header = json.loads(str(file["header"]))
            return cls(
                seed=header["seed"],
                name=header["name"],
                keyframes=file["keyframes"],
                triggers=dict(zip(header["policies"], file["triggers"], strict=True)),
                slices=file["slices"],
                errors=dict(zip(header["methods"], file["errors"], strict=True)),
            )


@dataclass(frozen=True)
class ElidarEndToEndTask:
    """The work of one process: one sequence with every policy and extrapolator.

    Attributes:
        data: the pairs.
        names: of the sequences, by seed.
        raw: raw sequence of each name.
        methods: the extrapolators by their rows, ``HELD`` among them.
        decide: plays the policies.
        pairs: at most so many of either gap, drawn by the seed.
        fov: horizontal field of view, degrees.
    """

    data: ExtrapolationData
    names: Sequence[str]
    raw: Mapping[str, Path]
    methods: tuple[Method, ...]
    decide: Decide
    pairs: int
    fov: float

    def __call__(self, seed: int) -> ElidarRun:
        """Run the sequence ``seed``; ``ValueError`` where no pair has such a gap."""
        name = self.names[seed]
        raw = RawSequence(self.raw[name])
        triggers = dict(self.decide(raw))
        rows, slices = self._rows(name, seed, len(raw))
        errors = pair_errors(self.data, name, rows, self.methods, self.fov)
        raw.close()
        return ElidarRun(
            seed=seed,
            name=name,
            keyframes=raw.keyframe,
            triggers=triggers,
            slices=slices,
            errors={method.row: errors[:, number] for number, method in enumerate(self.methods)},
        )

    def _rows(self, name: str, seed: int, count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Pairs in use, and the last slice that has ended at their truth's time."""
        pairs, ticks = self.data.sequences[name], self.data.ticks[name]
        slices = np.minimum(ticks[pairs.truth] // TICKS_PER_SLICE, count) - 1
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(PAIRS_STREAM,)))
        gaps = [gap for gap in np.unique(pairs.duration) if gap < LIDAR_PERIOD * TICKS_PER_SLICE]
        if not gaps:
            raise ValueError(f"{self.data.path}: {name}: found no pair with a gap below 100 ms")
        chosen = [rng.permutation(np.flatnonzero(pairs.duration == gap))[: self.pairs] for gap in gaps]
        rows = np.sort(np.concatenate(chosen))
        return rows, slices[rows]


def end_to_end_names(release: Release) -> tuple[str, ...]:
    """Test sequences with pairs and a raw sequence that neither release trains on.

    The others are named in a warning.

    Raises:
        FileNotFoundError: no raw sequences.
        ValueError: none is left.
    """
    if not release.files.raw:
        raise FileNotFoundError(
            f"{release.files.folder}: found no raw sequences, which say when a policy triggers"
        )
    trained = release.raw("train")
    every = list(release.pairs().sequences)
    kept = tuple(name for name in every if name in release.files.raw and name not in trained)
    mixed = [name for name in every if name in trained]
    if mixed:
        warnings.warn(
            f"left out {len(mixed)} test sequences that the slicing release trains on: {', '.join(mixed)}",
            stacklevel=2,
        )
    if not kept:
        raise ValueError(
            f"{release.files.folder}: found no test sequence with a raw sequence that neither release "
            "trains on, expected at least one"
        )
    return kept


def records_of(runs: Sequence[ElidarRun]) -> dict[str, dict[str, list[EpisodeRecord]]]:
    """Records of every policy with every extrapolator, in the order of ``runs``."""
    return {
        policy: {method: [run.record(policy, method) for run in runs] for method in runs[0].errors}
        for policy in runs[0].triggers
    }
