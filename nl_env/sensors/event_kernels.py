"""Compiled core of the event camera.

Every pixel keeps the two log intensities at which its next ON and its next OFF event fall. A tick passes
over the image in chunks that stay in the first cache: low-pass and logarithm; then, where any pixel of the
chunk left its window, how many events each pixel sends and their even spacing in time. These passes are
short branch-free loops over contiguous arrays, each with few enough arrays for the compiler to vectorise,
so the cost hardly depends on how busy the scene is.

Binned counts and the event list come from the same plan and the same :func:`_moment`: they cannot disagree.
No fast-math flag is used: plain IEEE single precision, whatever the vector width.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from nl_env.types import BINS, SLICE_US

CHUNK = 512
"""Pixels handled at a time; a multiple of 8."""

MAX_TICK_US = 100_000
"""Longest step; single-precision crossing times stay far below a microsecond of rounding."""

BIN_US = SLICE_US // BINS

GLOW = 20 / 255
"""Intensity added in the bandwidth law, so that darkness is slow but not frozen (v2e: (I + 20) / 275)."""

REACH = 2e-6
"""A threshold this close (log units) counts as reached: the rounding of single-precision logarithms."""

BRIGHT_QUIET = 0.75
"""Share of the shot noise that full brightness removes."""

f4 = np.float32
i4 = np.int32
u8 = np.uint64


class Pixels(NamedTuple):
    """State of every pixel: flat arrays of length H * W, log-intensity units.

    Attributes:
        level: float32, filtered log intensity at the last tick, without leak.
        on_at, off_at: float32, leaked level of the next ON and of the next OFF event.
        on_step, off_step: float32, the pixel's contrast thresholds.
        last: int32, time of the last event, us since the camera's time base.
    """

    level: NDArray[np.float32]
    on_at: NDArray[np.float32]
    off_at: NDArray[np.float32]
    on_step: NDArray[np.float32]
    off_step: NDArray[np.float32]
    last: NDArray[np.int32]

    @classmethod
    def allocate(cls, size: int) -> Pixels:
        """Uninitialised state of ``size`` pixels."""
        level, on_at, off_at, on_step, off_step = np.empty((5, size), np.float32)
        return cls(level, on_at, off_at, on_step, off_step, np.empty(size, np.int32))


class Scratch(NamedTuple):
    """Buffers of one chunk.

    Attributes:
        old: float32, leaked level at the start of the tick.
        planned: float32, number of events of each pixel, negative for OFF.
        first, spacing: float32, time of the first event and distance between events, us.
        crowded: uint8, pixels whose refractory period may suppress events.
        times: int32, room for the events of one pixel.
    """

    old: NDArray[np.float32]
    planned: NDArray[np.float32]
    first: NDArray[np.float32]
    spacing: NDArray[np.float32]
    crowded: NDArray[np.uint8]
    times: NDArray[np.int32]

    @classmethod
    def allocate(cls) -> Scratch:
        """Fresh buffers."""
        old, planned, first, spacing = np.empty((4, CHUNK), np.float32)
        crowded, times = np.empty(CHUNK, np.uint8), np.empty(MAX_TICK_US, np.int32)
        return cls(old, planned, first, spacing, crowded, times)


class Tick(NamedTuple):
    """The step being simulated.

    Attributes:
        start: its first microsecond, counted from the camera's time base.
        length: duration, us.
        offset: its first microsecond, counted from the start of the slice (binned path only).
        leak_start, leak_end: accumulated leak at both ends, log units.
        bandwidth: 2 pi f_c * length at full brightness; 0 = unlimited.
        refractory: dead time, us.
        shot_probability: noise events per dark pixel in this tick.
    """

    start: int
    length: int
    offset: int
    leak_start: float
    leak_end: float
    bandwidth: float
    refractory: int
    shot_probability: float


@njit(cache=True, error_model="numpy", inline="always")
def _log(x):
    """Natural logarithm of a positive, normal float32; within 2 ulp (Cephes polynomial)."""
    bits = f4(x).view(np.int32)
    exponent = i4(i4(bits - i4(0x3F3504F3)) >> i4(23))
    f = i4(bits - i4(exponent << i4(23))).view(np.float32) - f4(1)
    p = f4(7.0376836292e-2)
    p = p * f - f4(1.1514610310e-1)
    p = p * f + f4(1.1676998740e-1)
    p = p * f - f4(1.2420140846e-1)
    p = p * f + f4(1.4249322787e-1)
    p = p * f - f4(1.6668057665e-1)
    p = p * f + f4(2.0000714765e-1)
    p = p * f - f4(2.4999993993e-1)
    p = p * f + f4(3.3333331174e-1)
    z = f * f
    return f + (f * z * p - f4(0.5) * z) + f4(exponent) * f4(0.6931471806)


@njit(cache=True, error_model="numpy", inline="always")
def _decay(x):
    """exp(-x) for a float32 x >= 0; absolute error below 3e-6."""
    t = min(x * f4(1.44269504), f4(120))
    k = i4(t)
    f = (f4(k) - t) * f4(0.69314718)
    p = f4(1 / 5040)
    p = p * f + f4(1 / 720)
    p = p * f + f4(1 / 120)
    p = p * f + f4(1 / 24)
    p = p * f + f4(1 / 6)
    p = p * f + f4(0.5)
    p = p * f + f4(1)
    p = p * f + f4(1)
    return p * i4(i4(i4(127) - k) << i4(23)).view(np.float32)


@njit(cache=True, error_model="numpy")
def all_positive(intensity):
    """Whether every float32 of a flat array is positive, finite and normal; reads bits, so NaN is caught."""
    bits = intensity.view(np.int32)
    bad = i4(0)
    for j in range(bits.size):
        bad = i4(bad | i4(bits[j] < i4(0x00800000)) | i4(bits[j] > i4(0x7F7FFFFF)))
    return bad == 0


@njit(cache=True, error_model="numpy")
def log_levels(intensity, level):
    """Write the log of ``intensity`` to ``level``, exactly as the scan computes it."""
    for j in range(level.size):
        level[j] = _log(intensity[j])


@njit(cache=True, error_model="numpy")
def _filter(intensity, bandwidth, leak, level, old):
    """Advance the low-pass of one chunk; the leaked previous levels go to ``old``.

    First order, exact for a step at the start of the tick; the corner frequency rises with intensity.
    """
    for j in range(level.size):
        old[j] = level[j] + leak
    if bandwidth > 0:
        rate, glow = f4(bandwidth / (1 + GLOW)), f4(GLOW)
        for j in range(level.size):
            gain = f4(1) - _decay(rate * (intensity[j] + glow))
            level[j] += gain * (_log(intensity[j]) - level[j])
    else:
        for j in range(level.size):
            level[j] = _log(intensity[j])


@njit(cache=True, error_model="numpy")
def _any_crossing(level, up, down, on_at, off_at):
    """Whether any pixel of a chunk reached a threshold."""
    crossed = i4(0)
    for j in range(level.size):
        crossed = i4(crossed | i4(level[j] + up >= on_at[j]) | i4(level[j] + down <= off_at[j]))
    return crossed != 0


@njit(cache=True, error_model="numpy")
def _plan(level, leak, on_at, off_at, on_step, off_step, length, old, count, first, spacing):
    """Plan the events of one chunk (see :class:`Scratch`) and move the references past them."""
    up, down = leak + f4(REACH), leak - f4(REACH)
    for j in range(level.size):
        rise = (level[j] + up - on_at[j]) / on_step[j]
        fall = (off_at[j] - level[j] - down) / off_step[j]
        beyond = max(rise, fall)
        crossings = f4(i4(beyond)) + f4(1) if beyond >= f4(0) else f4(0)
        count[j] = crossings if rise > fall else -crossings
    for j in range(level.size):
        change = max(abs(level[j] + leak - old[j]), f4(1e-9))
        spacing[j] = (on_step[j] if count[j] > f4(0) else off_step[j]) * length / change
    for j in range(level.size):
        ahead = on_at[j] - old[j] if count[j] > f4(0) else old[j] - off_at[j]
        first[j] = ahead * spacing[j] / (on_step[j] if count[j] > f4(0) else off_step[j])
    for j in range(level.size):
        on_at[j] += count[j] * (on_step[j] if count[j] > f4(0) else off_step[j])
    for j in range(level.size):
        off_at[j] = on_at[j] - (on_step[j] + off_step[j])
    for j in range(level.size):
        count[j] = min(max(count[j], -length), length)


@njit(cache=True, error_model="numpy")
def _advance(intensity, pixels, scratch, tick, a, b):
    """Advance pixels ``a`` to ``b``; returns whether there are events, then described by ``scratch``."""
    level, on_at, off_at = pixels.level[a:b], pixels.on_at[a:b], pixels.off_at[a:b]
    old, leak = scratch.old[: b - a], f4(tick.leak_end)
    _filter(intensity[a:b], tick.bandwidth, f4(tick.leak_start), level, old)
    if not _any_crossing(level, leak + f4(REACH), leak - f4(REACH), on_at, off_at):
        return False
    on_step, off_step = pixels.on_step[a:b], pixels.off_step[a:b]
    count, first, spacing = scratch.planned[: b - a], scratch.first[: b - a], scratch.spacing[: b - a]
    _plan(level, leak, on_at, off_at, on_step, off_step, f4(tick.length), old, count, first, spacing)
    return True


@njit(cache=True, error_model="numpy")
def _size(count):
    """Planned events of one chunk, both polarities."""
    total = i4(0)
    for j in range(count.size):
        total = i4(total + i4(abs(count[j])))
    return total


@njit(cache=True, error_model="numpy", inline="always")
def _moment(k, first, spacing, latest):
    """Microsecond of event ``k`` (float32, from 0) of a pixel, counted from the start of the tick."""
    return i4(min(max(first + k * spacing, f4(0)), latest))


@njit(cache=True, error_model="numpy")
def _surviving(count, first, spacing, last, tick, times):
    """Fill ``times`` with one pixel's events outside its dead time; returns how many, and ``last``."""
    survivors, latest = 0, f4(tick.length - 1)
    for k in range(int(abs(count))):
        t = _moment(f4(k), first, spacing, latest)
        if tick.start + t - last >= tick.refractory:
            last = i4(tick.start + t)
            times[survivors] = t
            survivors += 1
    return survivors, last


@njit(cache=True, error_model="numpy")
def _mark_crowded(count, first, spacing, last, tick, crowded):
    """Mark pixels whose dead time may matter: the first event too soon after the last one, or all too dense.

    Two microseconds of margin cover the truncation to whole microseconds and the clip to the tick.
    """
    start, refractory, latest = i4(tick.start), i4(tick.refractory), f4(tick.length - 1)
    for j in range(count.size):
        soon = i4(i4(start + _moment(f4(0), first[j], spacing[j], latest)) - last[j]) < refractory
        dense = (spacing[j] <= f4(refractory + i4(2))) & (abs(count[j]) > f4(1))
        crowded[j] = (soon | dense) & (count[j] != f4(0))


@njit(cache=True, error_model="numpy")
def _bin_crowded(count, first, spacing, last, tick, scratch, bins, a):
    """Bin the events of crowded pixels one by one and take them off the plan; returns how many were sent."""
    scratch.crowded[count.size :] = 0
    _mark_crowded(count, first, spacing, last, tick, scratch.crowded[: count.size])
    groups, total = scratch.crowded.view(np.uint64), 0
    for g in range(groups.size):
        if groups[g] == 0:
            continue
        for j in range(8 * g, 8 * g + 8):
            if scratch.crowded[j]:
                survivors, last[j] = _surviving(count[j], first[j], spacing[j], last[j], tick, scratch.times)
                for t in scratch.times[:survivors]:
                    bins[(tick.offset + t) // BIN_US, a + j] += 1 if count[j] > f4(0) else -1
                total += survivors
                count[j] = f4(0)
    return total


@njit(cache=True, error_model="numpy")
def _bin_plan(count, first, spacing, last, tick, bins, a):
    """Add the planned events of one chunk to its columns of ``bins``.

    The events before each edge between two bins are counted without visiting them: the quotient is off
    by one at most, and :func:`_moment` decides.
    """
    start, latest = i4(tick.start), f4(tick.length - 1)
    first_bin, last_bin = tick.offset // BIN_US, (tick.offset + tick.length - 1) // BIN_US
    b = a + count.size
    for k in range(first_bin, last_bin):
        here, after = bins[k, a:b], bins[k + 1, a:b]
        edge = f4((k + 1) * BIN_US - tick.offset)
        for j in range(count.size):
            size = abs(count[j])
            before = f4(i4(min(max((edge - first[j]) / spacing[j], f4(0)), size)))
            before += f4((before < size) & (first[j] + before * spacing[j] < edge))
            before -= f4((before > f4(0)) & (first[j] + (before - f4(1)) * spacing[j] >= edge))
            signed = i4(before if count[j] > f4(0) else -before)
            here[j] += signed
            after[j] -= signed
    here = bins[last_bin, a:b]
    for j in range(count.size):
        here[j] += i4(count[j])
    for j in range(count.size):
        size = abs(count[j])
        end = i4(start + _moment(size - f4(1), first[j], spacing[j], latest))
        last[j] = end if size > f4(0) else last[j]


@njit(cache=True, error_model="numpy", inline="always")
def _key(time, pixel, on):
    """One event in 64 bits: time in the tick, pixel, polarity."""
    return u8(time) << u8(32) | u8(pixel) << u8(1) | u8(on)


@njit(cache=True, error_model="numpy")
def _uniform(state):
    """Next number in (0, 1] of the splitmix64 counter ``state``."""
    state[0] += u8(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> u8(30))) * u8(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> u8(27))) * u8(0x94D049BB133111EB)
    return (float((z ^ (z >> u8(31))) >> u8(11)) + 1.0) * 2.0**-53


@njit(cache=True, error_model="numpy")
def _pixels_to_next_shot(tick, state, size):
    """Geometric distance to the next pixel with shot noise, at least 1; beyond ``size`` if there is none."""
    if tick.shot_probability <= 0:
        return size + 1
    return 1 + int(min(math.log(_uniform(state)) / math.log1p(-tick.shot_probability), size))


@njit(cache=True, error_model="numpy")
def _shot_noise(intensity, pixels, tick, state, i, b, keys, total):
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
            keys[total] = _key(t, i, on)
            total += 1
        i += _pixels_to_next_shot(tick, state, intensity.size)
    return i, total


@njit(cache=True, error_model="numpy")
def bin_tick(intensity, pixels, scratch, tick, state, keys, bins):
    """Simulate one tick and add its events to ``bins``.

    Args:
        intensity: flat float32, linear, positive.
        pixels, scratch, tick: as the classes above; ``pixels`` advances.
        state: ``(1,)`` uint64, counter of the noise generator; advances.
        keys: uint64 buffer, at least as long as ``intensity``.
        bins: ``(5, H * W)`` int16.

    Returns:
        The number of events.
    """
    total = shots = 0
    noisy = _pixels_to_next_shot(tick, state, intensity.size) - 1
    for a in range(0, intensity.size, CHUNK):
        b = min(a + CHUNK, intensity.size)
        if _advance(intensity, pixels, scratch, tick, a, b):
            last = pixels.last[a:b]
            count, first, spacing = scratch.planned[: b - a], scratch.first[: b - a], scratch.spacing[: b - a]
            if tick.refractory > 0:
                total += _bin_crowded(count, first, spacing, last, tick, scratch, bins, a)
            _bin_plan(count, first, spacing, last, tick, bins, a)
            total += _size(count)
        noisy, shots = _shot_noise(intensity, pixels, tick, state, noisy, b, keys, shots)
    for key in keys[:shots]:
        t, pixel = int(key >> u8(32)), int(np.uint32(key) >> np.uint32(1))
        bins[(tick.offset + t) // BIN_US, pixel] += 1 if key & u8(1) else -1
    return total + shots


@njit(cache=True, error_model="numpy")
def _with_room(keys, used, more):
    """``keys``, or a larger copy if ``more`` events do not fit after the ``used`` ones."""
    if used + more <= keys.size:
        return keys
    larger = np.empty(2 * (used + more), np.uint64)
    larger[:used] = keys[:used]
    return larger


@njit(cache=True, error_model="numpy")
def list_tick(intensity, pixels, scratch, tick, state, keys):
    """Simulate one tick like :func:`bin_tick`, listing the events; returns ``(keys, count)``.

    ``keys`` comes back larger if the events did not fit.
    """
    total = 0
    noisy = _pixels_to_next_shot(tick, state, intensity.size) - 1
    for a in range(0, intensity.size, CHUNK):
        b = min(a + CHUNK, intensity.size)
        crossing = _advance(intensity, pixels, scratch, tick, a, b)
        last = pixels.last[a:b]
        count, first, spacing = scratch.planned[: b - a], scratch.first[: b - a], scratch.spacing[: b - a]
        keys = _with_room(keys, total, (_size(count) if crossing else 0) + CHUNK)
        if crossing:
            for j in range(b - a):
                if count[j] != f4(0):
                    survivors, last[j] = _surviving(
                        count[j], first[j], spacing[j], last[j], tick, scratch.times
                    )
                    for k in range(survivors):
                        keys[total + k] = _key(scratch.times[k], a + j, count[j] > f4(0))
                    total += survivors
        noisy, total = _shot_noise(intensity, pixels, tick, state, noisy, b, keys, total)
    return keys, total


@njit(cache=True, error_model="numpy")
def sort_events(keys, length, start_us, width, out):
    """Unpack ``keys`` into the structured array ``out``, ordered by time (stable counting sort)."""
    position = np.zeros(length + 1, np.int64)
    for key in keys:
        position[(key >> u8(32)) + u8(1)] += 1
    for t in range(length):
        position[t + 1] += position[t]
    for key in keys:
        t = key >> u8(32)
        pixel = np.uint32(key) >> np.uint32(1)
        event = out[position[t]]
        position[t] += 1
        event.t = start_us + np.int64(t)
        event.x = pixel % np.uint32(width)
        event.y = pixel // np.uint32(width)
        event.p = 1 if key & u8(1) else -1
