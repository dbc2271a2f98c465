"""Pairs to learn extrapolation from: a LiDAR frame, the events of a gap, and the true depth after it.

Cut out of recordings once, one uncompressed file per sequence, so that training reads a pair with one
access to a memory map. Besides the images a pair holds the true motions and the one that ICP finds between
the last two LiDAR frames, which takes longer than everything else at training time would.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.config import DrivingConfig, from_dict, number
from nl_env.depth.examples import Example
from nl_env.depth.features import Scene
from nl_env.depth.motion import continued, estimate_motion
from nl_env.recording import Recording
from nl_env.recording.cut_set import CutSet, cut
from nl_env.recording.manifest import read_manifest
from nl_env.representations import voxel_grid
from nl_env.sensors.lidar import decode
from nl_env.types import BINS, SLICE_US, Camera

VERSION = 1
"""Changes with what is stored and with how the motion is estimated."""

COUNT_LIMIT = 127
"""Event counts are stored as int8; a count beyond is cut (half a second holds some forty at most)."""


@dataclass(frozen=True)
class PairOptions:
    """Which pairs are cut. Invalid values raise ``ValueError``."""

    instants: int = 16
    """LiDAR frames per sequence, at random times."""
    gaps_ms: tuple[tuple[int, ...], ...] = ((20, 40), (50, 60), (80, 100), (200,), (500,))
    """Each LiDAR frame gives one pair per group, with a gap drawn from the group, ms."""
    lidar_period_ms: int = 100
    """Time between the two LiDAR frames before a gap, ms."""
    seed: int = 0
    """Of the times and gaps, together with the sequence's own seed."""

    def __post_init__(self) -> None:
        number("instants", self.instants, 1, 10_000)
        number("lidar_period_ms", self.lidar_period_ms, 1, 1000)
        number("seed", self.seed, 0, 2**63)
        if not self.gaps_ms or not all(self.gaps_ms):
            raise ValueError(f"gaps_ms: found {self.gaps_ms!r}, expected groups of at least one gap")
        for gap in (gap for group in self.gaps_ms for gap in group):
            number("gaps_ms", gap, 1, 10_000)


PAPER_GAPS = ((20,), (50,), (100,), (200,), (500,))
"""Groups that give the paper's five gaps at every LiDAR frame, for validation and tests."""


def pair_dtype(camera: Camera) -> np.dtype[np.void]:
    """One pair.

    ``previous``, ``prior``, ``truth``: depth codes (``nl_env.sensors.lidar.decode``), one LiDAR period
    apart and one gap apart; ``voxel``: signed event counts of the gap (Eq. 2); ``t_us``: time of the
    prior; ``gap_us``; ``true_motion`` and ``true_last_motion``: 4x4, camera of the prior to that of the
    truth, and of the previous frame to that of the prior; ``last_motion``: the latter as ICP finds it.
    """
    return np.dtype(
        [
            *((name, "<u2", camera.shape) for name in ("previous", "prior", "truth")),
            ("voxel", "<i1", (BINS, *camera.shape)),
            ("t_us", "<i8"),
            ("gap_us", "<i8"),
            *((name, "<f8", (4, 4)) for name in ("true_motion", "true_last_motion", "last_motion")),
        ]
    )


def cut_pairs(recording: Recording, options: PairOptions) -> NDArray[np.void]:
    """The pairs of one recording, in order of time: ``(instants * groups,)`` of :func:`pair_dtype`.

    Raises:
        ValueError: the sequence is too short, or holds no depth at the times the gaps ask for.
    """
    camera, far = recording.camera, recording.max_depth
    period = options.lidar_period_ms * 1000
    step = recording.depth_period_us
    first = -(-period // step)
    last = (recording.slices * SLICE_US - 1000 * max(map(max, options.gaps_ms))) // step
    if last - first + 1 < options.instants:
        raise ValueError(
            f"{recording.path}: found {max(last - first + 1, 0)} times with depth before and after, "
            f"expected at least instants = {options.instants}"
        )
    rng = np.random.default_rng(np.random.SeedSequence(recording.seed, spawn_key=(options.seed,)))
    chosen = first + np.sort(rng.choice(last - first + 1, options.instants, replace=False))
    pairs = np.zeros((options.instants, len(options.gaps_ms)), pair_dtype(camera))
    for row, now in zip(pairs, (int(index) * step for index in chosen), strict=True):
        codes = {t: recording.depth_codes(t) for t in (now - period, now)}
        poses = {t: recording.pose(t) for t in codes}
        previous, prior = (decode(frame, far) for frame in codes.values())
        estimated = estimate_motion(previous, prior, camera, far)
        gaps = [1000 * int(rng.choice(group)) for group in options.gaps_ms]
        events = recording.events(now, now + max(gaps))
        for pair, gap in zip(row, gaps, strict=True):
            then = now + gap
            voxel = voxel_grid(events, camera.shape, now, then)
            pair["previous"], pair["prior"] = codes.values()
            pair["truth"] = recording.depth_codes(then)
            pair["voxel"] = np.clip(voxel, -COUNT_LIMIT, COUNT_LIMIT)
            pair["t_us"], pair["gap_us"] = now, gap
            pair["true_motion"] = np.linalg.inv(recording.pose(then)) @ poses[now]
            pair["true_last_motion"] = np.linalg.inv(poses[now]) @ poses[now - period]
            pair["last_motion"] = estimated
    return pairs.reshape(-1)


def build_pairs(
    recordings: Path,
    folder: Path,
    options: PairOptions | None = None,
    *,
    workers: int = 0,
    progress: Callable[[int], None] = lambda finished: None,
) -> Pairs:
    """Cut the pairs of all recordings of a folder, or those that are missing.

    Args:
        recordings: output of ``scripts/record.py``.
        folder: where the pairs go. One that holds these pairs already is only opened.
        options: which pairs.
        workers, progress: as :func:`nl_env.recording.cut_set.cut`.

    Raises:
        FileNotFoundError: no manifest: nothing recorded there, or not finished.
        ValueError: ``folder`` holds other pairs (of other recordings or options), or a damaged recording.
        OSError: ``folder`` cannot be written.
    """
    options = options or PairOptions()
    manifest = read_manifest(recordings)
    identity = {
        "version": VERSION,
        "manifest_sha256": manifest.sha256,
        "split": manifest.split,
        "seeds": list(manifest.entries),
        "config": manifest.content["config"],
        "pairs": asdict(options),
    }
    cut(folder, identity, _CutPairs(manifest.files, options), workers=workers, progress=progress)
    return Pairs(folder)


class Pairs(CutSet):
    """The pairs that :func:`build_pairs` cut, read from disk as they are asked for.

    A :class:`nl_env.depth.examples.PairSource`; errors as :class:`nl_env.recording.cut_set.CutSet`.
    """

    what = "pairs"
    poses = True

    def __init__(self, folder: str | Path) -> None:
        super().__init__(folder)
        config = from_dict(DrivingConfig, self.identity["config"])
        self.camera, self.max_depth = config.camera, config.lidar.max_depth
        options = self.identity["pairs"]
        self.gaps = len(options["gaps_ms"])
        self.lidar_period_us = 1000 * options["lidar_period_ms"]
        self.per_sequence = options["instants"] * self.gaps

    @property
    def summary(self) -> dict[str, Any]:
        """What they were cut from, for cards: JSON-ready."""
        return {**self.identity, "seeds": [self.seeds[0], self.seeds[-1]], "sequences": len(self.seeds)}

    def expected(self, number: int) -> tuple[np.dtype[Any], tuple[int, ...]]:
        """As many pairs in every sequence."""
        return pair_dtype(self.camera), (self.per_sequence,)

    def __len__(self) -> int:
        return len(self.seeds) * self.per_sequence

    def __getitem__(self, index: int) -> np.void:
        """Pair ``index``; those of a sequence lie together, in the order of ``seeds``."""
        if not 0 <= index < len(self):
            raise IndexError(f"pairs: found index {index}, expected 0 to {len(self) - 1}")
        sequence, row = divmod(int(index), self.per_sequence)
        return self.sequence(sequence)[row]

    def example(
        self, index: int, motion: NDArray[np.float64] | None = None, *, odometry: bool = False
    ) -> Example:
        """As :meth:`nl_env.depth.examples.PairSource.example`."""
        pair = self[index]
        gap = int(pair["gap_us"])
        last = np.array(pair["true_last_motion"] if odometry else pair["last_motion"])
        if odometry:
            motion = np.array(pair["true_motion"])
        elif motion is None:
            motion = continued(last, gap / self.lidar_period_us)
        prior, previous, truth = (
            decode(pair[name], self.max_depth) for name in ("prior", "previous", "truth")
        )
        voxel = np.array(pair["voxel"])
        scene = Scene(self.camera, self.max_depth, prior, previous, last, voxel, gap * 1e-6)
        return Example(scene, motion, np.array(pair["true_motion"]), truth)


@dataclass(frozen=True)
class _CutPairs:
    """The work of one process."""

    files: Mapping[int, Path]
    options: PairOptions

    def __call__(self, seed: int) -> NDArray[np.void]:
        """Cut the pairs of the sequence of ``seed``."""
        with Recording(self.files[seed]) as recording:
            return cut_pairs(recording, self.options)
