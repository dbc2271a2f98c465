"""Event sums straight from the columns of a recording."""

from __future__ import annotations

from numba import njit


@njit(cache=True, error_model="numpy")
def add_events(x, y, p, frame):  # type: ignore[no-untyped-def]
    """Add every polarity to its pixel of ``frame`` ``(H, W)``; False as soon as an event is not valid."""
    height, width = frame.shape
    for k in range(x.size):
        if not _valid(x[k], y[k], p[k], width, height):
            return False
        frame[y[k], x[k]] += p[k]
    return True


@njit(cache=True, error_model="numpy")
def add_binned_events(t, x, y, p, edges, bins):  # type: ignore[no-untyped-def]
    """Add every polarity to its pixel of the bin its time is in.

    Args:
        t, x, y, p: columns of events.
        edges: first time of every bin of ``bins`` ``(B, H, W)``, and the end.
        bins: added to.

    Returns:
        False as soon as an event is not valid, earlier than the one before, or in no bin.
    """
    count, height, width = bins.shape
    number = 0
    before = edges[0]
    for k in range(x.size):
        time = t[k]
        if time < before or time >= edges[count] or not _valid(x[k], y[k], p[k], width, height):
            return False
        while time >= edges[number + 1]:
            number += 1
        bins[number, y[k], x[k]] += p[k]
        before = time
    return True


@njit(cache=True, error_model="numpy", inline="always")
def _valid(x, y, p, width, height):  # type: ignore[no-untyped-def]
    """Whether an event lies on the sensor and is brighter (1) or darker (-1); coordinates are unsigned.

    Without a branch on the polarity, which nobody can predict.
    """
    return (x < width) & (y < height) & (p * p == 1)
