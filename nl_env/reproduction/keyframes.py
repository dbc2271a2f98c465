"""Scores of keyframe detectors on recorded sequences, one sequence at a time."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.classification import Detection
from nl_env.recording import Recording
from nl_env.representations import frame_from_bins

OBSERVED = (-128, 127)
"""Event frames are clipped to what an observation holds."""

Scorer = Callable[[Any], NDArray[np.floating]]
"""Event frames ``(K, H, W)`` of one sequence, slice 1 first, to one score per slice; an array, or what
gives arrays when it is sliced."""


@dataclass(frozen=True)
class ScoredSequence:
    """Labels and scores of slices 1..K of one sequence.

    Attributes:
        seed: of the sequence.
        weather: its name.
        causes: ``(K, 3)`` bool, in the order of ``nl_env.classification.CAUSES``, or ``(K, 1)``, the label.
        lidar: ``(K,)`` bool, slices with a LiDAR frame.
        scores: ``(models, K)`` float64.
    """

    seed: int
    weather: str
    causes: NDArray[np.bool_]
    lidar: NDArray[np.bool_]
    scores: NDArray[np.float64]

    def detection(self, model: int) -> Detection:
        """The answers of one model."""
        return Detection(self.seed, self.weather, self.scores[model], self.causes, self.lidar)

    def save(self, path: Path) -> None:
        """Write everything to one ``.npz`` file (no pickle)."""
        header = json.dumps({"seed": self.seed, "weather": self.weather})
        arrays: dict[str, Any] = {"causes": self.causes, "lidar": self.lidar, "scores": self.scores}
        np.savez_compressed(path, header=np.array(header), **arrays)

    @classmethod
    def load(cls, path: Path) -> ScoredSequence:
        """Read what :meth:`save` wrote."""
        with np.load(path) as file:
            arrays = {name: file[name] for name in ("causes", "lidar", "scores")}
            return cls(**json.loads(str(file["header"])), **arrays)


@dataclass(frozen=True)
class ScoreTask:
    """The work of one process: every detector on one recorded sequence.

    Attributes:
        files: recording of each sequence seed.
        make: makes the scorers, in the process that uses them.
    """

    files: Mapping[int, Path]
    make: Callable[[], Sequence[Scorer]]

    def __call__(self, seed: int) -> ScoredSequence:
        """Score the sequence of ``seed``."""
        with Recording(self.files[seed]) as recording:
            slices = np.arange(1, recording.slices + 1)
            frames = np.array([frame_from_bins(recording.bins(int(k))) for k in slices])
            causes = [recording.keyframe_speed, recording.keyframe_distance, recording.keyframe_new]
            weather = str(recording.description["weather"])
            lidar = slices % recording.lidar_period == 0
        frames = np.clip(frames, *OBSERVED)
        scores = np.array([scorer(frames) for scorer in self.make()], np.float64)
        return ScoredSequence(seed, weather, np.stack(causes, axis=1)[1:], lidar, scores)
