"""Measurements in one synthetic world: prior/truth pairs at the paper's five gaps, keyframe causes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.config import DrivingConfig
from nl_env.depth.metrics import METRIC_NAMES, full_metrics, paper_metrics, returns_from_depth
from nl_env.keyframes import NewActorDetector, label_keyframe
from nl_env.realism.network import CONTROLS, Moments, ReleasedProbe
from nl_env.realism.published import GAPS_MS
from nl_env.scene.scene import DrivingScene
from nl_env.sensors.event_camera import EventCamera
from nl_env.sensors.lidar import quantise
from nl_env.types import BINS, SLICE_US, TICK_US, EgoState

WARM_UP_SLICES = 2
"""The event camera runs this long before the prior, so that its start does not show."""
PAIR_STREAM = 7
"""Spawn key of the generator of start times and event noise, apart from the scene's."""


@dataclass(frozen=True)
class WorldReport:
    """Measurements in one world; ``P`` pairs, ``G`` gaps, ``M = 14`` metrics, ``L`` layers of ``C`` channels.

    Everything about events is nan where they were not simulated, everything about the network where it was
    not run.

    Attributes:
        seed: sequence seed.
        description: scenario, style and weather.
        speed: ``(P,)`` ego speed at the prior, m/s.
        repeat: ``(P, G, M)`` metrics of the prior, in the order of ``METRIC_NAMES``.
        network: ``(P, G, len(CONTROLS), M)`` the same of the checkpoint and its controls.
        prior_sky: ``(P, G)`` share of valid pixels whose prior is sky.
        depth_change: ``(P, G)`` mean absolute change of depth where both frames have one, m.
        no_return: ``(P,)`` share of pixels without depth.
        depth_moments: ``(P, 2)`` mean (m) and mean square (m^2) of depth, sky = 0.
        border: ``(P, 4)`` mean depth of the top and bottom row and the left and right column, sky = 0, m.
        steps: ``(P, 2)`` mean squared difference of pixels 1 and 2 columns apart, sky = 0, m^2.
        active: ``(P, G)`` share of pixels with an event within the gap.
        bins: ``(P, G, 3)`` mean square of a voxel bin, share of its pixels that are active, and mean product
            of adjacent bins.
        keyframes: ``(slices, 3)`` the causes speed, distance and new actor, over the whole sequence.
        moments: ``(G, L, C, 2)`` mean and mean square that arrive at each batch norm, summed over pairs.
        probed: number of pairs in ``moments``.
    """

    seed: int
    description: tuple[str, str, str]
    speed: NDArray[np.float64]
    repeat: NDArray[np.float64]
    network: NDArray[np.float64]
    prior_sky: NDArray[np.float64]
    depth_change: NDArray[np.float64]
    no_return: NDArray[np.float64]
    depth_moments: NDArray[np.float64]
    border: NDArray[np.float64]
    steps: NDArray[np.float64]
    active: NDArray[np.float64]
    bins: NDArray[np.float64]
    keyframes: NDArray[np.bool_]
    moments: Moments
    probed: int

    @property
    def labels(self) -> NDArray[np.bool_]:
        """``(slices,)`` which slices are keyframes."""
        return np.logical_or.reduce(self.keyframes, axis=1)

    def save(self, path: Path) -> None:
        """Write everything as one ``.npz`` file without pickled objects."""
        with open(path, "wb") as file:
            arrays: dict[str, Any] = {f.name: np.asarray(getattr(self, f.name)) for f in fields(self)}
            np.savez(file, **arrays)

    @classmethod
    def load(cls, path: Path) -> WorldReport:
        """Read what :meth:`save` wrote."""
        with np.load(path, allow_pickle=False) as stored:
            values = {f.name: stored[f.name] for f in fields(cls)}
        scalars = {name: int(values[name]) for name in ("seed", "probed")}
        return cls(**{**values, **scalars, "description": tuple(values["description"].tolist())})


@dataclass(frozen=True)
class WorldTask:
    """Measures one world; picklable, so that worlds can be spread over processes.

    Attributes:
        config: generator configuration.
        pairs: prior/truth pairs per world.
        events: simulate the event camera over each pair (slow).
        checkpoint: the authors' checkpoint, or None.
        network_pairs: the checkpoint runs on this many pairs per world at most.
        control_pairs: its controls run on this many of them.
    """

    config: DrivingConfig
    pairs: int = 10
    events: bool = True
    checkpoint: str | None = None
    network_pairs: int = 4
    control_pairs: int = 1

    def __call__(self, seed: int) -> WorldReport:
        """Measure the world of ``seed``."""
        scene = DrivingScene(self.config.scene, self.config.camera, seed)
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(PAIR_STREAM,)))
        latest = round(self.config.scene.duration_s * 1e6) - GAPS_MS[-1] * 1000
        starts = rng.integers(WARM_UP_SLICES, latest // SLICE_US, self.pairs, endpoint=True) * SLICE_US
        probe = ReleasedProbe(self.checkpoint, len(GAPS_MS)) if self.checkpoint else None
        far = self.config.lidar.max_depth
        rows = []
        for index, start in enumerate(starts.tolist()):
            pair = events_pair if self.events or (probe and index < self.network_pairs) else depth_pair
            found = pair(self.config, scene, start, rng)
            network = np.full((len(GAPS_MS), len(CONTROLS), len(METRIC_NAMES)), np.nan)
            if probe is not None and index < self.network_pairs:
                controls = CONTROLS if index < self.control_pairs else CONTROLS[:1]
                for gap, (voxel, truth) in enumerate(zip(found.voxels, found.truths, strict=True)):
                    for c, depth in enumerate(probe.predict(found.prior, voxel, gap, controls)):
                        network[gap, c] = _metrics(depth, truth, far, headless=True)
            rows.append({**measure(found, far), "speed": scene.speed(start), "network": network})
        return WorldReport(
            seed=seed,
            description=(scene.scenario, scene.style, scene.weather),
            keyframes=keyframe_causes(self.config, seed),
            moments=probe.moments if probe else np.zeros((len(GAPS_MS), 0, 0, 2)),
            probed=min(self.network_pairs, self.pairs) if probe else 0,
            **{name: np.array([row[name] for row in rows], np.float64) for name in rows[0]},
        )


@dataclass(frozen=True)
class Pair:
    """A prior, the truths after it, and the voxel grids and shares of pixels with events in between."""

    prior: NDArray[np.float32]
    truths: Sequence[NDArray[np.float32]]
    voxels: Sequence[NDArray[np.float32]] = ()
    active: Sequence[float] = (np.nan,) * len(GAPS_MS)


def depth_pair(config: DrivingConfig, scene: DrivingScene, start: int, rng: np.random.Generator) -> Pair:
    """Depth alone: six frames."""
    intensity, depth = (np.zeros(config.camera.shape, np.float32) for _ in range(2))
    frames = []
    for elapsed in (0, *GAPS_MS):
        scene.render(start + elapsed * 1000, intensity, depth)
        frames.append(quantise(depth, config.lidar.max_depth))
    return Pair(frames[0], frames[1:])


def events_pair(config: DrivingConfig, scene: DrivingScene, start: int, rng: np.random.Generator) -> Pair:
    """Depth and events: every tick of the longest gap.

    A voxel bin of the longer gaps is a whole number of ticks, so the ticks' event sums add up to it; the
    bins of the 20 ms gap are the sensor's own 4 ms bins.
    """
    shape, far = config.camera.shape, config.lidar.max_depth
    intensity, depth = (np.zeros(shape, np.float32) for _ in range(2))
    camera = EventCamera(config.events, shape)
    camera.noise_scale = scene.noise_scale
    bins = np.zeros((BINS, *shape), np.int16)
    warm_up = start - WARM_UP_SLICES * SLICE_US
    scene.render(warm_up, intensity)
    camera.reset(intensity, warm_up, rng)
    for t in range(warm_up + TICK_US, start, TICK_US):
        scene.render(t, intensity)
        camera.accumulate(intensity, t, bins, (t - TICK_US) // SLICE_US * SLICE_US)
    scene.render(start, intensity, depth)
    camera.accumulate(intensity, start, bins, start - SLICE_US)
    prior = quantise(depth, far)

    ends = [gap * 1000 for gap in GAPS_MS]
    voxels = [np.zeros((BINS, *shape), np.float32) for _ in ends]
    touched = np.zeros(shape, bool)
    truths, active = [], []
    for elapsed in range(TICK_US, ends[-1] + 1, TICK_US):
        t, before = start + elapsed, elapsed - TICK_US
        ends_here = elapsed in ends
        scene.render(t, intensity, depth if ends_here else None)
        bins.fill(0)
        camera.accumulate(intensity, t, bins, start + before // SLICE_US * SLICE_US)
        frame = bins.sum(axis=0, dtype=np.int16)
        touched |= bins.any(axis=0)
        for end, voxel in zip(ends, voxels, strict=True):
            if end == SLICE_US and elapsed <= end:
                voxel += bins
            elif elapsed <= end:
                voxel[BINS * before // end] += frame
        if ends_here:
            truths.append(quantise(depth, far))
            active.append(float(touched.mean()))
    return Pair(prior, truths, voxels, active)


def _metrics(
    pred: NDArray[np.float32], truth: NDArray[np.float32], far: float, headless: bool = False
) -> tuple[float, ...]:
    """``METRIC_NAMES`` of one frame; ``headless`` for a network that cannot say "no return"."""
    whole = returns_from_depth(pred) if headless else pred
    return (*paper_metrics(pred, truth, far), *full_metrics(whole, truth, far))


def measure(pair: Pair, far: float) -> dict[str, object]:
    """What a :class:`WorldReport` keeps of a pair."""
    prior = pair.prior.astype(np.float64)
    repeat, prior_sky, change = [], [], []
    for truth in pair.truths:
        repeat.append(_metrics(pair.prior, truth, far))
        valid = truth > 0
        prior_sky.append(_mean(prior[valid] == 0))
        both = valid & (prior > 0)
        change.append(_mean(np.abs(prior[both] - truth[both])))
    bins = np.full((len(GAPS_MS), 3), np.nan)
    for gap, voxel in enumerate(pair.voxels):
        bins[gap] = (
            np.square(voxel).mean(dtype=np.float64),
            (voxel != 0).mean(),
            (voxel[1:] * voxel[:-1]).mean(dtype=np.float64),
        )
    return {
        "repeat": repeat,
        "prior_sky": prior_sky,
        "depth_change": change,
        "no_return": (prior == 0).mean(),
        "depth_moments": (prior.mean(), np.square(prior).mean()),
        "border": (prior[0].mean(), prior[-1].mean(), prior[:, 0].mean(), prior[:, -1].mean()),
        "steps": [np.square(prior[:, lag:] - prior[:, :-lag]).mean() for lag in (1, 2)],
        "active": pair.active,
        "bins": bins,
    }


def _mean(values: NDArray[Any]) -> float:
    """Mean, nan of nothing."""
    return float(np.mean(values)) if values.size else float("nan")


def keyframe_causes(config: DrivingConfig, seed: int) -> NDArray[np.bool_]:
    """``(slices, 3)``: the causes speed, distance and new actor at slices 1, 2, ... of a sequence.

    Depth only says which actors are hidden here, so the sequence is rendered at ``quarter`` resolution.
    """
    camera = replace(config, resolution="quarter").camera
    scene = DrivingScene(config.scene, camera, seed)
    detector = NewActorDetector(camera)
    detector.reset()
    intensity, depth = (np.zeros(camera.shape, np.float32) for _ in range(2))
    rows = []
    for k in range(config.scene.slices + 1):
        t = k * SLICE_US
        scene.render(t, intensity, depth)
        pose = scene.pose(t)
        new = detector.update(scene.actor_centres(t), pose, depth, t)
        causes = label_keyframe(EgoState(pose, np.zeros(6), scene.speed(t), scene.shortest_distance(t), new))
        rows.append((causes.speed, causes.distance, causes.new))
    return np.array(rows[1:], bool)
