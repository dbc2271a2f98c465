"""Colour maps for looking at event frames, depth and errors; numpy only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

NO_RETURN = np.array([24, 26, 32], np.uint8)
"""Colour of pixels without depth."""
_ON = np.array([92, 168, 255], np.float32)
_OFF = np.array([255, 102, 84], np.float32)
_QUIET = np.array([18, 20, 26], np.float32)


def _table(anchors: str) -> Image:
    """``(256, 3)`` uint8 colours interpolated through evenly spaced hexadecimal anchors."""
    points = np.array([tuple(bytes.fromhex(anchor)) for anchor in anchors.split()], float)
    at = np.linspace(0, len(points) - 1, 256)
    channels = [np.interp(at, np.arange(len(points)), points[:, c]) for c in range(3)]
    return np.rint(np.stack(channels, axis=1)).astype(np.uint8)


# Anchors of the perceptually uniform maps viridis and inferno (CC0).
VIRIDIS = _table("440154 482878 3e4989 31688e 26828e 1f9e89 35b779 6ece58 b5de2b fde725")
INFERNO = _table("000004 1b0c41 4a0c6b 781c6d a52c60 cf4446 ed6925 fb9b06 f7d13d fcffa4")


def grey(intensity: NDArray[np.float32]) -> Image:
    """``(H, W)`` in [0, 1] to grey, as a camera's image is shown."""
    level = np.rint(255 * np.clip(intensity, 0, 1)).astype(np.uint8)
    return np.repeat(level[..., None], 3, axis=2)


def events(event_frame: NDArray[np.int16], full_scale: int = 6) -> Image:
    """Signed event sums: blue brightens, red darkens, ``full_scale`` events saturate."""
    strength = np.sqrt(np.clip(np.abs(event_frame) / full_scale, 0, 1)).astype(np.float32)[..., None]
    hue = np.where((event_frame > 0)[..., None], _ON, _OFF)
    return (_QUIET + strength * (hue - _QUIET)).astype(np.uint8)


def depth(metres: NDArray[np.float32], min_depth: float, max_depth: float) -> Image:
    """Depth on a logarithmic scale, near bright; no return has its own colour."""
    span = np.log(max_depth / min_depth)
    nearness = 1.0 - np.log(np.clip(metres, min_depth, max_depth) / min_depth) / span
    coloured = VIRIDIS[np.rint(255 * nearness).astype(np.uint8)]
    return np.where((metres > 0)[..., None], coloured, NO_RETURN)


def log_error(
    held: NDArray[np.float32],
    true: NDArray[np.float32],
    min_depth: float,
    max_depth: float,
    full_scale: float = 0.7,
) -> Image:
    """``|ln held - ln true|`` per pixel with no return read as ``max_depth``; a factor of two saturates."""
    difference = np.log(_filled(held, min_depth, max_depth) / _filled(true, min_depth, max_depth))
    return INFERNO[np.rint(255 * np.clip(np.abs(difference) / full_scale, 0, 1)).astype(np.uint8)]


def _filled(metres: NDArray[np.float32], min_depth: float, max_depth: float) -> NDArray[np.float32]:
    return np.where(metres > 0, np.clip(metres, min_depth, max_depth), np.float32(max_depth))
