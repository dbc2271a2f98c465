"""Event frames as the small pictures that networks look at, and what is remembered of those before.

A picture has a quarter of the rows and columns and one byte per number: the signed event sums of each block
of pixels, their magnitudes, and where there is a memory the magnitudes since the held depth frame was made.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.observations import IMAGE_OFFSET

POOL = 4
"""Event frames are summed over square blocks of this size."""
MOST_EVENTS = 7
"""Event sums are clipped to this magnitude: what lies above tells little more, and a block fits a byte."""
MOST = 127
"""The largest number in a picture."""
SUMS, MAGNITUDES, SINCE_DEPTH = range(3)
"""Channels; the last one only with a memory."""


def picture_shape(height: int, width: int) -> tuple[int, int]:
    """Rows and columns of the picture of event frames of ``height`` x ``width`` pixels.

    Raises:
        ValueError: they are too few, or no multiple of :data:`POOL`.
    """
    if min(height, width) < 8 * POOL or height % POOL or width % POOL:
        raise ValueError(
            f"image: found event frames of {height}x{width}, expected multiples of {POOL} "
            f"of at least {8 * POOL} pixels"
        )
    return height // POOL, width // POOL


def picture(images: NDArray[np.uint8]) -> NDArray[np.int8]:
    """``(n, H, W)`` image observations (128 = no change) to ``(n, 2, H / POOL, W / POOL)`` int8."""
    height, width = picture_shape(*images.shape[1:])
    low, high = np.uint8(IMAGE_OFFSET - MOST_EVENTS), np.uint8(IMAGE_OFFSET + MOST_EVENTS)
    sums = (np.clip(images, low, high) - np.uint8(IMAGE_OFFSET)).view(np.int8)
    shrunk = np.empty((len(images), 2, height, width), np.int8)
    for channel, values in ((SUMS, sums), (MAGNITUDES, np.abs(sums))):
        columns = _added([values[..., i::POOL] for i in range(POOL)])
        shrunk[:, channel] = _added([columns[:, i::POOL] for i in range(POOL)])
    return shrunk


def _added(parts: list[NDArray[np.int8]]) -> NDArray[np.int8]:
    total = parts[0] + parts[1]
    for part in parts[2:]:
        total += part
    return total


class PictureMemory:
    """Adds up the magnitudes of pictures since the held depth frame was made, in ``n`` environments.

    Follows from observations alone: the ``state`` says how old the held frame is. As there, the sums are 0 at
    the slice where a LiDAR frame arrives.

    Args:
        memory: ``(n, size)`` float32 rows of :func:`memory_size`, zeros where a sequence starts; written to.
        shape: rows and columns of the pictures.
    """

    def __init__(self, memory: NDArray[np.float32], shape: tuple[int, int]) -> None:
        self._since = memory[:, 0]
        self._sums = memory[:, 1:].reshape(len(memory), *shape)

    def see(self, shown: NDArray[np.int8], since_depth: NDArray[np.float32]) -> NDArray[np.int8]:
        """Take in the next slice of every environment.

        Args:
            shown: ``(n, 2, h, w)`` of :func:`picture`.
            since_depth: ``(n,)`` the field of the state.

        Returns:
            ``(n, 3, h, w)`` int8: the pictures with the channel :data:`SINCE_DEPTH`.
        """
        # An age that did not grow is that of another frame, made at the slice before.
        self._sums[since_depth <= self._since] = 0.0
        self._sums += shown[:, MAGNITUDES]
        self._sums[since_depth == 0] = 0.0
        self._since[:] = since_depth
        return with_memory(shown, self._sums)


def memory_size(shape: tuple[int, int]) -> int:
    """Numbers that a :class:`PictureMemory` keeps for one environment."""
    return 1 + shape[0] * shape[1]


def with_memory(shown: NDArray[np.int8], since_depth: NDArray[Any]) -> NDArray[np.int8]:
    """Pictures ``(..., 2, h, w)`` with summed magnitudes ``(..., h, w)`` as the third channel."""
    last = np.minimum(since_depth, MOST).astype(np.int8)[..., None, :, :]
    return np.concatenate([shown, last], axis=-3)
