"""Many policies on many sequences: the checkpoint of one sequence, summaries, curves and the floor."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.curves import OperatingPoints, oracle_points
from nl_env.evaluation import (
    DECIDING_METRIC,
    EnergyModel,
    EpisodeRecord,
    Estimate,
    PolicySummary,
    estimate_mean,
    play,
    resample_sequences,
    summarise,
)
from nl_env.frontier import ENDS, ORACLE, PERIODIC, Frontier, frontier
from nl_env.traces import PlayerFrames, SequenceTrace
from nl_env.types import SLICE_US, TriggerPolicy


@dataclass(frozen=True)
class PolicyInfo:
    """How a policy is shown.

    Attributes:
        name: unique, as on the command line, e.g. ``"periodic:2"``.
        family: policies of one kind make one curve, e.g. ``"periodic"``.
        parameter: the family's knob, or None when it has none.
        listed: in the table; the others are points of their family's curve only.
        adaptive: its triggers depend on the scene.
        privileged: reads what no sensor gives (labels or true depth).
        weights: file of a learned policy's weights where it is not the shipped one: one training each.
    """

    name: str
    family: str
    parameter: float | None
    listed: bool
    adaptive: bool
    privileged: bool
    weights: str = ""


@dataclass(frozen=True)
class SequenceResult:
    """Every policy on one sequence.

    Attributes:
        seed: sequence seed.
        description: scenario, style, weather.
        lidar_period: slices between LiDAR frames.
        ego_speed: ``(K+1,)`` float64, m/s.
        keyframe, lidar: ``(K+1,)`` bool.
        records: one per policy, in the run's order.
        floor: ``(n+1,)`` float64, least sum over slices 1..K of the deciding error for 0..n triggers.
        errors: ``(K+1, P)`` float64, the trace's table of the deciding error.
        frames: small frames, for the sequence that the page shows.
    """

    seed: int
    description: dict[str, Any]
    lidar_period: int
    ego_speed: NDArray[np.float64]
    keyframe: NDArray[np.bool_]
    lidar: NDArray[np.bool_]
    records: tuple[EpisodeRecord, ...]
    floor: NDArray[np.float64]
    errors: NDArray[np.float64]
    frames: PlayerFrames | None = None

    @property
    def slices(self) -> int:
        """Index of the last slice (K)."""
        return len(self.lidar) - 1

    def save(self, path: Path) -> None:
        """Write everything to one ``.npz`` file (no pickle)."""
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        header: dict[str, Any] = {
            "seed": self.seed,
            "description": self.description,
            "lidar_period": self.lidar_period,
            "records": [dataclasses.asdict(record) for record in self.records],
        }
        if self.frames is not None:
            arrays |= {name: getattr(self.frames, name) for name in _FRAME_ARRAYS}
            header["max_depth"] = self.frames.max_depth
        np.savez_compressed(path, header=np.array(json.dumps(header)), **arrays)

    @classmethod
    def load(cls, path: Path) -> SequenceResult:
        """Read what :meth:`save` wrote."""
        with np.load(path) as file:
            header = json.loads(str(file["header"]))
            frames = None
            if "max_depth" in header:
                frames = PlayerFrames(
                    **{name: file[name] for name in _FRAME_ARRAYS}, max_depth=header["max_depth"]
                )
            return cls(
                seed=header["seed"],
                description=header["description"],
                lidar_period=header["lidar_period"],
                records=tuple(
                    EpisodeRecord(**{**record, "triggers": tuple(record["triggers"])})
                    for record in header["records"]
                ),
                **{name: file[name] for name in _ARRAYS},
                frames=frames,
            )


_ARRAYS = ("ego_speed", "keyframe", "lidar", "floor", "errors")
_FRAME_ARRAYS = ("events", "truth", "produced")

Oracle = Callable[[NDArray[np.float64], int], NDArray[np.float64]]
"""``(errors (K+1, P), period) -> (n+1,)`` least total error for 0..n triggers, exact."""


def evaluate_sequence(
    trace: SequenceTrace,
    policies: Mapping[str, TriggerPolicy],
    oracle: Oracle,
    energy: EnergyModel,
) -> SequenceResult:
    """Play every policy on ``trace`` and ask ``oracle`` for the least error at every number of triggers."""
    errors = trace.errors[DECIDING_METRIC]
    return SequenceResult(
        seed=trace.seed,
        description=trace.description,
        lidar_period=trace.lidar_period,
        ego_speed=trace.ego_speed,
        keyframe=trace.keyframe,
        lidar=trace.lidar,
        records=tuple(play(policy, trace, name, energy=energy) for name, policy in policies.items()),
        floor=oracle(errors, trace.lidar_period),
        errors=errors,
        frames=trace.frames,
    )


@dataclass(frozen=True)
class Comparison:
    """A finished run: what the report shows.

    Attributes:
        settings: everything that determines the results, JSON-ready.
        policies: what was compared, in order.
        sequences: one result per test sequence.
        summaries: one per policy.
        saved: per policy, how much of the deciding error of the LiDAR alone it saves. Differences are taken
            within sequences, so the interval tells policies apart that share their sequences.
        floor: ``(N+1,)`` least mean deciding error for 0..N triggers in all sequences together.
        frontier: each family's curve and regret; None without periodic triggering, which sets their scale.
        shown: index of the sequence with frames, the one the page plays; None without any.
    """

    settings: dict[str, Any]
    policies: tuple[PolicyInfo, ...]
    sequences: tuple[SequenceResult, ...]
    summaries: tuple[PolicySummary, ...]
    saved: tuple[Estimate, ...]
    floor: NDArray[np.float64]
    frontier: Frontier | None
    shown: int | None

    @property
    def floor_rates(self) -> NDArray[np.float64]:
        """``(N+1,)`` effective frame rate of each entry of ``floor``, Hz."""
        lidar_frames = sum(int(result.lidar[1:].sum()) for result in self.sequences)
        duration_s = sum(result.slices for result in self.sequences) * SLICE_US / 1e6
        return (lidar_frames + np.arange(len(self.floor))) / duration_s

    def above_floor(self, index: int) -> float:
        """Error of policy ``index`` minus the least that as many triggers could have reached.

        At least 0, up to rounding.
        """
        triggers = sum(len(result.records[index].triggers) for result in self.sequences)
        return self.summaries[index].held[DECIDING_METRIC].mean - float(self.floor[triggers])


def compare(
    settings: dict[str, Any],
    policies: Sequence[PolicyInfo],
    results: Sequence[SequenceResult],
    rng: np.random.Generator,
) -> Comparison:
    """Put the results of all sequences together; ``rng`` draws the bootstrap.

    Raises:
        ValueError: no results, sequences of different lengths (their mean would not be a time average),
            or policies that differ from the ones played.
    """
    if not results:
        raise ValueError("results: found none, expected at least one sequence")
    lengths = sorted({result.slices for result in results})
    if len(lengths) != 1:
        raise ValueError(f"results: found sequences of {lengths} slices, expected equal lengths")
    names = [policy.name for policy in policies]
    for result in results:
        played = [record.policy for record in result.records]
        if played != names:
            raise ValueError(f"results: sequence {result.seed} played {played}, expected {names}")
    shown = [i for i, result in enumerate(results) if result.frames is not None]
    resamples = resample_sequences(len(results), rng)
    held = np.array([[record.held[DECIDING_METRIC] for record in result.records] for result in results])
    lidar_alone = np.array([result.floor[0] / result.slices for result in results])
    return Comparison(
        settings=settings,
        policies=tuple(policies),
        sequences=tuple(results),
        summaries=tuple(
            summarise([result.records[i] for result in results], resamples) for i in range(len(policies))
        ),
        saved=tuple(estimate_mean(lidar_alone - errors, resamples) for errors in held.T),
        floor=pooled_floor([result.floor for result in results]) / (lengths[0] * len(results)),
        frontier=_frontier(policies, results, held.T, resamples),
        shown=shown[0] if shown else None,
    )


def _frontier(
    policies: Sequence[PolicyInfo],
    results: Sequence[SequenceResult],
    errors: NDArray[np.float64],
    resamples: NDArray[np.int64],
) -> Frontier | None:
    """Curves of the families of ``policies``, whose held-depth ``errors`` are ``(policies, sequences)``."""
    rates = np.array([[record.effective_rate for record in result.records] for result in results]).T
    members: dict[str, dict[str, list[int]]] = {}
    for i, policy in enumerate(policies):
        members.setdefault(policy.family, {}).setdefault(policy.weights, []).append(i)
    families = {
        family: [OperatingPoints(rates[indices], errors[indices]) for indices in trainings.values()]
        for family, trainings in members.items()
        if family not in (*ENDS, ORACLE)
    }
    if not any(family in families for family in PERIODIC):
        return None
    slices = results[0].slices
    duration_s = slices * SLICE_US / 1e6
    lidar_frames = int(results[0].lidar[1:].sum())
    floors = [result.floor for result in results]
    triggers = np.array([[0, len(floor) - 1] for floor in floors])
    least = np.array([floor[[0, -1]] / slices for floor in floors])
    ends = OperatingPoints((lidar_frames + triggers.T) / duration_s, least.T)
    return frontier(families, oracle_points(floors, lidar_frames, slices, duration_s), ends, resamples)


def pooled_floor(floors: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Least total error for every total number of triggers, spread over all sequences as well as possible.

    A policy may spend more triggers where driving is fast, so the mean of the sequences' own curves at equal
    rates is not a bound on it. This is: the exact min-plus convolution of the curves.

    Args:
        floors: per sequence ``(n_i + 1,)`` least total error for 0..n_i triggers.

    Returns:
        ``(sum n_i + 1,)`` float64.
    """
    pooled = np.zeros(1)
    for floor in floors:
        combined = np.full(len(pooled) + len(floor) - 1, np.inf)
        for triggers, total in enumerate(floor):
            window = combined[triggers : triggers + len(pooled)]
            np.minimum(window, pooled + total, out=window)
        pooled = combined
    return pooled
