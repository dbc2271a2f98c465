"""The live stream of samples: a synthetic drive seen by an event camera and a LiDAR."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.config import DrivingConfig
from nl_env.representations import frame_from_bins
from nl_env.sensors.lidar import Lidar, quantise
from nl_env.simulator import Simulator
from nl_env.types import BINS, SLICE_US, TICKS_PER_SLICE, Sample


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
        self._lidar = Lidar(self.config.lidar, self.camera)
        self._simulator: Simulator | None = None
        self._index = 0

    def reset(self, seed: int) -> Sample:
        """Build the scene of ``seed`` and return sample 0."""
        self._simulator = Simulator(self.config, seed)
        self._index = 0
        return self._sample(self._simulator, np.zeros((BINS, *self.camera.shape), np.int16), event_count=0)

    def advance(self) -> Sample:
        """Simulate the next 20 ms; raises ``RuntimeError`` before ``reset`` or past the last sample."""
        simulator = self._running()
        if self._index == self.slices:
            raise RuntimeError(f"the sequence ended at slice {self.slices}; call reset(seed) for another")
        start = self._index * SLICE_US
        bins = np.zeros((BINS, *self.camera.shape), np.int16)
        event_count = 0
        for tick in range(1, TICKS_PER_SLICE + 1):
            simulator.tick(depth=tick == TICKS_PER_SLICE)
            event_count += simulator.event_camera.accumulate(
                simulator.intensity, simulator.t, bins, slice_start_us=start
            )
        self._index += 1
        return self._sample(simulator, bins, event_count)

    def intensity(self) -> NDArray[np.float32]:
        """``(H, W)`` float32 in [0, 1]: what a frame camera would see now."""
        return np.clip(self._running().intensity, 0.0, 1.0)

    def describe(self) -> dict[str, Any]:
        """Scenario, style, weather and seed of the running sequence, JSON-ready."""
        return self._running().describe()

    def close(self) -> None:
        """Drop the scene; may be called twice."""
        self._simulator = None

    def _running(self) -> Simulator:
        if self._simulator is None:
            raise RuntimeError("no sequence is running; call reset(seed) first")
        return self._simulator

    def _sample(self, simulator: Simulator, bins: NDArray[np.int16], event_count: int) -> Sample:
        depth = quantise(simulator.depth, self.max_depth)
        return Sample(
            index=self._index,
            t=simulator.t,
            bins=bins,
            event_frame=frame_from_bins(bins),
            event_count=event_count,
            depth=depth,
            lidar=self._lidar.measure(depth) if self._index % self.lidar_period == 0 else None,
            state=simulator.state(depth),
        )
