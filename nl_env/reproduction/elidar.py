"""ELiDAR as data of the tables: its test pairs by gap, and its labelled event frames.

Poses are not in the files, so rows that need the true motion cannot be measured.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nl_env.config import WEATHERS
from nl_env.depth.metrics import METRIC_NAMES
from nl_env.elidar import (
    ElidarFiles,
    ExtrapolationData,
    RawSequence,
    SlicingData,
    parse_sequence_name,
    previous_frame,
    read_sequence_list,
)
from nl_env.elidar.layout import SPLITS, SequenceName
from nl_env.elidar.metadata import warn_of
from nl_env.elidar.plan import RELEASED_SPELLING
from nl_env.elidar.slicing import readable_sequences
from nl_env.replay import INDOOR_MIN_DEPTH, INDOOR_RANGE, OUTDOOR_MIN_DEPTH
from nl_env.reproduction.data import Sequences
from nl_env.reproduction.gaps import GROUPS, PAIRS_STREAM, Method, SequenceErrors, finite_mean
from nl_env.reproduction.keyframes import ScoredSequence, Scorer
from nl_env.reproduction.published import GAPS_MS
from nl_env.traces import score
from nl_env.types import TICK_US, Camera, DepthExtrapolator, ExtrapolationInput

LIDAR_PERIOD = 5
"""Slices between LiDAR frames where the release does not say: 10 Hz."""

WEATHER_NAMES = {released: name for name, released in RELEASED_SPELLING.items()}
WEATHER_GROUPS: dict[str, tuple[str, ...]] = {
    group: tuple(name for name in WEATHERS if SequenceName("", name, None).weather_group == group)
    for group in ("Clear", "Cloudy", "Wet", "WetCloudy", "Rain")
}
"""As the released notebook puts weathers together."""


@dataclass(frozen=True)
class Release:
    """ELiDAR's files and how they are read.

    Attributes:
        files: what there is.
        fov: horizontal field of view, degrees, which the files do not say.
        max_depth: range, m.
        on_error: ``"skip"`` leaves out sequences that do not fit or cannot be opened, and warns of each.
    """

    files: ElidarFiles
    fov: float
    max_depth: float
    on_error: str = "raise"

    def pairs(self, names: Sequence[str] | None = None) -> ExtrapolationData:
        """The test pairs, of all sequences or of some."""
        hdf5, metadata = self.files.require_pairs()
        data = ExtrapolationData(
            hdf5,
            metadata,
            split="test",
            sequences=names,
            max_depth=self.max_depth,
            on_error=self.on_error,
        )
        warn_of(data.problems)
        return data

    def test_pairs(
        self, most: int | None, names: Sequence[str] | None = None
    ) -> tuple[Sequences, tuple[str, ...]]:
        """The first ``most`` test sequences with pairs, or all, and their names; their seeds count them."""
        data = self.pairs(names)
        chosen = tuple(first(list(data.sequences), most))
        identity = [_sha256(data.metadata), data.path.stat().st_size, chosen, self.fov, self.max_depth]
        files = dict.fromkeys(range(len(chosen)), data.path)
        left_out = tuple(problem.message for problem in data.problems)
        return Sequences("test", files, _digest(identity), _settings(data.shape), left_out), chosen

    def labelled(self, split: str, most: int | None) -> Sequences:
        """The labelled event frames of a split.

        Every slice of its sequences where the raw sequences are there, as in the released evaluation;
        otherwise the slicing HDF5, as a single sequence. Seeds are distinct over both splits.

        Raises:
            FileNotFoundError: neither is there.
            ValueError: a file that cannot be used.
        """
        raw, problems = readable_sequences(self.raw(split), on_error=self.on_error)
        warn_of(problems)
        if problems and not raw:
            raise ValueError(f"{self.files.folder}: found no usable {split} sequence: {problems[0].message}")
        if not raw:
            hdf5 = self.files.require_slicing()
            shape = SlicingData(hdf5, split).shape
            return Sequences(
                split,
                {SPLITS.index(split): hdf5},
                _digest([hdf5.name, hdf5.stat().st_size]),
                _settings(shape),
            )
        numbers = {name: number for number, name in enumerate(sorted(self.files.raw))}
        files = {numbers[name]: raw[name] for name in first(sorted(raw), most)}
        identity = [[path.name, path.stat().st_size] for path in files.values()]
        settings = _settings(RawSequence(next(iter(files.values()))).shape)
        left_out = tuple(problem.message for problem in problems)
        return Sequences(split, files, _digest(identity), settings, left_out)

    def raw(self, split: str) -> dict[str, Path]:
        """The raw sequences of a split that the slicing release's list names."""
        if split not in self.files.lists:
            return {}
        names = read_sequence_list(self.files.lists[split])
        return {name: self.files.raw[name] for name in names if name in self.files.raw}


def first(names: list[str], most: int | None) -> list[str]:
    """The first ``most``, or all; ``ValueError`` where there are fewer."""
    if most is not None and not 1 <= most <= len(names):
        raise ValueError(f"sequences: found {most}, expected 1 to {len(names)}")
    return names[:most]


@dataclass(frozen=True)
class ElidarGapsTask:
    """The work of one process: every method on the stored pairs of one sequence.

    Attributes:
        data: the pairs.
        names: of the sequences, by seed.
        methods: what is compared, on the same pairs.
        pairs: at most so many of every gap, drawn by the seed.
        fov: horizontal field of view, degrees.
    """

    data: ExtrapolationData
    names: Sequence[str]
    methods: tuple[Method, ...]
    pairs: int
    fov: float

    def __call__(self, seed: int) -> SequenceErrors:
        """Measure the sequence ``seed``; a gap it lacks is nan, ``adaptive`` is the mean over all pairs."""
        name = self.names[seed]
        durations = self.data.sequences[name].duration
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(PAIRS_STREAM,)))
        chosen = [
            np.sort(rng.permutation(np.flatnonzero(durations * TICK_US == gap * 1000))[: self.pairs])
            for gap in GAPS_MS
        ]
        errors = pair_errors(self.data, name, np.concatenate(chosen), self.methods, self.fov)
        ends = np.cumsum([len(rows) for rows in chosen])[:-1]
        groups = [*np.split(errors, ends), errors]
        assert len(groups) == len(GROUPS)
        means = np.stack([finite_mean(group) for group in groups], axis=1)
        return SequenceErrors(seed, {"sequence": name}, means)


def pair_errors(
    data: ExtrapolationData, name: str, rows: NDArray[np.int64], methods: Iterable[Method], fov: float
) -> NDArray[np.float64]:
    """Errors of every method on rows of a sequence, ``(rows, methods, metrics)``.

    The LiDAR frame before the prior is the depth frame that stands for it, where there is one
    (:func:`nl_env.elidar.previous_frame`).
    """
    extrapolators = [method.make() for method in methods]
    camera = Camera.from_fov(*data.shape, fov)
    far = data.max_depth
    near = OUTDOOR_MIN_DEPTH if far > INDOOR_RANGE else INDOOR_MIN_DEPTH
    errors = np.empty((len(rows), len(extrapolators), len(METRIC_NAMES)))
    for place, row in enumerate(rows.tolist()):
        inputs, truth = _inputs(data, name, row, camera)
        for number, extrapolator in enumerate(extrapolators):
            made = score(extrapolator(_seen(inputs, extrapolator)), truth, far, near)
            errors[place, number] = [made[metric] for metric in METRIC_NAMES]
    return errors


def _inputs(
    data: ExtrapolationData, name: str, row: int, camera: Camera
) -> tuple[ExtrapolationInput, NDArray[np.float32]]:
    """What an extrapolator may look at, and the truth."""
    pairs, ticks = data.sequences[name], data.ticks[name]
    prior, truth = int(pairs.prior[row]), int(pairs.truth[row])
    before = previous_frame(ticks, prior)
    frames = [prior] if before is None else [before, prior]
    grid = data.voxel(name, int(pairs.events_id[row]))
    inputs = ExtrapolationInput(
        t=int(ticks[truth]) * TICK_US,
        camera=camera,
        max_depth=data.max_depth,
        lidar_frames=tuple(data.depth(name, frame) for frame in frames),
        lidar_times=tuple(int(ticks[frame]) * TICK_US for frame in frames),
        bins=(np.rint(np.clip(grid, -32_768, 32_767)).astype(np.int16),),
    )
    return inputs, data.depth(name, truth)


def _seen(inputs: ExtrapolationInput, extrapolator: DepthExtrapolator) -> ExtrapolationInput:
    """``inputs`` with no more LiDAR frames than the extrapolator wants."""
    kept = slice(-extrapolator.history, None)
    return ExtrapolationInput(
        t=inputs.t,
        camera=inputs.camera,
        max_depth=inputs.max_depth,
        lidar_frames=inputs.lidar_frames[kept],
        lidar_times=inputs.lidar_times[kept],
        bins=inputs.bins,
    )


@dataclass(frozen=True)
class ElidarScoreTask:
    """The work of one process: every detector on one raw sequence, or on one split of the slicing HDF5.

    Attributes:
        files: of each seed.
        make: makes the scorers, in the process that uses them.
    """

    files: Mapping[int, Path]
    make: Callable[[], Sequence[Scorer]]

    def __call__(self, seed: int) -> ScoredSequence:
        """Score sequence ``seed``; frames are read in blocks."""
        path = self.files[seed]
        data = RawSequence(path) if path.suffix == ".npz" else SlicingData(path, SPLITS[seed])
        causes = data.causes if isinstance(data, RawSequence) else data.scores[:, None] > 0.5
        scores = np.array([scorer(data.frames()) for scorer in self.make()], np.float64)
        data.close()
        weather = weather_of(path.stem) if isinstance(data, RawSequence) else "unknown"
        return ScoredSequence(seed, weather, causes, lidar_slices(len(causes)), scores)


def lidar_slices(count: int) -> NDArray[np.bool_]:
    """``(count,)``: slices 1 to ``count`` with a LiDAR frame at 10 Hz."""
    return np.arange(1, count + 1) % LIDAR_PERIOD == 0


def weather_of(name: str) -> str:
    """Weather of a sequence by its name, as recordings spell it; ``"unknown"`` for a numbered one."""
    weather = parse_sequence_name(name).weather
    return "unknown" if weather is None else WEATHER_NAMES.get(weather, weather)


def _settings(shape: tuple[int, int]) -> dict[str, str]:
    return {"release": "ELiDAR", "resolution": f"{shape[0]}x{shape[1]}"}


def _digest(identity: object) -> str:
    return hashlib.sha256(json.dumps(identity).encode()).hexdigest()


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
