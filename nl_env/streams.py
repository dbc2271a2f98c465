"""Streams of samples: a synthetic drive seen by an event camera and a LiDAR."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.config import DrivingConfig
from nl_env.keyframes import NewActorDetector
from nl_env.representations import frame_from_bins
from nl_env.scene.scene import DrivingScene
from nl_env.sensors.event_camera import EventCamera
from nl_env.sensors.lidar import Lidar, quantise
from nl_env.types import BINS, SLICE_US, TICK_US, TICKS_PER_SLICE, EgoState, Sample

EVENT_CAMERA_STREAM = 1
"""Spawn key that keeps the event camera's randomness apart from the scene's."""


class SyntheticStream:
    """A drive through a synthetic scene, one sample per 20 ms slice; a :class:`nl_env.types.SensorStream`.

    Everything follows from the configuration and the sequence seed. Intensity is rendered every 5 ms
    for the event camera, depth at the end of every slice; the LiDAR measures every ``lidar_period`` slices.
    """

    def __init__(self, config: DrivingConfig | None = None) -> None:
        self.config = config or DrivingConfig()
        self.camera = self.config.camera
        self.slices = self.config.scene.slices
        self.lidar_period = self.config.lidar.period
        self.max_depth = self.config.lidar.max_depth
        self._scene: DrivingScene | None = None
        self._event_camera = EventCamera(self.config.events, self.camera.shape)
        self._lidar = Lidar(self.config.lidar, self.camera)
        self._new_actors = NewActorDetector(self.camera)
        self._intensity = np.zeros(self.camera.shape, np.float32)
        self._depth = np.zeros(self.camera.shape, np.float32)
        self._index = 0

    def reset(self, seed: int) -> Sample:
        """Build the scene of ``seed`` and return sample 0."""
        scene = DrivingScene(self.config.scene, self.camera, seed)
        scene.render(0, self._intensity, self._depth)
        event_seed = np.random.SeedSequence(seed, spawn_key=(EVENT_CAMERA_STREAM,))
        self._event_camera.noise_scale = scene.noise_scale
        self._event_camera.reset(self._intensity, 0, np.random.default_rng(event_seed))
        self._new_actors.reset()
        self._scene = scene
        self._index = 0
        return self._sample(scene, np.zeros((BINS, *self.camera.shape), np.int16), event_count=0)

    def advance(self) -> Sample:
        """Simulate the next 20 ms; raises ``RuntimeError`` before ``reset`` or past the last sample."""
        scene = self._running()
        if self._index == self.slices:
            raise RuntimeError(f"the sequence ended at slice {self.slices}; call reset(seed) for another")
        start = self._index * SLICE_US
        bins = np.zeros((BINS, *self.camera.shape), np.int16)
        event_count = 0
        for tick in range(1, TICKS_PER_SLICE + 1):
            t = start + tick * TICK_US
            last = tick == TICKS_PER_SLICE
            scene.render(t, self._intensity, self._depth if last else None)
            event_count += self._event_camera.accumulate(self._intensity, t, bins, start)
        self._index += 1
        return self._sample(scene, bins, event_count)

    def intensity(self) -> NDArray[np.float32]:
        """``(H, W)`` float32 in [0, 1]: what a frame camera would see now."""
        self._running()
        return np.clip(self._intensity, 0.0, 1.0)

    def describe(self) -> dict[str, Any]:
        """Scenario, style, weather and seed of the running sequence, JSON-ready."""
        return self._running().describe()

    def close(self) -> None:
        """Drop the scene; may be called twice."""
        self._scene = None

    def _running(self) -> DrivingScene:
        if self._scene is None:
            raise RuntimeError("no sequence is running; call reset(seed) first")
        return self._scene

    def _sample(self, scene: DrivingScene, bins: NDArray[np.int16], event_count: int) -> Sample:
        t = self._index * SLICE_US
        depth = quantise(self._depth, self.max_depth)
        pose = scene.pose(t)
        state = EgoState(
            pose=pose,
            twist=scene.twist(t),
            speed=float(scene.speed(t)),
            shortest_distance=float(scene.shortest_distance(t)),
            new_actors=self._new_actors.update(scene.actor_centres(t), pose, depth, t),
        )
        return Sample(
            index=self._index,
            t=t,
            bins=bins,
            event_frame=frame_from_bins(bins),
            event_count=event_count,
            depth=depth,
            lidar=self._lidar.measure(depth) if self._index % self.lidar_period == 0 else None,
            state=state,
        )
