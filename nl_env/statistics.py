"""Events as a few dozen numbers: how active each part of the image is, now and since the last depth frames.

A slice is described by :data:`SLICE_STATISTICS` numbers, :data:`MEASURES` in each cell of a fixed grid. They
are shares of pixels, so one policy fits every resolution. :class:`ActivityMemory` adds them up since the held
depth frame was made and since the last LiDAR frame; send-on-delta triggers on just such sums.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

IMAGE_ZERO = 128
"""The value of an image observation where the signed event sum is 0."""

GRID = (3, 4)
"""Rows and columns of regions; squares in an image of 3:4."""
MEASURES = ("active", "magnitude")
"""Share of pixels with a non-zero event sum; mean absolute event sum per pixel (clipped at 128)."""
SLICE_STATISTICS = len(MEASURES) * GRID[0] * GRID[1]
"""Numbers per slice: ``active`` of all regions row by row, then ``magnitude`` likewise."""
WINDOWS = ("slice", "since_depth", "since_lidar", "last_interval")
"""What :attr:`ActivityMemory.windows` sums over: this slice; the slices since the held depth frame was made;
those since the last LiDAR frame; those of the LiDAR interval before."""
ACTIVITY_FIELDS = len(WINDOWS) * SLICE_STATISTICS

TYPICAL = np.float32(0.2)
"""The activity that :func:`compress` maps to 1/2: about that of a slice in traffic."""


def slice_statistics(images: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Describe event frames by their activity in each region.

    Args:
        images: ``(H, W)`` or ``(K, H, W)`` uint8, image observations without their channel axis (128 = no
            change).

    Returns:
        ``(SLICE_STATISTICS,)`` or ``(K, SLICE_STATISTICS)`` float32, at least 0. An image gives the same
        numbers alone and among others.

    Raises:
        ValueError: another dtype, number of dimensions, or an image smaller than the grid.
    """
    if images.dtype != np.uint8 or images.ndim not in (2, 3):
        raise ValueError(
            f"images: found shape {images.shape} dtype {images.dtype}, expected (H, W) or (K, H, W) of uint8"
        )
    if images.shape[-2] < GRID[0] or images.shape[-1] < GRID[1]:
        raise ValueError(f"images: found {images.shape[-2]}x{images.shape[-1]}, expected at least 3x4 pixels")
    rows, columns = (_edges(size, parts) for size, parts in zip(images.shape[-2:], GRID, strict=True))
    stack = images.reshape(-1, *images.shape[-2:])
    sums = np.zeros((len(stack), len(MEASURES), *GRID), np.int32)
    _sum_regions(stack, rows, columns, sums)
    shares = sums / np.outer(np.diff(rows), np.diff(columns))
    return shares.astype(np.float32).reshape(*images.shape[:-2], SLICE_STATISTICS)


@njit(cache=True, error_model="numpy")
def _sum_regions(
    images: NDArray[np.uint8], rows: NDArray[np.int64], columns: NDArray[np.int64], sums: NDArray[np.int32]
) -> None:
    """Add the active pixels and the magnitudes of ``(K, H, W)`` to ``sums`` ``(K, 2, *GRID)``."""
    for k in range(len(images)):
        for row in range(len(rows) - 1):
            for y in range(rows[row], rows[row + 1]):
                for column in range(len(columns) - 1):
                    active = np.int32(0)
                    magnitude = np.int32(0)
                    for value in images[k, y, columns[column] : columns[column + 1]]:
                        event_sum = np.int32(value) - np.int32(IMAGE_ZERO)
                        active += np.int32(event_sum != 0)
                        magnitude += abs(event_sum)
                    sums[k, 0, row, column] += active
                    sums[k, 1, row, column] += magnitude


def _edges(size: int, parts: int) -> NDArray[np.int64]:
    """``(parts + 1,)`` first pixels of ``parts`` regions of nearly equal size, and the end."""
    return np.arange(parts + 1, dtype=np.int64) * size // parts


def compress(activity: NDArray[np.float32]) -> NDArray[np.float32]:
    """Map activities from 0 upwards to [0, 1): ``x / (x + TYPICAL)``."""
    return activity / (activity + TYPICAL)


class ActivityMemory:
    """Adds up slice statistics over the windows of :data:`WINDOWS`, for one environment or a batch of them.

    At every slice: :meth:`see` it, look at :attr:`windows`, then :meth:`act`. As in the environment's
    ``state``, sums since a depth frame are 0 at the slice where a LiDAR frame arrives.

    Args:
        batch: leading axes: ``()`` for one environment, ``(n,)`` for n.
    """

    def __init__(self, batch: tuple[int, ...] = ()) -> None:
        self._sums = np.zeros((*batch, len(WINDOWS), SLICE_STATISTICS), np.float32)

    @property
    def windows(self) -> NDArray[np.float32]:
        """``(*batch, len(WINDOWS), SLICE_STATISTICS)`` float32 sums; not a copy."""
        return self._sums

    def reset(self, where: Any = ...) -> None:
        """Forget everything in the environments that ``where`` (an index or mask) selects, by default all."""
        self._sums[where] = 0.0

    def see(self, statistics: NDArray[np.float32], lidar: NDArray[np.bool_] | bool) -> None:
        """Take in the slice to be acted on next.

        Args:
            statistics: ``(*batch, SLICE_STATISTICS)`` of :func:`slice_statistics`.
            lidar: ``batch``, whether a LiDAR frame arrives at this slice.
        """
        current, since_depth, since_lidar, last_interval = np.moveaxis(self._sums, -2, 0)
        current[...] = statistics
        since_depth += statistics
        since_lidar += statistics
        arrives = np.asarray(lidar)[..., None]
        np.copyto(last_interval, since_lidar, where=arrives)
        np.copyto(since_depth, 0.0, where=arrives)
        np.copyto(since_lidar, 0.0, where=arrives)

    def act(self, triggered: NDArray[np.bool_] | bool) -> None:
        """Account for the action: where ``triggered`` (``batch``), the held depth is of this slice."""
        since_depth = self._sums[..., WINDOWS.index("since_depth"), :]
        np.copyto(since_depth, 0.0, where=np.asarray(triggered)[..., None])

    def observed(self) -> NDArray[np.float32]:
        """``(*batch, ACTIVITY_FIELDS)`` float32 in [0, 1], fresh: the compressed windows one by one."""
        return compress(self._sums).reshape(*self._sums.shape[:-2], ACTIVITY_FIELDS)
