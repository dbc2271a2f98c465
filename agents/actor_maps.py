"""Where near actors are in the image: a training target beside the keyframe label.

The label says that an actor is near, not where. A detector that learns to mark the cells of a coarse grid
that near actors cover learns to see them from far fewer sequences.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agents.keyframe_networks import CELL, RANGES
from nl_env.recording import Recording
from nl_env.scene.traffic import simulate
from nl_env.scene.traffic.trajectories import Traffic, rectangle_distance
from nl_env.types import SLICE_US, Camera

_REACH = 40.0
"""m between centres, beyond which an actor is not looked at."""
_NEAR_PLANE = 0.3
"""m in front of the camera; what is closer is cut off."""
_ALONG, _ACROSS, _UP = (np.linspace(-0.5, 0.5, n) for n in (7, 3, 2))
_POINTS = np.stack(np.meshgrid(_ALONG, _ACROSS, _UP, indexing="ij"), axis=-1).reshape(-1, 3)
"""Points of a body's box, as shares of length, width and height, from its middle."""


def grid(shape: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns of the maps for images of ``shape`` (H, W)."""
    return shape[0] // CELL, shape[1] // CELL


def actor_maps(recording: Recording) -> NDArray[np.bool_]:
    """``(K, len(RANGES), H / CELL, W / CELL)``: cells that actors within each range cover, slices 1..K.

    The traffic is simulated again from the recording's seed. Boxes stand for shapes, and occlusion does not
    count: nothing much stands between the ego and what is this near.
    """
    scene = recording.config.scene
    traffic = simulate(recording.description["scenario"], recording.seed, scene.duration_s)
    maps = np.zeros((recording.slices, len(RANGES), *grid(recording.camera.shape)), bool)
    for k, covered in enumerate(maps, start=1):
        t = k * SLICE_US
        _cover(covered, traffic, t, recording.pose(t), recording.camera)
    return maps


def _cover(
    covered: NDArray[np.bool_], traffic: Traffic, t_us: int, pose: NDArray[np.float64], camera: Camera
) -> None:
    """Mark the cells of one instant."""
    ego = traffic.ego_track.at(t_us)[0, 0]
    states = traffic.actor_states(t_us)
    for actor, state in zip(traffic.actors, states, strict=True):
        if np.hypot(state[0] - ego[0], state[1] - ego[1]) > _REACH:
            continue
        size = np.array([actor.length, actor.width])
        distance = rectangle_distance(ego, np.array(traffic.ego_size), state[:3], size)
        if distance >= RANGES[-1]:
            continue
        cells = _cells(state, (actor.length, actor.width, actor.height), pose, camera)
        for level, limit in enumerate(RANGES):
            if distance < limit:
                covered[level][cells] = True


def _cells(
    state: NDArray[np.float64],
    size: tuple[float, float, float],
    pose: NDArray[np.float64],
    camera: Camera,
) -> tuple[slice, slice]:
    """Rows and columns of the grid that the rectangle around a body's image covers; empty if out of view."""
    length, width, height = size
    along, across, up = (_POINTS * (length, width, height)).T
    c, s = np.cos(state[2]), np.sin(state[2])
    points = np.stack(
        [state[0] + c * along - s * across, state[1] + s * along + c * across, up + height / 2], axis=1
    )
    x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
    seen = z > _NEAR_PLANE
    if not seen.any():
        return slice(0, 0), slice(0, 0)
    columns = camera.fx * x[seen] / z[seen] + camera.cx
    rows = camera.fy * y[seen] / z[seen] + camera.cy
    return _span(rows, camera.height), _span(columns, camera.width)


def _span(pixels: NDArray[np.float64], size: int) -> slice:
    """The cells along one axis of ``size`` pixels that pixel coordinates reach."""
    first = int(max(pixels.min() + 0.5, 0.0) // CELL)
    last = int(-(-min(pixels.max() + 0.5, size) // CELL))
    return slice(min(first, size // CELL), max(last, 0))
