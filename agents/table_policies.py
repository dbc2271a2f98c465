"""The policies of the paper's tables: made in the processes that play them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agents.base import Policy
from agents.keyframe_cnn import KeyframeCNN
from agents.rules import Always, KeyframeRule, Never, Periodic
from nl_env.elidar import RawSequence
from nl_env.evaluation import play
from nl_env.reproduction.end_to_end import Schedule
from nl_env.reproduction.keyframes import Scorer
from nl_env.traces import SequenceTrace

FRAME, TEMPORAL = "keyframe-cnn", "keyframe-cnn-temporal"
"""Rows of the paper's detector and of the one with a memory."""


@dataclass(frozen=True)
class LoadScorers:
    """Makes the scorers of :class:`ScoreTask` from weights."""

    weights: tuple[Path, ...]

    def __call__(self) -> list[Scorer]:
        """One per file."""
        return [KeyframeCNN.load(path).score_sequence for path in self.weights]


@dataclass(frozen=True)
class PlayPolicies:
    """Plays the policies whose rate is their own on a sequence; the ``decide`` of :class:`EndToEndTask`."""

    keyframe_weights: Path
    temporal_weights: Path

    @property
    def detectors(self) -> dict[str, Path]:
        """Weights of the learned policies."""
        return {FRAME: self.keyframe_weights, TEMPORAL: self.temporal_weights}

    def __call__(self, trace: SequenceTrace) -> dict[str, Schedule]:
        """When each policy triggers."""
        policies: dict[str, Policy] = {
            "never": Never(),
            "periodic:2": Periodic(2),
            "always": Always(),
            "keyframe-rule*": KeyframeRule(),
            **{name: KeyframeCNN.load(path) for name, path in self.detectors.items()},
        }
        schedules = {}
        for name, policy in policies.items():
            schedules[name] = np.zeros(trace.slices + 1, bool)
            schedules[name][list(play(policy, trace, name).triggers)] = True
        return schedules

    def on_elidar(self, raw: RawSequence) -> dict[str, Schedule]:
        """When each policy triggers in a raw sequence, slice 1 first."""
        schedules = {
            "never": np.zeros(len(raw), bool),
            "always": np.ones(len(raw), bool),
            "keyframe-rule*": raw.keyframe,
        }
        for name, path in self.detectors.items():
            policy = KeyframeCNN.load(path)
            schedules[name] = policy.score_sequence(raw.frames()) > policy.threshold
        return schedules
