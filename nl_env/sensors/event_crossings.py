"""Which pixels cross a threshold in a tick, how often, and when: eight pixels at a time (see ``lanes``).

All pixels pass through the low-pass and are compared with their thresholds; the few that reach one are
listed, and only these are planned. No fast-math flag is used: plain IEEE single precision
everywhere.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from nl_env.lanes import (
    EXACT,
    LANES,
    first_of,
    flags,
    from_bits,
    gather,
    how_many,
    load,
    load_some,
    row_of,
    shifted_down,
    splat,
    store,
    store_some,
    to_bits,
    to_float,
    to_int,
    where,
)
from nl_env.sensors.event_state import CHUNK

PLAIN: dict[str, Any] = {"cache": True, "error_model": "numpy"}
"""Options of the kernels that take arrays."""

GLOW = 20 / 255
"""Intensity added in the bandwidth law, so that darkness is slow but not frozen (v2e: (I + 20) / 275)."""

REACH = 2e-6
"""A threshold this close (log units) counts as reached: the rounding of single-precision logarithms."""

f4 = np.float32
i4 = np.int32
u8 = np.uint64

HOLDING = np.array(
    [sorted(range(LANES), key=lambda lane: not bits >> lane & 1) for bits in range(1 << LANES)], np.int32
)
"""``(256, 8)``: for each set of lanes, given as bits, those in the set and then the others, in order."""


@njit(**EXACT)
def _log(x):
    """Natural logarithm of positive, normal floats; within 2 ulp (Cephes polynomial)."""
    bits = to_bits(x)
    exponent = shifted_down(bits - splat(i4(0x3F3504F3)), splat(23))
    f = from_bits(bits - (exponent << splat(23))) - splat(f4(1))
    p = splat(f4(7.0376836292e-2))
    p = p * f - splat(f4(1.1514610310e-1))
    p = p * f + splat(f4(1.1676998740e-1))
    p = p * f - splat(f4(1.2420140846e-1))
    p = p * f + splat(f4(1.4249322787e-1))
    p = p * f - splat(f4(1.6668057665e-1))
    p = p * f + splat(f4(2.0000714765e-1))
    p = p * f - splat(f4(2.4999993993e-1))
    p = p * f + splat(f4(3.3333331174e-1))
    z = f * f
    return f + (f * z * p - splat(f4(0.5)) * z) + to_float(exponent) * splat(f4(0.6931471806))


@njit(**EXACT)
def _decay(x):
    """exp(-x) for floats >= 0; absolute error below 3e-6."""
    t = x * splat(f4(1.44269504))
    t = where(t < splat(f4(120)), t, splat(f4(120)))
    k = to_int(t)
    f = (to_float(k) - t) * splat(f4(0.69314718))
    p = splat(f4(1 / 5040))
    p = p * f + splat(f4(1 / 720))
    p = p * f + splat(f4(1 / 120))
    p = p * f + splat(f4(1 / 24))
    p = p * f + splat(f4(1 / 6))
    p = p * f + splat(f4(0.5))
    p = p * f + splat(f4(1))
    p = p * f + splat(f4(1))
    return p * from_bits((splat(127) - k) << splat(23))


@njit(**EXACT)
def _filtered(intensity, level, rate):
    """The next level behind the low-pass.

    First order, exact for a step at the start of the tick; the corner frequency rises with intensity.
    A ``rate`` of 0 means no low-pass.
    """
    target = _log(intensity)
    if rate > f4(0):
        gain = splat(f4(1)) - _decay(splat(rate) * (intensity + splat(f4(GLOW))))
        target = level + gain * (target - level)
    return target


@njit(**PLAIN)
def log_levels(intensity, level):
    """Write the log of ``intensity`` to ``level``, exactly as the scan computes it."""
    bright, row, dark = row_of(intensity, 0), row_of(level, 0), splat(f4(1))
    for j in range(0, level.size, LANES):
        wanted = first_of(level.size - j)
        store_some(row, j, wanted, _log(load_some(bright, j, wanted, dark)))


@njit(**PLAIN)
def advance(intensity, pixels, scratch, tick, a, b):
    """Advance pixels ``a`` to ``b`` and plan their events; returns how many pixels ``scratch`` lists."""
    firing = _scan(
        b - a, f4(tick.bandwidth / (1 + GLOW)), f4(tick.leak_start), f4(tick.leak_end),
        row_of(intensity, a), row_of(pixels.level, a), row_of(pixels.on_at, a), row_of(pixels.off_at, a),
        row_of(scratch.old, 0), row_of(scratch.place, 0), row_of(HOLDING, 0),
    )  # fmt: skip
    if firing < 0:
        return 0
    _plan(
        firing, f4(tick.leak_end), f4(tick.length), row_of(pixels.level, a), row_of(pixels.on_at, a),
        row_of(pixels.off_at, a), row_of(pixels.on_step, a), row_of(pixels.off_step, a),
        row_of(scratch.old, 0), row_of(scratch.place, 0), row_of(scratch.planned, 0),
        row_of(scratch.first, 0), row_of(scratch.spacing, 0), row_of(scratch.on_at, 0),
        row_of(scratch.off_at, 0),
    )  # fmt: skip
    _move_thresholds(firing, pixels, scratch, a, b)
    return firing


@njit(**EXACT)
def _reached(level, on_at, off_at, up, down):
    """Where a level has crossed a threshold, and where it fires: rounding lets a few fire a hair earlier."""
    rises = level + up >= on_at
    return rises | (level + down <= off_at), rises | (off_at - level >= down)


@njit(**EXACT)
def _scan(count, rate, leak_start, leak_end, intensity, level, on_at, off_at, old, place, holding):
    """Low-pass of ``count`` pixels; lists those that fire and returns how many, or -1 where none crossed."""
    firing, crossed, whole = 0, i4(0), count // LANES * LANES
    up, down = splat(leak_end + f4(REACH)), splat(leak_end - f4(REACH))
    for j in range(0, whole, LANES):
        before = load(level, j)
        now = _filtered(load(intensity, j), before, rate)
        store(old, j, before + splat(leak_start))
        store(level, j, now)
        crosses, fires = _reached(now, load(on_at, j), load(off_at, j), up, down)
        crossed |= flags(crosses)
        store(place, firing, load(holding, LANES * flags(fires)) + splat(j))
        firing += how_many(fires)
    if whole < count:
        here, one = first_of(count - whole), splat(f4(1))
        before = load_some(level, whole, here, one)
        now = _filtered(load_some(intensity, whole, here, one), before, rate)
        store(old, whole, before + splat(leak_start))
        store_some(level, whole, here, now)
        on, off = load_some(on_at, whole, here, one), load_some(off_at, whole, here, one)
        crosses, fires = _reached(now, on, off, up, down)
        crossed |= flags(crosses & here)
        store(place, firing, load(holding, LANES * flags(fires & here)) + splat(whole))
        firing += how_many(fires & here)
    return firing if crossed else -1


@njit(**EXACT)
def _plan(firing, leak, length, level, on_at, off_at, on_step, off_step, old, place, planned, first, spacing,
          next_on, next_off):  # fmt: skip
    """Plan the events of the listed pixels and where their thresholds go (see ``event_state.Scratch``)."""
    zero, one, limit, least = splat(f4(0)), splat(f4(1)), splat(length), splat(f4(1e-9))
    up, down = splat(leak + f4(REACH)), splat(leak - f4(REACH))
    for k in range(0, firing, LANES):
        listed = first_of(firing - k)
        at = load(place, k)
        now, before = gather(level, at, listed), gather(old, at, listed)
        on, off = gather(on_at, at, listed), gather(off_at, at, listed)
        rising_by, falling_by = gather(on_step, at, listed), gather(off_step, at, listed)
        rise, fall = now + up - on, off - now - down
        rising = rise >= zero
        step = where(rising, rising_by, falling_by)
        crossings = to_float(to_int(where(rising, rise, fall) / step)) + one
        count = where(rising, crossings, zero - crossings)
        change = now + splat(leak) - before
        change = where(change < zero, zero - change, change)
        apart = step * limit / where(change > least, change, least)
        store(first, k, where(rising, on - before, before - off) * apart / step)
        store(spacing, k, apart)
        on = on + count * step
        store(next_on, k, on)
        store(next_off, k, on - (rising_by + falling_by))
        count = where(count < limit, count, limit)
        store(planned, k, where(count > zero - limit, count, zero - limit))


@njit(**PLAIN)
def _move_thresholds(firing, pixels, scratch, a, b):
    """Move the thresholds of the listed pixels of chunk ``a`` to ``b`` past their events."""
    for k in range(firing):
        pixel = u8(a) + u8(scratch.place[u8(k)])
        pixels.on_at[pixel] = scratch.on_at[u8(k)]
        pixels.off_at[pixel] = scratch.off_at[u8(k)]
    if pixels.apart[a // CHUNK]:
        pixels.apart[a // CHUNK] = 0
        for i in range(a, b):
            pixels.off_at[i] = pixels.on_at[i] - (pixels.on_step[i] + pixels.off_step[i])
