"""How close the synthetic scenes come to ELiDAR: the figures of the paper and of the released checkpoint.

Each world yields prior/truth pairs at the paper's five gaps. From them come the *Repeat* row by gap, the
share of valid pixels whose prior is sky, the change of depth with speed, the active event pixels, and, with
the authors' checkpoint, its error and the statistics that arrive at its batch normalisations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nl_env.config import DrivingConfig
from nl_env.depth.metrics import FULL_METRICS, PAPER_METRICS, full_metrics, paper_metrics, returns_from_depth
from nl_env.keyframes import NewActorDetector, label_keyframe
from nl_env.representations import voxel_grid
from nl_env.scene.scene import DrivingScene
from nl_env.sensors.event_camera import EventCamera
from nl_env.sensors.lidar import quantise
from nl_env.types import SLICE_US, TICK_US, EgoState

GAPS_MS = (20, 50, 100, 200, 500)
"""Extrapolation gaps of the paper's Table (50, 20, 10, 5 and 2 Hz)."""
PUBLISHED_REPEAT = {
    20: (4.976, 1.486, 0.026, 0.697, 0.975, 0.984, 0.987),
    50: (6.904, 2.016, 0.045, 1.341, 0.958, 0.971, 0.978),
    100: (8.382, 2.373, 0.063, 1.884, 0.941, 0.960, 0.970),
    200: (9.820, 2.980, 0.092, 2.603, 0.910, 0.940, 0.954),
    500: (12.211, 3.487, 0.139, 4.521, 0.860, 0.911, 0.933),
}
"""The paper's Repeat row, in the order of ``PAPER_METRICS``."""
PUBLISHED_NETWORK_RMSE = {20: 3.883, 50: 4.747, 100: 5.542, 200: 6.385, 500: 8.422}
IMPLIED_SKY_SHARE = {20: 0.0045, 50: 0.008, 100: 0.011, 200: 0.018, 500: 0.025}
"""Share of valid pixels whose prior is sky that the published log RMSE implies."""
CONTROLS = ("network", "no events", "time reversed", "sky at 200 m")
"""The checkpoint as it is, and three ways of feeding it wrongly that must destroy its gain."""
_SKY_CONTROL = 200.0
_WARM_UP_TICKS = 8


@dataclass(frozen=True)
class WorldReport:
    """Measurements in one world; ``P`` pairs, ``G`` gaps, ``M`` metrics, ``L`` layers of ``C`` channels.

    Attributes:
        seed: sequence seed.
        speed: ``(P,)`` ego speed at the prior, m/s.
        repeat: ``(P, G, 14)`` paper then full-image metrics of the prior.
        network: ``(P, G, len(CONTROLS), 14)`` the same of the checkpoint; nan where it was not run.
        sky_share: ``(P, G)`` share of valid pixels whose prior is sky.
        depth_change: ``(P, G)`` mean absolute change of depth where both frames have one, m.
        active: ``(P, G)`` share of pixels with an event within the gap; nan without events.
        no_return: ``(P,)`` share of pixels without depth.
        step_rms: ``(P,)`` RMS difference of horizontal neighbours, sky = 0, m.
        depth_moments: ``(P, 2)`` mean and mean square of depth, sky = 0.
        bin_std: ``(P, G)`` standard deviation of a voxel bin; nan without events.
        bin_active: ``(P, G)`` share of active pixels per bin.
        keyframes: ``(slices, 4)`` speed, distance, new actor, any; over the whole sequence.
        layer_moments: ``(G, L, C, 3)`` weight, sum and sum of squares at each batch norm (nan-free, padded).
    """

    seed: int
    speed: NDArray[np.float64]
    repeat: NDArray[np.float64]
    network: NDArray[np.float64]
    sky_share: NDArray[np.float64]
    depth_change: NDArray[np.float64]
    active: NDArray[np.float64]
    no_return: NDArray[np.float64]
    step_rms: NDArray[np.float64]
    depth_moments: NDArray[np.float64]
    bin_std: NDArray[np.float64]
    bin_active: NDArray[np.float64]
    keyframes: NDArray[np.bool_]
    layer_moments: NDArray[np.float64]

    def save(self, path: Path) -> None:
        """Write all arrays as ``.npz``."""
        with open(path, "wb") as file:
            np.savez(file, **{f.name: np.asarray(getattr(self, f.name)) for f in fields(self)})

    @classmethod
    def load(cls, path: Path) -> WorldReport:
        """Read what :meth:`save` wrote."""
        with np.load(path, allow_pickle=False) as stored:
            values = {f.name: stored[f.name] for f in fields(cls)}
        return cls(**{**values, "seed": int(values["seed"])})


@dataclass(frozen=True)
class WorldTask:
    """Measures one world; picklable, so that worlds can be spread over processes.

    Attributes:
        config: generator configuration.
        pairs: prior/truth pairs per world.
        events: simulate the event camera over each pair (slow).
        checkpoint: the authors' checkpoint, or None.
    """

    config: DrivingConfig
    pairs: int
    events: bool
    checkpoint: str | None

    def __call__(self, seed: int) -> WorldReport:
        """Measure the world of ``seed``."""
        scene = DrivingScene(self.config.scene, self.config.camera, seed)
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(7,)))
        latest = round(self.config.scene.duration_s * 1e6) - GAPS_MS[-1] * 1000
        starts = np.sort(rng.integers(_WARM_UP_TICKS, latest // TICK_US, self.pairs)) * TICK_US
        probe = _Probe(self.checkpoint) if self.checkpoint else None
        pairs = [_Pair(self.config, scene, int(t), rng, self.events or probe is not None) for t in starts]
        measured = [pair.measure(probe) for pair in pairs]
        columns = {name: np.array([m[name] for m in measured]) for name in measured[0]}
        return WorldReport(
            seed=seed,
            keyframes=_keyframes(scene, self.config),
            layer_moments=probe.moments() if probe else np.zeros((len(GAPS_MS), 0, 0, 3)),
            **columns,
        )


class _Pair:
    """A prior and the truths and events at the five gaps after it."""

    def __init__(
        self, config: DrivingConfig, scene: DrivingScene, start: int, rng: np.random.Generator, events: bool
    ) -> None:
        shape, far = config.camera.shape, config.lidar.max_depth
        self.far = far
        self.speed = scene.speed(start)
        intensity, depth = np.zeros(shape, np.float32), np.zeros(shape, np.float32)

        def look(t: int) -> NDArray[np.float32]:
            scene.render(t, intensity, depth)
            return quantise(depth, far)

        ends = [start + gap * 1000 for gap in GAPS_MS]
        self.voxels: list[NDArray[np.float32]] = []
        self.active = [np.nan] * len(GAPS_MS)
        if not events:
            self.prior = look(start)
            self.truths = [look(t) for t in ends]
            return
        camera = EventCamera(config.events, shape)
        camera.noise_scale = scene.noise_scale
        first = start - _WARM_UP_TICKS * TICK_US
        scene.render(first, intensity)
        camera.reset(intensity, first, rng)
        seen, self.truths = [], []
        for t in range(first + TICK_US, ends[-1] + 1, TICK_US):
            frame = look(t) if t == start or t in ends else scene.render(t, intensity)
            batch = camera.events(intensity, t)
            if t == start:
                self.prior = frame
            elif t > start:
                seen.append(batch)
                if t in ends:
                    self.truths.append(frame)
                    joined = np.concatenate(seen)
                    self.voxels.append(voxel_grid(joined, shape, start, t))
                    touched = np.zeros(shape, bool)
                    touched[joined["y"], joined["x"]] = True
                    self.active[len(self.voxels) - 1] = float(touched.mean())

    def measure(self, probe: _Probe | None) -> dict[str, object]:
        far, prior = self.far, self.prior
        blank = np.full(len(PAPER_METRICS) + len(FULL_METRICS), np.nan)
        network = np.tile(blank, (len(GAPS_MS), len(CONTROLS), 1))
        repeat, sky, change = [], [], []
        for g, truth in enumerate(self.truths):
            repeat.append([*paper_metrics(prior, truth, far), *full_metrics(prior, truth, far)])
            valid = truth > 0
            sky.append(float((prior[valid] == 0).mean()))
            both = valid & (prior > 0)
            change.append(float(np.abs(prior[both] - truth[both]).mean()))
            if probe is not None:
                for c, depth in enumerate(probe.predict(prior, self.voxels[g], g)):
                    paper = paper_metrics(depth, truth, far)
                    network[g, c] = [*paper, *full_metrics(returns_from_depth(depth), truth, far)]
        steps = np.diff(prior.astype(np.float64), axis=1)
        none = [np.nan] * len(GAPS_MS)
        return {
            "speed": self.speed,
            "repeat": repeat,
            "network": network,
            "sky_share": sky,
            "depth_change": change,
            "active": self.active,
            "no_return": float((prior == 0).mean()),
            "step_rms": float(np.sqrt((steps**2).mean())),
            "depth_moments": (float(prior.mean(dtype=np.float64)), float((prior.astype(np.float64) ** 2).mean())),
            "bin_std": [float(v.std()) for v in self.voxels] or none,
            "bin_active": [float((v != 0).mean()) for v in self.voxels] or none,
        }


class _Probe:
    """The authors' checkpoint with counters at every batch norm."""

    def __init__(self, checkpoint: str) -> None:
        import torch

        from nl_env.depth.unet import batch_norms, load_released

        torch.set_num_threads(1)
        self._torch = torch
        self._network = load_released(checkpoint).to(memory_format=torch.channels_last)
        self._layers = [layer for _, layer in batch_norms(self._network)]
        width = max(layer.num_features for layer in self._layers)
        self._sums = np.zeros((len(GAPS_MS), len(self._layers), width, 3))
        self._gap: int | None = None
        for index, layer in enumerate(self._layers):
            layer.register_forward_pre_hook(lambda _, inputs, i=index: self._count(i, inputs[0]))

    def _count(self, index: int, x: object) -> None:
        if self._gap is not None:
            values = x.double()  # type: ignore[attr-defined]
            channels = values.shape[1]
            rows = self._sums[self._gap, index, :channels]
            rows[:, 0] += values.numel() / channels
            rows[:, 1] += values.sum((0, 2, 3)).numpy()
            rows[:, 2] += (values * values).sum((0, 2, 3)).numpy()

    def predict(self, prior: NDArray[np.float32], voxel: NDArray[np.float32], gap: int) -> list[NDArray[np.float32]]:
        """Depth under each of ``CONTROLS``; the statistics are those of the first."""
        far_sky = np.where(prior == 0, np.float32(_SKY_CONTROL), prior)
        inputs = ((prior, voxel), (prior, np.zeros_like(voxel)), (prior, voxel[::-1].copy()), (far_sky, voxel))
        depths = []
        for control, (d, v) in enumerate(inputs):
            self._gap = gap if control == 0 else None
            with self._torch.inference_mode():
                out = self._network(self._torch.from_numpy(d)[None, None], self._torch.from_numpy(v)[None])
            depths.append(out[0, 0].numpy())
        return depths

    def moments(self) -> NDArray[np.float64]:
        """The sums so far."""
        return self._sums


def _keyframes(scene: DrivingScene, config: DrivingConfig) -> NDArray[np.bool_]:
    """Causes of the keyframe label at every slice, rendered at a quarter of the work when depth is needed."""
    detector = NewActorDetector(config.camera)
    detector.reset()
    intensity = np.zeros(config.camera.shape, np.float32)
    depth = np.zeros(config.camera.shape, np.float32)
    rows = []
    for k in range(config.scene.slices + 1):
        t = k * SLICE_US
        scene.render(t, intensity, depth)
        pose = scene.pose(t)
        new = detector.update(scene.actor_centres(t), pose, depth, t)
        state = EgoState(pose, np.zeros(6), scene.speed(t), scene.shortest_distance(t), new)
        label = label_keyframe(state)
        rows.append((label.speed, label.distance, label.new, label.keyframe))
    return np.array(rows[1:], bool)


def batch_norm_distance(checkpoint: str, reports: Sequence[WorldReport]) -> list[tuple[str, float]]:
    """Distance between what arrives at each batch norm here and what it saw in training.

    The symmetric Kullback-Leibler divergence (the sum of both directions) of two Gaussians per channel; the
    median over channels, as dead channels explode; the five gaps count equally.

    Returns:
        ``(layer name, distance)`` for each of the 31 layers.
    """
    from nl_env.depth.unet import batch_norms, load_released

    sums = np.sum([r.layer_moments for r in reports], axis=0)
    rows = []
    for index, (name, layer) in enumerate(batch_norms(load_released(checkpoint))):
        s = sums[:, index, : layer.num_features]
        mean = (s[..., 1] / s[..., 0]).mean(0)
        variance = (s[..., 2] / s[..., 0]).mean(0) - mean**2
        if layer.running_mean is None or layer.running_var is None:
            raise ValueError(f"checkpoint: batch norm {name} keeps no running statistics")
        theirs, spread = layer.running_mean.double().numpy(), layer.running_var.double().numpy()
        ratio = variance / np.maximum(spread, 1e-12)
        gap = (mean - theirs) ** 2
        divergence = 0.5 * (
            ratio + 1 / np.maximum(ratio, 1e-12) - 2 + gap * (1 / np.maximum(spread, 1e-12) + 1 / np.maximum(variance, 1e-12))
        )
        rows.append((name, float(np.median(divergence))))
    return rows
