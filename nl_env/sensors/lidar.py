"""LiDAR: range, quantisation, optional beam pattern and energy."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from nl_env.config import LidarConfig
from nl_env.types import Camera

STEPS = 65_535
"""Depth is counted in steps of ``max_depth / STEPS``; code 0 means no return."""


def encode(depth: NDArray[np.float32], max_depth: float) -> NDArray[np.uint16]:
    """Depth as the sensor codes it: the nearest step, at least 1 for a return.

    Args:
        depth: float32 of any shape, metres. Zero, negative, NaN and anything beyond the range is no return.
        max_depth: range, m.

    Returns:
        uint16 codes of the same shape.

    Raises:
        ValueError: depth is not float32, or the range is not positive.
    """
    codes = np.empty(depth.shape, np.uint16)
    _encode(_flat(depth, max_depth), np.float32(max_depth), codes.reshape(-1))
    return codes


def decode(codes: NDArray[np.uint16], max_depth: float) -> NDArray[np.float32]:
    """Metres of sensor codes; the inverse of :func:`encode` up to half a step.

    Raises:
        ValueError: codes are not uint16, or the range is not positive.
    """
    if codes.dtype != np.uint16:
        raise ValueError(f"codes: found {codes.dtype}, expected uint16")
    _check_range(max_depth)
    depth = np.empty(codes.shape, np.float32)
    _decode(np.ascontiguousarray(codes).reshape(-1), np.float32(max_depth), depth.reshape(-1))
    return depth


def quantise(
    depth: NDArray[np.float32], max_depth: float, out: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Depth after the sensor's rounding, bit-identical to ``decode(encode(depth))``, in one pass.

    Args:
        depth, max_depth: as :func:`encode`.
        out: C-contiguous float32 array of the same shape to write to; may be ``depth`` itself.

    Returns:
        float32 metres, 0 = no return; ``out`` if it was given.

    Raises:
        ValueError: bad depth or range, or an ``out`` that does not fit.
    """
    flat = _flat(depth, max_depth)
    if out is None:
        out = np.empty(depth.shape, np.float32)
    elif out.shape != depth.shape or out.dtype != np.float32 or not out.flags.c_contiguous:
        raise ValueError(f"out: found {out.dtype} {out.shape}, expected C-contiguous float32 {depth.shape}")
    _quantise(flat, np.float32(max_depth), out.reshape(-1))
    return out


class Lidar:
    """Measures depth frames, pixel-aligned with the camera.

    Args:
        config: range, beams and energy (the rate is the stream's business).
        camera: gives the vertical field of view over which the beams are spread.

    Attributes:
        config: as given.
        rows: image rows hit by a scan line, ascending; all rows of a dense sensor. Scan lines are evenly
            spaced in elevation from the top to the bottom row, each rounded to the nearest row; where a
            row is coarser than the spacing, lines share it.
    """

    def __init__(self, config: LidarConfig, camera: Camera) -> None:
        self.config = config
        self.shape = camera.shape
        if config.beams == 0:
            self.rows = np.arange(camera.height)
        else:
            top, bottom = np.arctan((np.array([0, camera.height - 1]) - camera.cy) / camera.fy)
            lines = np.tan(np.linspace(top, bottom, config.beams)) * camera.fy + camera.cy
            self.rows = np.unique(np.rint(lines).astype(int))
        self._missed = np.setdiff1d(np.arange(camera.height), self.rows)

    def measure(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """One LiDAR frame.

        Args:
            depth: ``(H, W)`` float32 true z-depth, metres.

        Returns:
            ``(H, W)`` float32, quantised; 0 where nothing is in range or no scan line passes.

        Raises:
            ValueError: depth of another shape or dtype.
        """
        if depth.shape != self.shape:
            raise ValueError(f"depth: found shape {depth.shape}, expected {self.shape}")
        frame = quantise(depth, self.config.max_depth)
        frame[self._missed] = 0
        return frame

    def energy_mj(self, frames: int) -> float:
        """Energy of ``frames`` LiDAR frames, mJ."""
        return frames * self.config.energy_mj


def _check_range(max_depth: float) -> None:
    if not 0 < max_depth < np.inf:
        raise ValueError(f"max_depth: found {max_depth!r}, expected a positive number of metres")


def _flat(depth: NDArray[np.float32], max_depth: float) -> NDArray[np.float32]:
    """``depth`` as a flat contiguous view or copy, checked."""
    _check_range(max_depth)
    if depth.dtype != np.float32:
        raise ValueError(f"depth: found {depth.dtype}, expected float32")
    return np.ascontiguousarray(depth).reshape(-1)


@njit(cache=True, error_model="numpy", inline="always")
def _code(depth, max_depth):
    """Step number of one depth; comparisons with NaN are false, so NaN is no return."""
    steps = np.float32(STEPS)
    inside = (depth > np.float32(0)) & (depth <= max_depth)
    # Rounding half up after a clip keeps the conversion defined for every input.
    code = np.int32(min(max(depth / max_depth * steps, np.float32(1)), steps) + np.float32(0.5))
    return code if inside else np.int32(0)


@njit(cache=True, error_model="numpy", inline="always")
def _metres(code, max_depth):
    return np.float32(code) / np.float32(STEPS) * max_depth


@njit(cache=True, error_model="numpy")
def _encode(depth, max_depth, codes):
    for j in range(depth.size):
        codes[j] = _code(depth[j], max_depth)


@njit(cache=True, error_model="numpy")
def _decode(codes, max_depth, depth):
    for j in range(codes.size):
        depth[j] = _metres(codes[j], max_depth)


@njit(cache=True, error_model="numpy")
def _quantise(depth, max_depth, out):
    for j in range(depth.size):
        out[j] = _metres(_code(depth[j], max_depth), max_depth)
