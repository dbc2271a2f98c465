"""Shot noise of the event camera: random events, found by jumping from one noisy pixel to the next."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from nl_env.sensors.event_crossings import PLAIN

BRIGHT_QUIET = 0.75
"""Share of the shot noise that full brightness removes."""

f4 = np.float32
u8 = np.uint64


@njit(**PLAIN, inline="always")
def key(time, pixel, on):
    """One event in 64 bits: time in the tick, pixel, polarity."""
    return u8(time) << u8(32) | u8(pixel) << u8(1) | u8(on)


@njit(**PLAIN)
def _uniform(state):
    """Next number in (0, 1] of the splitmix64 counter ``state``."""
    state[0] += u8(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> u8(30))) * u8(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> u8(27))) * u8(0x94D049BB133111EB)
    return (float((z ^ (z >> u8(31))) >> u8(11)) + 1.0) * 2.0**-53


@njit(**PLAIN)
def pixels_to_next_shot(tick, state, size):
    """Geometric distance to the next pixel with shot noise, at least 1; beyond ``size`` if there is none."""
    if tick.shot_probability <= 0:
        return size + 1
    return 1 + int(min(math.log(_uniform(state)) / math.log1p(-tick.shot_probability), size))


@njit(**PLAIN)
def shot_noise(intensity, pixels, tick, state, i, b, keys, total):
    """Append the shot noise of pixels ``i`` to ``b`` to ``keys``, jumping from one noisy pixel to the next.

    At most one event a pixel, ``tick.shot_probability`` in expectation in the dark and a quarter of that
    at full brightness, of either polarity, at a uniform time outside the dead time. The pixel is reset:
    its window recentres on the level at the end of the tick. Returns the next noisy pixel and the total.
    """
    while i < b:
        quiet = _uniform(state) > 1.0 - BRIGHT_QUIET * min(intensity[i], f4(1))
        t = min(int(_uniform(state) * tick.length), tick.length - 1)
        on = _uniform(state) > 0.5
        if not quiet and tick.start + t - pixels.last[i] >= tick.refractory:
            pixels.last[i] = tick.start + t
            pixels.on_at[i] = pixels.level[i] + f4(tick.leak_end) + pixels.on_step[i]
            pixels.off_at[i] = pixels.on_at[i] - (pixels.on_step[i] + pixels.off_step[i])
            keys[total] = key(t, i, on)
            total += 1
        i += pixels_to_next_shot(tick, state, intensity.size)
    return i, total
