"""Event Slicer: event frame (Eq. 1) and voxel grid (Eq. 2), from events or from 4 ms bins.

Pure functions. Events are structured arrays with the fields of ``EVENT_DTYPE``; the polarity may be bool
or uint8 (0 is OFF) or int8 (-1, +1). Windows are half-open, ``[t0, t1)`` in us, and given explicitly:
events outside are ignored, a window without events gives zeros. Inputs are never modified.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from nl_env.types import BINS


def validate_events(events: NDArray[np.void], shape: tuple[int, int]) -> None:
    """Raise unless ``events`` is a sorted event array that fits a sensor of ``shape`` (H, W).

    Raises:
        TypeError: not a one-dimensional structured array with integer t, x, y and a bool, uint8 or int8 p.
        ValueError: unsorted times, coordinates outside the sensor, or polarities other than the dtype's.
    """
    names = events.dtype.names or ()
    if events.ndim != 1 or not {"t", "x", "y", "p"} <= set(names):
        raise TypeError(
            f"events: found {events.dtype} {events.shape}, expected a 1-d array with fields t, x, y, p"
        )
    for name in ("t", "x", "y"):
        if events.dtype[name].kind not in "iu":
            raise TypeError(f"events: found {name} of type {events.dtype[name]}, expected integers")
    if events.dtype["p"] not in (np.dtype(bool), np.dtype(np.uint8), np.dtype(np.int8)):
        raise TypeError(f"events: found p of type {events.dtype['p']}, expected bool, uint8 or int8")
    allowed = (-1, 1) if events.dtype["p"] == np.int8 else (0, 1)
    k = _first_fault(events["t"], events["x"], events["y"], events["p"], shape[0], shape[1], allowed)
    if k < 0:
        return
    t, x, y, p = (int(events[name][k]) for name in ("t", "x", "y", "p"))
    if k > 0 and t < events["t"][k - 1]:
        raise ValueError(f"events: found t going backwards at index {k}, expected sorted times")
    if not (0 <= x < shape[1] and 0 <= y < shape[0]):
        raise ValueError(f"events: found x = {x}, y = {y} at index {k}, expected a pixel of (H, W) = {shape}")
    raise ValueError(f"events: found p = {p} at index {k}, expected {allowed[0]} or {allowed[1]}")


def event_frame(events: NDArray[np.void], shape: tuple[int, int], t0: int, t1: int) -> NDArray[np.int16]:
    """Signed sum per pixel over ``[t0, t1)`` (Eq. 1).

    Args:
        events: sorted events.
        shape: ``(H, W)``.
        t0, t1: window, us.

    Returns:
        ``(H, W)`` int16.

    Raises:
        TypeError, ValueError: bad events (:func:`validate_events`) or an empty or reversed window.
    """
    frame = np.zeros((1, *shape), np.int16)
    _add_events(events, shape, _edges(t0, t1, 1), frame)
    return frame[0]


def voxel_grid(
    events: NDArray[np.void], shape: tuple[int, int], t0: int, t1: int, bins: int = BINS
) -> NDArray[np.float32]:
    """Signed sums per pixel in ``bins`` bins, bin ``floor(bins * (t - t0) / (t1 - t0))`` (Eq. 2).

    Args:
        events, shape, t0, t1: as :func:`event_frame`.
        bins: number of bins B.

    Returns:
        ``(bins, H, W)`` float32. The floor is exact: it is decided in integers.

    Raises:
        TypeError, ValueError: as :func:`event_frame`; ``bins`` below 1.
    """
    if bins < 1:
        raise ValueError(f"bins: found {bins!r}, expected at least 1")
    grid = np.zeros((bins, *shape), np.float32)
    _add_events(events, shape, _edges(t0, t1, bins), grid)
    return grid


def voxel_from_bins(slices: Sequence[NDArray[np.int16]]) -> NDArray[np.float32]:
    """Voxel grid (Eq. 2) over ``n`` consecutive slices, each given as its five 4 ms bins.

    A bin of the grid is 4n ms long, so it is exactly the sum of n consecutive 4 ms bins: the result
    equals :func:`voxel_grid` of the events, bit for bit.

    Args:
        slices: n >= 1 arrays ``(5, H, W)`` int16, oldest first.

    Returns:
        ``(5, H, W)`` float32.

    Raises:
        ValueError: no slice, or slices of another dtype or of different shapes.
    """
    if not slices:
        raise ValueError("slices: found none, expected at least one (5, H, W) array")
    shape = slices[0].shape
    for bins in slices:
        if bins.dtype != np.int16 or bins.ndim != 3 or bins.shape[0] != BINS or bins.shape != shape:
            raise ValueError(f"slices: found {bins.dtype} {bins.shape}, expected int16 (5, H, W), all alike")
    grid = np.empty(shape, np.float32)
    flat_grid = grid.reshape(BINS, -1)
    for number, bins in enumerate(slices):
        _add_slice(bins.reshape(BINS, -1), BINS * number, len(slices), flat_grid)
    return grid


def frame_from_bins(bins: NDArray[np.int16]) -> NDArray[np.int16]:
    """Event frame (Eq. 1) of a slice from its bins: ``(5, H, W)`` int16 to ``(H, W)`` int16."""
    if bins.dtype != np.int16 or bins.ndim != 3:
        raise ValueError(f"bins: found {bins.dtype} {bins.shape}, expected int16 (5, H, W)")
    frame = np.empty(bins.shape[1:], np.int16)
    _sum_bins(np.ascontiguousarray(bins).reshape(len(bins), -1), frame.reshape(-1))
    return frame


def _edges(t0: int, t1: int, bins: int) -> NDArray[np.int64]:
    """First microsecond of each bin, and ``t1``: the smallest t with ``bins * (t - t0) >= b * (t1 - t0)``."""
    if not t0 < t1:
        raise ValueError(f"t1: found {t1} with t0 = {t0}, expected a later time")
    return np.array([int(t0) - (-b * (int(t1) - int(t0)) // bins) for b in range(bins + 1)], np.int64)


def _add_events(
    events: NDArray[np.void],
    shape: tuple[int, int],
    edges: NDArray[np.int64],
    out: NDArray[np.int16] | NDArray[np.float32],
) -> None:
    """Add the events between consecutive ``edges`` to consecutive images of ``out`` (bins, H, W)."""
    validate_events(events, shape)
    polarity = np.ascontiguousarray(events["p"])
    if polarity.dtype != np.int8:
        polarity = 2 * polarity.astype(np.int8) - 1
    cuts = _cuts(events["t"], edges)
    for image, begin, end in zip(out, cuts[:-1], cuts[1:], strict=True):
        _scatter(events["x"][begin:end], events["y"][begin:end], polarity[begin:end], image)


@njit(cache=True, error_model="numpy")
def _first_fault(t, x, y, p, height, width, allowed):
    """Index of the first event that is out of order, off the sensor or of unknown polarity; -1 if none is."""
    for k in range(t.size):
        if k > 0 and t[k] < t[k - 1]:
            return k
        if x[k] < 0 or x[k] >= width or y[k] < 0 or y[k] >= height:
            return k
        if p[k] != allowed[0] and p[k] != allowed[1]:
            return k
    return -1


@njit(cache=True, error_model="numpy")
def _cuts(t, edges):
    """Index of the first event at or after each edge."""
    return np.searchsorted(t, edges)


@njit(cache=True, error_model="numpy")
def _scatter(x, y, polarity, image):
    """Add each polarity to its pixel; coordinates are valid."""
    for k in range(x.size):
        image[y[k], x[k]] += polarity[k]


@njit(cache=True, error_model="numpy")
def _sum_bins(bins, frame):
    """Sum ``(B, n)`` bins into ``(n,)``, so many pixels at a time that they stay in the nearest cache."""
    for start in range(0, frame.size, 4096):
        target = frame[start : start + 4096]
        target[:] = 0
        for k in range(bins.shape[0]):
            source = bins[k, start : start + 4096]
            for j in range(target.size):
                target[j] += source[j]


@njit(cache=True, error_model="numpy")
def _add_slice(bins, number, width, grid):
    """Add 4 ms bins ``number``, ``number + 1``, ... to the grid, whose bins are ``width`` of them wide."""
    for k in range(bins.shape[0]):
        source, target = bins[k], grid[(number + k) // width]
        if (number + k) % width == 0:
            for j in range(source.size):
                target[j] = np.float32(source[j])
        else:
            for j in range(source.size):
                target[j] += np.float32(source[j])
