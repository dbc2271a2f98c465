"""What the event camera remembers, what a tick is, and the buffers its kernels work in."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

CHUNK = 512
"""Pixels handled at a time, so that their state stays in the first cache; a multiple of ``lanes.LANES``."""

MAX_TICK_US = 100_000
"""Longest step; single-precision crossing times stay far below a microsecond of rounding."""


class Pixels(NamedTuple):
    """State of every pixel: flat arrays of length H * W, log-intensity units.

    Attributes:
        level: float32, filtered log intensity at the last tick, without leak.
        on_at, off_at: float32, leaked level of the next ON and of the next OFF event.
        on_step, off_step: float32, the pixel's contrast thresholds.
        last: int32, time of the last event, us since the camera's time base.
        apart: uint8, one per chunk: whether the distance of ``on_at`` and ``off_at`` was rounded when the
            time base moved. The chunk's next event makes it ``on_step + off_step`` again.
    """

    level: NDArray[np.float32]
    on_at: NDArray[np.float32]
    off_at: NDArray[np.float32]
    on_step: NDArray[np.float32]
    off_step: NDArray[np.float32]
    last: NDArray[np.int32]
    apart: NDArray[np.uint8]

    @classmethod
    def allocate(cls, size: int) -> Pixels:
        """Uninitialised state of ``size`` pixels."""
        level, on_at, off_at, on_step, off_step = np.empty((5, size), np.float32)
        chunks = np.zeros(-(-size // CHUNK), np.uint8)
        return cls(level, on_at, off_at, on_step, off_step, np.empty(size, np.int32), chunks)


class Scratch(NamedTuple):
    """Buffers of one chunk. All but ``old`` list the pixels that send events, and only those.

    Attributes:
        old: float32, leaked level of each pixel of the chunk at the start of the tick.
        place: int32, where in the chunk the pixel is; ascending.
        planned: float32, number of its events, negative for OFF.
        first, spacing: float32, time of its first event and distance between its events, us.
        on_at, off_at: float32, its next thresholds.
        sent, more: int32, its events in all earlier bins, and in the current one.
        times: int32, room for the events of one pixel.
    """

    old: NDArray[np.float32]
    place: NDArray[np.int32]
    planned: NDArray[np.float32]
    first: NDArray[np.float32]
    spacing: NDArray[np.float32]
    on_at: NDArray[np.float32]
    off_at: NDArray[np.float32]
    sent: NDArray[np.int32]
    more: NDArray[np.int32]
    times: NDArray[np.int32]

    @classmethod
    def allocate(cls) -> Scratch:
        """Fresh buffers."""
        old, planned, first, spacing, on_at, off_at = np.empty((6, CHUNK), np.float32)
        place, sent, more = np.empty((3, CHUNK), np.int32)
        times = np.empty(MAX_TICK_US, np.int32)
        return cls(old, place, planned, first, spacing, on_at, off_at, sent, more, times)


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
