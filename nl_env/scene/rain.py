"""Rain streaks: near drops falling through the view, seen by the event camera but not by the LiDAR."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from nl_env.scene.raster import FAST
from nl_env.types import Camera

_REFERENCE_WIDTH = 640


@njit(**FAST)
def _hash(a, b):
    """A uniform number in [0, 1) from two integers."""
    # Numba widens products of uint32 to uint64: cut back after each step.
    h = np.uint32(
        np.uint32(np.uint32(a) * np.uint32(0x9E3779B1)) ^ np.uint32(np.uint32(b) * np.uint32(0x85EBCA77))
    )
    h = np.uint32((h ^ (h >> np.uint32(15))) * np.uint32(0x2C1B3C6D))
    h = np.uint32((h ^ (h >> np.uint32(12))) * np.uint32(0x297A2D39))
    return np.uint32((h ^ (h >> np.uint32(15))) >> np.uint32(8)) * (1.0 / 16777216.0)


@njit(**FAST)
def _draw(streaks, seed, t_s, intensity):
    height, width = intensity.shape
    for i in range(streaks):
        # Each drop crosses the view again and again, every time elsewhere.
        lap = t_s * (1.5 + 2.5 * _hash(seed + i, 1)) + _hash(seed + i, 2)
        cycle = int(lap)
        near = _hash(seed + i, 3 + 4 * cycle)
        length = int((0.02 + 0.06 * near) * height) + 1
        slant = 0.12 * (_hash(seed, 0) - 0.5)
        top = (lap - cycle) * (height + length) - length
        x = _hash(seed + i, 4 + 4 * cycle) * width + slant * top
        glow = np.float32(0.05 + 0.12 * near)
        for k in range(length):
            y = int(top) + k
            column = int(x + slant * k)
            if 0 <= y < height and 0 <= column < width:
                intensity[y, column] = min(intensity[y, column] + glow, np.float32(1.0))


class Rain:
    """Draws ``streaks`` drops per 640 pixels of width; a function of time and seed alone."""

    def __init__(self, streaks: int, camera: Camera, seed: int) -> None:
        self._streaks = round(streaks * camera.width / _REFERENCE_WIDTH)
        self._seed = seed

    def draw(self, t_us: int, intensity: NDArray[np.float32]) -> None:
        """Brighten the streaks' pixels of ``(H, W)`` float32 ``intensity`` in place."""
        if self._streaks:
            _draw(self._streaks, self._seed, t_us * 1e-6, intensity)
