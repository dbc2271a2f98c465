"""A drive: traffic, world, weather and camera of one sequence, renderable at any microsecond."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from nl_env.config import WEATHERS, SceneConfig
from nl_env.scene import models, weather, world
from nl_env.scene.quads import Objects, Quads, join
from nl_env.scene.rain import Rain
from nl_env.scene.raster import FAST, NORMAL, ORIGIN, U, V
from nl_env.scene.render import Renderer
from nl_env.scene.traffic import Actor, simulate
from nl_env.types import Camera

MIX = (
    ("intersection",) * 6 + ("highway",) * 4 + ("roundabout",) * 3 + ("two-way",) * 3
    + ("merge",) * 3 + ("exit",) * 3 + ("u-turn",) * 2
)  # fmt: skip
"""The benchmark's scenarios, in the proportions that match the published figures."""
_STYLES_OF = {"highway": ("rural", "suburb"), "merge": ("rural", "suburb"), "exit": ("rural",)}
_TOWN_STYLES = ("downtown", "suburb", "park")
_TWIST_STEP_US = 500
_RADIANS = math.pi / 180


@njit(**FAST)
def _pose_actors(template, first, size, poses, moving, centres):
    """Turn every actor's packed quads from its own frame into the world; ``poses`` are x, y and heading."""
    for m in range(poses.shape[0]):
        x, y = poses[m, 0], poses[m, 1]
        cos, sin = math.cos(poses[m, 2]), math.sin(poses[m, 2])
        centres[0, m], centres[1, m] = x, y
        for q in range(first[m], first[m] + size[m]):
            for column in (ORIGIN, U, V, NORMAL):
                a, b = template[q, column], template[q, column + 1]
                moving[q, column] = cos * a - sin * b
                moving[q, column + 1] = sin * a + cos * b
            moving[q, ORIGIN] += x
            moving[q, ORIGIN + 1] += y


def _actor_model(actor: Actor, rng: np.random.Generator) -> Quads:
    if actor.kind == "pedestrian":
        return models.pedestrian(rng, actor.height)
    make = models.truck if actor.kind == "truck" else models.car
    return make(rng, actor.length, actor.width, actor.height)


class DrivingScene:
    """One sequence's scene; everything follows from the configuration, the camera and the seed.

    Args:
        config: which world; ``None`` fields are drawn with the seed.
        camera: intrinsics of the pixel-aligned event camera and LiDAR.
        seed: sequence seed, a non-negative integer.
    """

    def __init__(self, config: SceneConfig, camera: Camera, seed: int) -> None:
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0,)))
        drawn = str(rng.choice(MIX))
        self.scenario = config.scenario or drawn
        self.style = config.style or str(rng.choice(_STYLES_OF.get(self.scenario, _TOWN_STYLES)))
        drawn = str(rng.choice(WEATHERS))
        self.weather = config.weather or drawn
        self.seed = seed
        self._config = config
        self.traffic = simulate(self.scenario, seed, config.duration_s)
        conditions = weather.preset(self.weather)
        built = world.build(self.traffic, self.style, conditions, camera.fx, rng)
        azimuth = float(rng.uniform(0, 2 * np.pi))
        parts = [_actor_model(actor, rng) for actor in self.traffic.actors]
        self._template = world.light(join(parts), conditions, azimuth).packed()
        self._moving = self._template.copy()
        sizes = np.array([p.number for p in parts], np.int32)
        count = len(parts)
        self._actors = Objects(
            np.zeros((3, count), np.float32),
            np.array([math.hypot(a.length, a.width, a.height) / 2 for a in self.traffic.actors], np.float32),
            (np.cumsum(sizes) - sizes).astype(np.int32),
            sizes,
        )
        self._half_heights = np.array([actor.height / 2 for actor in self.traffic.actors]).reshape(-1)
        self._actors.centre[2] = self._half_heights
        self._renderer = Renderer(
            camera, (built.quads, built.objects), built.ground, conditions.light(), len(self._template), count
        )
        self._rain = Rain(conditions.streaks, camera, int(rng.integers(2**31)))
        self._phases = rng.uniform(0, 2 * np.pi, 6)
        self.noise_scale = conditions.noise_scale

    def render(
        self, t_us: int, intensity: NDArray[np.float32], depth: NDArray[np.float32] | None = None
    ) -> None:
        """Render the instant ``t_us``.

        Args:
            t_us: time, us.
            intensity: ``(H, W)`` float32, filled with gamma-coded grey in [0.001, 1].
            depth: ``(H, W)`` float32, filled with z-depth in metres, 0 where nothing is within 200 m.
        """
        pose = self.pose(t_us)
        actors, poses = self._actors, self.traffic.actor_tracks.at(t_us)[0]
        _pose_actors(self._template, actors.first, actors.size, poses, self._moving, actors.centre)
        self._renderer.render(pose, (self._moving, actors), intensity, depth)
        self._rain.draw(t_us, intensity)

    def pose(self, t_us: int) -> NDArray[np.float64]:
        """``(4, 4)`` camera to world. The body pitches and rolls with the road and dives under braking."""
        ego = self.traffic.ego(t_us)
        config = self._config
        motion = (ego.x, ego.y, ego.heading, ego.speed, ego.acceleration)
        return _swaying_pose(motion, t_us * 1e-6, config.vibration, config.camera_height, self._phases)

    def twist(self, t_us: int) -> NDArray[np.float64]:
        """``(6,)`` camera-frame linear (m/s) and angular (rad/s) velocity, from poses 1 ms apart."""
        rotation = self.pose(t_us)[:3, :3]  # first: the renderer has just asked for this instant, too
        before, after = self.pose(max(t_us - _TWIST_STEP_US, 0)), self.pose(t_us + _TWIST_STEP_US)
        dt = (t_us + _TWIST_STEP_US - max(t_us - _TWIST_STEP_US, 0)) * 1e-6
        spin = before[:3, :3].T @ after[:3, :3] / dt
        linear = rotation.T @ (after[:3, 3] - before[:3, 3]) / dt
        # The antisymmetric part of R' dR/dt holds the angular velocity.
        turn = 0.5 * (spin - spin.T)
        return np.array([*linear, turn[2, 1], turn[0, 2], turn[1, 0]])

    def speed(self, t_us: int) -> float:
        """Ego speed, m/s."""
        return float(self.traffic.ego(t_us).speed)

    def shortest_distance(self, t_us: int) -> float:
        """From the ego's outline to the nearest moving actor's, m; ``inf`` when there is none."""
        return float(self.traffic.shortest_distance(t_us))

    def actor_centres(self, t_us: int) -> NDArray[np.float64]:
        """``(n, 4)``: x, y, z of each moving actor's centre and half its height, m."""
        centres = np.empty((len(self._half_heights), 4))
        centres[:, :2] = self.traffic.actor_tracks.at(t_us)[0, :, :2]
        centres[:, 2] = centres[:, 3] = self._half_heights
        return centres

    def describe(self) -> dict[str, Any]:
        """Scenario, style, weather and seed."""
        return {"scenario": self.scenario, "style": self.style, "weather": self.weather, "seed": self.seed}


@njit(cache=True, error_model="numpy")
def _swaying_pose(motion, t, vibration, camera_height, phases):  # type: ignore[no-untyped-def]
    """:meth:`DrivingScene.pose` at ``t`` s; ``motion`` is x, y, heading, speed, acceleration of the ego."""
    x, y, heading, speed, acceleration = motion
    shake = vibration * min(1.0, speed / 8.0)
    pitch = shake * (
        0.18 * _wave(1.3, t, phases[0]) + 0.08 * _wave(3.1, t, phases[1]) + 0.025 * _wave(9.0, t, phases[2])
    )
    pitch -= 0.25 * vibration * min(max(acceleration, -4.0), 4.0)
    roll = shake * (0.15 * _wave(0.9, t, phases[3]) + 0.06 * _wave(4.3, t, phases[4]))
    z = camera_height + 0.015 * shake * _wave(1.4, t, phases[5])
    return _pose((x, y, z), heading, pitch * _RADIANS, roll * _RADIANS)


@njit(cache=True, error_model="numpy", inline="always")
def _wave(hz, t, phase):  # type: ignore[no-untyped-def]
    return math.sin(2 * math.pi * hz * t + phase)


@njit(cache=True, error_model="numpy")
def _pose(position, heading, pitch, roll):  # type: ignore[no-untyped-def]
    ch, sh, cp, sp = math.cos(heading), math.sin(heading), math.cos(pitch), math.sin(pitch)
    cr, sr = math.cos(roll), math.sin(roll)
    right = (sh, -ch, 0.0)
    down = (-ch * sp, -sh * sp, -cp)
    ahead = (ch * cp, sh * cp, -sp)
    pose = np.zeros((4, 4))
    for k in range(3):
        pose[k, 0] = cr * right[k] + sr * down[k]
        pose[k, 1] = cr * down[k] - sr * right[k]
        pose[k, 2] = ahead[k]
        pose[k, 3] = position[k]
    pose[3, 3] = 1.0
    return pose


def camera_pose(
    position: tuple[float, float, float], heading: float, pitch: float, roll: float
) -> NDArray[np.float64]:
    """Camera-to-world pose of a forward-looking camera; positive pitch looks down, angles in radians."""
    return _pose(tuple(map(float, position)), float(heading), float(pitch), float(roll))
