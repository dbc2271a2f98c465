"""Which part of a real recording is imported, and how."""

from __future__ import annotations

from dataclasses import dataclass

from nl_env.config import SPLITS, LidarConfig, SceneConfig, choice, number
from nl_env.types import RESOLUTIONS

MAX_TOLERANCE_MS = 9.9
"""Below half a slice, so that no depth map serves two."""


@dataclass(frozen=True)
class ImportOptions:
    """Which part of a file becomes a recording, and how.

    Attributes:
        resolution: full (480x640), half (240x320) or quarter (120x160).
        start_s: begin this long after the first event; with depth, at the first map from there on.
        duration_s: length, s.
        crop: left, top, width and height in pixels of the sensor, a multiple of the resolution; None takes
            the largest that fits, centred.
        focal_px: focal length in pixels of the sensor; None takes the file's calibration.
        max_depth: range, m; depth beyond is no return.
        lidar_hz: LiDAR frames per second.
        depth_tolerance_ms: how far from a slice's end its depth map may be.
        seed: of the recording; None derives one from the file's name and start_s.
    """

    resolution: str = "quarter"
    start_s: float = 0.0
    duration_s: float = 20.0
    crop: tuple[int, int, int, int] | None = None
    focal_px: float | None = None
    max_depth: float = 200.0
    lidar_hz: int = 5
    depth_tolerance_ms: float = 5.0
    seed: int | None = None

    def __post_init__(self) -> None:
        choice("resolution", self.resolution, tuple(RESOLUTIONS))
        number("start_s", self.start_s, 0.0, 1e6)
        number("depth_tolerance_ms", self.depth_tolerance_ms, 0.0, MAX_TOLERANCE_MS)
        SceneConfig(duration_s=self.duration_s)
        LidarConfig(self.lidar_hz, self.max_depth)
        if self.focal_px is not None:
            number("focal_px", self.focal_px, 1.0, 1e5)
        if self.seed is not None and not any(self.seed in seeds for seeds in SPLITS.values()):
            raise ValueError(
                f"seed: found {self.seed!r}, expected an integer from 0 to {SPLITS['test'].stop - 1}"
            )
