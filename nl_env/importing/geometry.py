"""From the pixels of a real sensor to those of a native recording: a crop, binned k by k."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nl_env.importing.source import Calibration
from nl_env.types import RESOLUTIONS


@dataclass(frozen=True)
class Crop:
    """A part of the sensor whose blocks of ``k x k`` pixels become one pixel each.

    Attributes:
        left, top: its first column and row.
        k: pixels of the sensor along a pixel of the recording.
        shape: ``(H, W)`` of the recording.
    """

    left: int
    top: int
    k: int
    shape: tuple[int, int]

    def events(self, events: NDArray[np.void]) -> NDArray[np.void]:
        """The events inside, with the recording's columns and rows; time and polarity stay."""
        x, y = events["x"].astype(np.int64) - self.left, events["y"].astype(np.int64) - self.top
        height, width = self.shape
        inside = (x >= 0) & (x < width * self.k) & (y >= 0) & (y < height * self.k)
        kept = events[inside]
        kept["x"], kept["y"] = x[inside] // self.k, y[inside] // self.k
        return kept

    def depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """``(H, W)`` float32 m: the nearest return of each block, 0 where it has none."""
        height, width = self.shape
        part = depth[self.top : self.top + height * self.k, self.left : self.left + width * self.k]
        blocks = np.where(part > 0, part, np.inf).reshape(height, self.k, width, self.k)
        nearest = blocks.min(axis=(1, 3)).astype(np.float32)
        return np.where(np.isfinite(nearest), nearest, np.float32(0))

    def fov_deg(self, focal: float) -> float:
        """Horizontal field of view of the recording, for a focal length in pixels of the sensor."""
        return math.degrees(2 * math.atan(self.shape[1] * self.k / 2 / focal))


def choose_crop(
    sensor: tuple[int, int],
    resolution: str,
    calibration: Calibration | None = None,
    rectangle: tuple[int, int, int, int] | None = None,
) -> Crop:
    """The crop of a sensor for a resolution.

    Args:
        sensor: ``(H, W)``.
        resolution: one of ``RESOLUTIONS``.
        calibration: whose principal point the crop is centred on; without it the sensor's centre.
        rectangle: left, top, width, height; None takes the largest that fits and is centred, as far as the
            sensor's edges allow.

    Raises:
        ValueError: a rectangle off the sensor or of another shape than whole blocks, or a sensor that is
            smaller than the resolution.
    """
    height, width = RESOLUTIONS[resolution]
    if rectangle is not None:
        left, top, crop_width, crop_height = rectangle
        k = crop_width // width
        if k < 1 or (crop_height, crop_width) != (height * k, width * k):
            raise ValueError(
                f"crop: found {crop_width}x{crop_height} pixels, "
                f"expected a multiple of {width}x{height} for resolution {resolution!r}"
            )
    else:
        k = min(sensor[0] // height, sensor[1] // width)
        if k < 1:
            raise ValueError(
                f"resolution: found {resolution!r}, {width}x{height}, "
                f"expected one that fits the sensor of {sensor[1]}x{sensor[0]}"
            )
        centre_x = (sensor[1] - 1) / 2 if calibration is None else calibration.cx
        centre_y = (sensor[0] - 1) / 2 if calibration is None else calibration.cy
        left = round(min(max(centre_x - (width * k - 1) / 2, 0), sensor[1] - width * k))
        top = round(min(max(centre_y - (height * k - 1) / 2, 0), sensor[0] - height * k))
    if left < 0 or top < 0 or left + width * k > sensor[1] or top + height * k > sensor[0]:
        raise ValueError(
            f"crop: found columns {left} to {left + width * k} and rows {top} to {top + height * k}, "
            f"expected them within the sensor of {sensor[1]}x{sensor[0]}"
        )
    return Crop(left, top, k, (height, width))
