"""Compiled core of the event camera.

Every pixel keeps the two log intensities at which its next ON and its next OFF event fall. A tick passes
over the image in chunks that stay in the first cache: ``event_crossings`` advances the chunk and plans the
events of its pixels, this module puts them into bins or into a list, ``event_noise`` adds the shot noise.

Binned counts and the event list come from the same plan and the same moments: they cannot disagree.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from nl_env.lanes import (
    EXACT,
    LANES,
    first_of,
    flags,
    gather,
    load,
    row_of,
    splat,
    store,
    to_float,
    to_int,
    where,
)
from nl_env.sensors.event_crossings import PLAIN, advance
from nl_env.sensors.event_noise import key, pixels_to_next_shot, shot_noise
from nl_env.sensors.event_state import CHUNK
from nl_env.types import BINS, SLICE_US

BIN_US = SLICE_US // BINS

f4 = np.float32
i4 = np.int32
u8 = np.uint64


@njit(**PLAIN)
def all_positive(intensity):
    """Whether every float32 of a flat array is positive, finite and normal; reads bits, so NaN is caught."""
    bits = intensity.view(np.int32)
    bad = i4(0)
    for j in range(bits.size):
        bad = i4(bad | i4(bits[j] < i4(0x00800000)) | i4(bits[j] > i4(0x7F7FFFFF)))
    return bad == 0


@njit(**PLAIN, inline="always")
def _moment(k, first, spacing, latest):
    """Microsecond of event ``k`` (float32, from 0) of a pixel, counted from the start of the tick."""
    return i4(min(max(first + k * spacing, f4(0)), latest))


@njit(**EXACT)
def _moments(k, first, spacing, latest):
    """:func:`_moment` of eight pixels."""
    zero = splat(f4(0))
    t = first + k * spacing
    t = where(t > zero, t, zero)
    return to_int(where(t < latest, t, latest))


@njit(**PLAIN)
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


@njit(**EXACT)
def _crowded(k, firing, tick, last, place, planned, first, spacing):
    """Bits of the listed pixels ``k`` to ``k + 7`` whose dead time may matter.

    Their first event comes too soon after the last one, or all are too dense. Two microseconds of margin
    cover the truncation to whole microseconds and the clip to the tick.
    """
    zero, one, refractory = splat(f4(0)), splat(f4(1)), splat(i4(tick.refractory))
    listed, latest = first_of(firing - k), splat(f4(tick.length - 1))
    count, apart = load(planned, k), load(spacing, k)
    earliest = splat(i4(tick.start)) + _moments(zero, load(first, k), apart, latest)
    soon = earliest - gather(last, load(place, k), listed) < refractory
    several = (count > one) | (count < zero - one)
    return flags((soon | (apart <= to_float(refractory + splat(2))) & several) & listed)


@njit(**PLAIN)
def _bin_crowded(firing, pixels, scratch, tick, bins, a):
    """Bin the events of crowded pixels one by one and take them off the plan; returns how many were sent."""
    total, count, place = 0, scratch.planned, scratch.place
    for group in range(0, firing, LANES):
        crowded = _crowded(
            group, firing, tick, row_of(pixels.last, a), row_of(place, 0), row_of(count, 0),
            row_of(scratch.first, 0), row_of(scratch.spacing, 0),
        )  # fmt: skip
        k = group
        while crowded:
            if crowded & 1:
                j = a + place[k]
                survivors, pixels.last[j] = _surviving(
                    count[k], scratch.first[k], scratch.spacing[k], pixels.last[j], tick, scratch.times
                )
                for t in scratch.times[:survivors]:
                    bins[(tick.offset + t) // BIN_US, j] += 1 if count[k] > f4(0) else -1
                total += survivors
                count[k] = f4(0)
            crowded >>= 1
            k += 1
    return total


@njit(**PLAIN)
def _bin_plan(firing, pixels, scratch, tick, bins, a):
    """Add the planned events of one chunk to its columns of ``bins``; returns how many were sent."""
    first_bin, last_bin = tick.offset // BIN_US, (tick.offset + tick.length - 1) // BIN_US
    count, place, more, last = scratch.planned, scratch.place, scratch.more, scratch.sent
    for bin_ in range(first_bin, last_bin + 1):
        _count_bin(
            firing, bin_ == first_bin, bin_ == last_bin, f4((bin_ + 1) * BIN_US - tick.offset),
            row_of(count, 0), row_of(scratch.first, 0), row_of(scratch.spacing, 0), row_of(scratch.sent, 0),
            row_of(more, 0),
        )  # fmt: skip
        for k in range(firing):
            bins[u8(bin_), u8(a) + u8(place[u8(k)])] += more[u8(k)]
    _last_events(
        firing, tick, row_of(count, 0), row_of(scratch.first, 0), row_of(scratch.spacing, 0), row_of(last, 0)
    )
    total = 0
    for k in range(firing):
        i = u8(k)
        total += int(abs(count[i]))
        if count[i] != f4(0):
            pixels.last[u8(a) + u8(place[i])] = last[i]
    return total


@njit(**EXACT)
def _count_bin(firing, opens, closes, edge, planned, first, spacing, sent, more):
    """Write to ``more`` how many events each listed pixel has in a bin that ends ``edge`` us into the tick.

    ``sent`` are the events of the bins before it; the first bin ``opens`` the tick, the last one ``closes``
    it. Events are counted without visiting them: the quotient is off by one at most, and the moments decide.
    """
    zero, one, end = splat(f4(0)), splat(f4(1)), splat(edge)
    for k in range(0, firing, LANES):
        count, start, apart = load(planned, k), load(first, k), load(spacing, k)
        size = where(count < zero, zero - count, count)
        before = size
        if not closes:
            before = (end - start) / apart
            before = where(before > zero, before, zero)
            before = to_float(to_int(where(before < size, before, size)))
            before = where((before < size) & (start + before * apart < end), before + one, before)
            late = (before > zero) & (start + (before - one) * apart >= end)
            before = where(late, before - one, before)
        signed = to_int(where(count > zero, before, zero - before))
        earlier = splat(0) if opens else load(sent, k)
        store(more, k, signed - earlier)
        store(sent, k, signed)


@njit(**EXACT)
def _last_events(firing, tick, planned, first, spacing, last):
    """Time of the last planned event of each listed pixel, us since the camera's time base."""
    zero, latest = splat(f4(0)), splat(f4(tick.length - 1))
    for k in range(0, firing, LANES):
        count = load(planned, k)
        size = where(count < zero, zero - count, count)
        t = _moments(size - splat(f4(1)), load(first, k), load(spacing, k), latest)
        store(last, k, splat(i4(tick.start)) + t)


@njit(**PLAIN)
def bin_tick(intensity, pixels, scratch, tick, state, keys, bins):
    """Simulate one tick and add its events to ``bins``.

    Args:
        intensity: flat float32, linear, positive.
        pixels, scratch, tick: as the classes of ``event_state``; ``pixels`` advances.
        state: ``(1,)`` uint64, counter of the noise generator; advances.
        keys: uint64 buffer, at least as long as ``intensity``.
        bins: ``(5, H * W)`` int16.

    Returns:
        The number of events.
    """
    total = shots = 0
    noisy = pixels_to_next_shot(tick, state, intensity.size) - 1
    for a in range(0, intensity.size, CHUNK):
        b = min(a + CHUNK, intensity.size)
        firing = advance(intensity, pixels, scratch, tick, a, b)
        if firing:
            if tick.refractory > 0:
                total += _bin_crowded(firing, pixels, scratch, tick, bins, a)
            total += _bin_plan(firing, pixels, scratch, tick, bins, a)
        noisy, shots = shot_noise(intensity, pixels, tick, state, noisy, b, keys, shots)
    for event in keys[:shots]:
        t, pixel = int(event >> u8(32)), int(np.uint32(event) >> np.uint32(1))
        bins[(tick.offset + t) // BIN_US, pixel] += 1 if event & u8(1) else -1
    return total + shots


@njit(**PLAIN)
def _with_room(keys, used, more):
    """``keys``, or a larger copy if ``more`` events do not fit after the ``used`` ones."""
    if used + more <= keys.size:
        return keys
    larger = np.empty(2 * (used + more), np.uint64)
    larger[:used] = keys[:used]
    return larger


@njit(**PLAIN)
def list_tick(intensity, pixels, scratch, tick, state, keys):
    """Simulate one tick like :func:`bin_tick`, listing the events; returns ``(keys, count)``.

    ``keys`` comes back larger if the events did not fit.
    """
    total = 0
    count, first, spacing, last = scratch.planned, scratch.first, scratch.spacing, pixels.last
    noisy = pixels_to_next_shot(tick, state, intensity.size) - 1
    for a in range(0, intensity.size, CHUNK):
        b = min(a + CHUNK, intensity.size)
        firing = advance(intensity, pixels, scratch, tick, a, b)
        for k in range(firing):
            j = a + scratch.place[k]
            keys = _with_room(keys, total, int(abs(count[k])))
            survivors, last[j] = _surviving(count[k], first[k], spacing[k], last[j], tick, scratch.times)
            for s in range(survivors):
                keys[total + s] = key(scratch.times[s], j, count[k] > f4(0))
            total += survivors
        keys = _with_room(keys, total, CHUNK)
        noisy, total = shot_noise(intensity, pixels, tick, state, noisy, b, keys, total)
    return keys, total


@njit(**PLAIN)
def sort_events(keys, length, start_us, width, out):
    """Unpack ``keys`` into the structured array ``out``, ordered by time (stable counting sort)."""
    position = np.zeros(length + 1, np.int64)
    for event in keys:
        position[(event >> u8(32)) + u8(1)] += 1
    for t in range(length):
        position[t + 1] += position[t]
    for event in keys:
        t = event >> u8(32)
        pixel = np.uint32(event) >> np.uint32(1)
        listed = out[position[t]]
        position[t] += 1
        listed.t = start_us + np.int64(t)
        listed.x = pixel % np.uint32(width)
        listed.y = pixel // np.uint32(width)
        listed.p = 1 if event & u8(1) else -1
