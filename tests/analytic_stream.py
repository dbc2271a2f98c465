"""A stream whose every number is known: a camera drives straight at a striped wall; a square slides across.

The event camera is exact: per pixel, an event is a change of ``floor(log intensity / CONTRAST)``.
"""

from __future__ import annotations

import numpy as np

from nl_env.types import BINS, SLICE_US, Camera, EgoState, Sample

CONTRAST = 0.1
POSE_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Columns: camera x (right), y (down), z (forward) in world coordinates; the camera looks along world x."""


class WallStream:
    """Wall at ``distance`` m at t = 0, approached at ``speed`` m/s; above a fifth of the image is sky.

    ``reset(seed)`` shifts the square's path, so that sequences differ.
    """

    def __init__(self, slices=20, lidar_period=5, speed=10.0, distance=40.0, square_speed=4.0, size=(48, 64)):
        self.camera = Camera.from_fov(*size, 70.0)
        self.slices = slices
        self.lidar_period = lidar_period
        self.max_depth = 200.0
        self.speed = speed
        self.distance = distance
        self.square_speed = square_speed
        self.closed = 0
        self._index = None
        rows, columns = np.mgrid[: size[0], : size[1]]
        self._x = (columns - self.camera.cx) / self.camera.fx
        self._y = (rows - self.camera.cy) / self.camera.fy

    def reset(self, seed):
        self._offset = float(np.random.default_rng(seed).uniform(-2, 2))
        self._index = 0
        return self._sample(np.zeros((BINS, *self.camera.shape), np.int16))

    def advance(self):
        if self._index is None or self._index == self.slices:
            raise RuntimeError("reset the stream first")
        edges = np.linspace(self._index * SLICE_US, (self._index + 1) * SLICE_US, BINS + 1)
        levels = np.stack([np.floor(np.log(self.render(t)[0]) / CONTRAST) for t in edges])
        self._index += 1
        return self._sample(np.diff(levels, axis=0).astype(np.int16))

    def intensity(self):
        return self.render(self._index * SLICE_US)[0]

    def describe(self):
        return {"scenario": "wall"}

    def close(self):
        self.closed += 1

    def render(self, t_us):
        """Intensity and depth at ``t_us``."""
        seconds = t_us * 1e-6
        wall = self.distance - self.speed * seconds
        depth = np.full(self.camera.shape, wall)
        intensity = 0.5 + 0.4 * np.sin(2.0 * self._x * wall) * np.cos(1.5 * self._y * wall)
        depth[: self.camera.height // 5] = 0.0
        intensity[: self.camera.height // 5] = 0.9
        near = 0.5 * wall
        centre = self._offset + self.square_speed * seconds
        square = (abs(self._x * near - centre) < 1.0) & (abs(self._y * near) < 1.0)
        depth[square] = near
        intensity[square] = 0.2
        return intensity.astype(np.float32), depth.astype(np.float32)

    def _sample(self, bins):
        t = self._index * SLICE_US
        depth = self.render(t)[1]
        pose = np.eye(4)
        pose[:3, :3] = POSE_AXES
        pose[0, 3] = self.speed * t * 1e-6
        state = EgoState(
            pose=pose,
            twist=np.array([0.0, 0.0, self.speed, 0.0, 0.0, 0.0]),
            speed=self.speed,
            shortest_distance=0.5 * float(self.distance - self.speed * t * 1e-6),
            new_actors=int(self._index == 3),
        )
        return Sample(
            index=self._index,
            t=t,
            bins=bins,
            event_frame=bins.sum(axis=0, dtype=np.int16),
            event_count=int(np.abs(bins).sum()),
            depth=depth,
            lidar=depth if self._index % self.lidar_period == 0 else None,
            state=state,
        )
