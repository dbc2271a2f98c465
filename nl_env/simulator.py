"""The synthetic sensors of one sequence, tick by tick: what streams and recordings are made of."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.config import DrivingConfig
from nl_env.keyframes import NewActorDetector
from nl_env.scene.scene import DrivingScene
from nl_env.sensors.event_camera import EventCamera
from nl_env.types import TICK_US, EgoState

EVENT_CAMERA_STREAM = 1
"""Spawn key that keeps the event camera's randomness apart from the scene's."""


class Simulator:
    """A drive through a synthetic scene in front of an event camera, at 200 Hz.

    Everything follows from the configuration and the sequence seed. After construction and after every
    :meth:`tick` the images show the instant ``t``; the caller lets ``event_camera`` see each of them once,
    summed (``accumulate``) or as a list (``events``).

    Args:
        config: the generator's configuration.
        seed: sequence seed, a non-negative integer.

    Attributes:
        t: time, us.
        intensity: ``(H, W)`` float32 in [0.001, 1], gamma-coded grey at ``t``; changed in place.
        depth: ``(H, W)`` float32 m, exact z-depth at the last tick that asked for it; changed in place.
        event_camera: started with the image of ``t = 0``.
    """

    def __init__(self, config: DrivingConfig, seed: int) -> None:
        camera = config.camera
        self.t = 0
        self.intensity = np.zeros(camera.shape, np.float32)
        self.depth = np.zeros(camera.shape, np.float32)
        self._scene = DrivingScene(config.scene, camera, seed)
        self._scene.render(0, self.intensity, self.depth)
        self.event_camera = EventCamera(config.events, camera.shape)
        self.event_camera.noise_scale = self._scene.noise_scale
        event_seed = np.random.SeedSequence(seed, spawn_key=(EVENT_CAMERA_STREAM,))
        self.event_camera.reset(self.intensity, 0, np.random.default_rng(event_seed))
        self._new_actors = NewActorDetector(camera)

    def tick(self, depth: bool) -> None:
        """Move 5 ms ahead and render; ``depth`` says whether the depth is wanted, too."""
        self.t += TICK_US
        self._scene.render(self.t, self.intensity, self.depth if depth else None)

    def state(self, depth: NDArray[np.float32]) -> EgoState:
        """Ego state at ``t``; called once at the end of every slice, ``t = 0`` included.

        Args:
            depth: ``(H, W)`` float32 m, the depth at ``t`` as the sensor quantises it.
        """
        t, scene = self.t, self._scene
        pose = scene.pose(t)
        return EgoState(
            pose=pose,
            twist=scene.twist(t),
            speed=float(scene.speed(t)),
            shortest_distance=float(scene.shortest_distance(t)),
            new_actors=self._new_actors.update(scene.actor_centres(t), pose, depth, t),
        )

    def motion(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Camera-to-world pose ``(4, 4)`` and twist ``(6,)`` at ``t``, as :class:`nl_env.types.EgoState`."""
        return self._scene.pose(self.t), self._scene.twist(self.t)

    def describe(self) -> dict[str, Any]:
        """Scenario, style, weather and seed, JSON-ready."""
        return self._scene.describe()
