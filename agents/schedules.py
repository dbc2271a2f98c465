"""Whole schedules of policies on a stored trace at once, instead of one prediction after the other.

What a policy does follows from what it sees. Where that can be known in advance, all its predictions of a
drive fit in one batch: detectors of keyframes see events alone, and policies on event statistics without a
memory meet one of the ten states of each LiDAR interval. Schedules equal the ones that predictions give one
by one, up to rounding in the networks.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.activity import StatisticsPolicy
from agents.base import Actions, Memory, Policy
from agents.decisions import Decisions, collect, states
from nl_env.observations import IMAGE_OFFSET, cost_coordinate
from nl_env.traces import SequenceTrace

Schedule = NDArray[np.bool_]


class Scripted(Policy):
    """Triggers at the slices of a schedule ``(K+1,)``, whatever it sees."""

    def __init__(self, schedule: Schedule) -> None:
        self._schedule = schedule.astype(np.int64)

    def read(self, observation: Any) -> tuple[NDArray[Any], bool]:
        """Nothing of a single observation."""
        return np.zeros((1, 0)), False

    def initial_memory(self, count: int) -> Memory:
        return np.zeros((count, 1), dtype=np.int64)

    def decide(self, seen: NDArray[Any], memory: Memory) -> Actions:
        memory[:, 0] += 1
        return self._schedule[memory[:, 0]]


class Scheduler:
    """Turns policies into scripted ones for one trace; what they share is computed once."""

    def __init__(self, trace: SequenceTrace) -> None:
        self._trace = trace
        self._decisions: Decisions | None = None
        self._scores: dict[int, NDArray[np.float32]] = {}

    def scripted(self, policy: Policy) -> Policy:
        """A policy with the schedule of ``policy``, or ``policy`` itself where it is not known in advance."""
        schedule = self._detected(policy)
        if schedule is None and isinstance(policy, StatisticsPolicy) and policy.memoryless:
            schedule = self._enumerated(policy)
        return policy if schedule is None else Scripted(schedule)

    def _detected(self, policy: Policy) -> Schedule | None:
        """The schedule of a :class:`agents.keyframe_cnn.KeyframeCNN`, asked for without importing PyTorch."""
        network = getattr(policy, "network", None)
        if type(policy).__name__ != "KeyframeCNN" or network is None:
            return None
        if id(network) not in self._scores:
            frames = self._trace.images[1:].astype(np.int16) - np.int16(IMAGE_OFFSET)
            self._scores[id(network)] = policy.score_sequence(frames)  # type: ignore[attr-defined]
        above = self._scores[id(network)] > policy.threshold  # type: ignore[attr-defined]
        return np.concatenate([[False], above])

    def _enumerated(self, policy: StatisticsPolicy) -> Schedule | None:
        """The way of a memoryless policy through the states of every interval."""
        trace, period = self._trace, self._trace.lidar_period
        if trace.slices % period not in (0, period - 1):
            return None  # the last interval is not whole
        if self._decisions is None:
            self._decisions = collect([trace])
        seen = self._decisions.observations
        if policy.trigger_cost is not None:
            shape = (*seen.shape[:2], 1)
            seen = np.concatenate([seen, np.full(shape, cost_coordinate(policy.trigger_cost))], axis=-1)
        actions = policy.predict(seen.reshape(-1, seen.shape[-1]))[0].reshape(seen.shape[:2])
        places = {place: i for i, place in enumerate(states(period))}
        intervals = np.arange(len(actions))
        held = np.zeros(len(actions), np.int64)
        schedule = np.zeros(trace.slices + 1, bool)
        for k in range(1, period):
            first = places[k, 0]  # the states of one offset follow each other
            triggered = actions[intervals, first + held] == 1
            schedule[intervals * period + k] = triggered
            held = np.where(triggered, k, held)
        return schedule
