"""Frozen, validated configuration. JSON in, JSON out; an unknown key raises and lists the valid ones."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any, TypeVar, get_type_hints

from nl_env.types import RESOLUTIONS, SLICE_US, Camera

SCENARIOS = ("highway", "intersection", "roundabout", "merge", "exit", "u-turn", "two-way")
STYLES = ("downtown", "suburb", "park", "rural")
WEATHERS = tuple(
    sky + light
    for light in ("Noon", "Sunset")
    for sky in ("Clear", "Cloudy", "Wet", "WetCloudy", "SoftRain", "MidRain", "HardRain")
)
"""CARLA's fourteen weather presets."""
NOISE_PRESETS = ("ideal", "realistic")
LIDAR_RATES = (1, 2, 5, 10, 25)
LIDAR_BEAMS = (0, 16, 32, 64, 128)
SPLITS = {
    "train": range(0, 1_900_000_000),
    "val": range(1_900_000_000, 2_000_000_000),
    "test": range(2_000_000_000, 2**31),
}
"""Sequence seeds of each split; a sequence belongs to exactly one. ``SPLITS["test"][:48]`` are the first 48
test sequences. Resets without a seed draw training sequences only."""

T = TypeVar("T")


def choice(name: str, value: Any, valid: tuple[Any, ...]) -> None:
    """Raise ``ValueError`` naming the argument, what was found and the valid values."""
    if value not in valid:
        raise ValueError(f"{name}: found {value!r}, expected one of {', '.join(map(repr, valid))}")


def number(name: str, value: Any, low: float, high: float) -> None:
    """Raise ``ValueError`` unless ``value`` is a finite number in ``[low, high]``."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f"{name}: found {value!r}, expected a finite number")
    if not low <= value <= high:
        raise ValueError(f"{name}: found {value!r}, expected a number in [{low}, {high}]")


@dataclass(frozen=True)
class SceneConfig:
    """Which world is built. ``None`` draws from the benchmark's mix with the sequence seed.

    Attributes:
        scenario: one of ``SCENARIOS`` or None.
        style: one of ``STYLES`` or None.
        weather: one of ``WEATHERS`` or None.
        duration_s: length of the sequence, s.
        fov_deg: horizontal field of view.
        camera_height: above ground, m.
        vibration: scale of the vehicle's pitch, roll and heave (0 = a rigid rail).
    """

    scenario: str | None = None
    style: str | None = None
    weather: str | None = None
    duration_s: float = 20.0
    fov_deg: float = 75.0
    camera_height: float = 2.4
    vibration: float = 0.3

    def __post_init__(self) -> None:
        choice("scenario", self.scenario, (None, *SCENARIOS))
        choice("style", self.style, (None, *STYLES))
        choice("weather", self.weather, (None, *WEATHERS))
        number("duration_s", self.duration_s, 0.2, 120.0)
        number("fov_deg", self.fov_deg, 20.0, 120.0)
        number("camera_height", self.camera_height, 0.3, 5.0)
        number("vibration", self.vibration, 0.0, 2.0)

    @property
    def slices(self) -> int:
        """Number of whole 20 ms slices."""
        return round(self.duration_s * 1e6) // SLICE_US


@dataclass(frozen=True)
class EventCameraConfig:
    """Contrast thresholds and noise of the event camera.

    Attributes:
        threshold_on, threshold_off: change of log intensity per event.
        threshold_mismatch: standard deviation of each pixel's thresholds (same unit).
        refractory_us: dead time of a pixel after an event, us.
        leak_rate_hz: ON events per second and pixel from leakage, at nominal threshold.
        shot_rate_hz: noise events per second and pixel in the dark.
        cutoff_hz: photoreceptor bandwidth at full brightness; 0 = unlimited.
    """

    threshold_on: float = 0.1
    threshold_off: float = 0.1
    threshold_mismatch: float = 0.0
    refractory_us: int = 0
    leak_rate_hz: float = 0.0
    shot_rate_hz: float = 0.0
    cutoff_hz: float = 0.0

    def __post_init__(self) -> None:
        number("threshold_on", self.threshold_on, 0.01, 5.0)
        number("threshold_off", self.threshold_off, 0.01, 5.0)
        number("threshold_mismatch", self.threshold_mismatch, 0.0, 1.0)
        number("refractory_us", self.refractory_us, 0, 1_000_000)
        number("leak_rate_hz", self.leak_rate_hz, 0.0, 100.0)
        number("shot_rate_hz", self.shot_rate_hz, 0.0, 100.0)
        number("cutoff_hz", self.cutoff_hz, 0.0, 1e6)

    @classmethod
    def preset(cls, name: str) -> EventCameraConfig:
        """``"ideal"`` (CARLA's DVS: thresholds only) or ``"realistic"`` (every noise source)."""
        choice("noise", name, NOISE_PRESETS)
        if name == "ideal":
            return cls()
        return cls(
            threshold_mismatch=0.01,
            refractory_us=250,
            leak_rate_hz=0.1,
            shot_rate_hz=1.0,
            cutoff_hz=2000.0,
        )


@dataclass(frozen=True)
class LidarConfig:
    """The depth sensor.

    Attributes:
        rate_hz: frames per second (a divisor of the 50 Hz slice rate).
        max_depth: range, m.
        beams: 0 = dense; 16, 32, 64 or 128 scan lines otherwise.
        energy_mj: energy of one frame, mJ.
    """

    rate_hz: int = 10
    max_depth: float = 200.0
    beams: int = 0
    energy_mj: float = 800.0

    def __post_init__(self) -> None:
        choice("lidar_hz", self.rate_hz, LIDAR_RATES)
        number("max_depth", self.max_depth, 1.0, 1000.0)
        choice("beams", self.beams, LIDAR_BEAMS)
        number("energy_mj", self.energy_mj, 0.0, 1e6)

    @property
    def period(self) -> int:
        """Slices between LiDAR frames."""
        return 1_000_000 // SLICE_US // self.rate_hz


@dataclass(frozen=True)
class DrivingConfig:
    """Everything that determines a synthetic sequence, next to its seed."""

    resolution: str = "quarter"
    scene: SceneConfig = field(default_factory=SceneConfig)
    events: EventCameraConfig = field(default_factory=lambda: EventCameraConfig.preset("realistic"))
    lidar: LidarConfig = field(default_factory=LidarConfig)

    def __post_init__(self) -> None:
        choice("resolution", self.resolution, tuple(RESOLUTIONS))

    @property
    def camera(self) -> Camera:
        """Intrinsics at this resolution."""
        return Camera.from_fov(*RESOLUTIONS[self.resolution], self.scene.fov_deg)


def to_dict(config: Any) -> dict[str, Any]:
    """A config dataclass as nested JSON-ready dicts."""
    return dataclasses.asdict(config)


def from_dict(cls: type[T], values: dict[str, Any]) -> T:
    """Rebuild config class ``cls`` from :func:`to_dict` output; unknown keys raise ``ValueError``."""
    hints = get_type_hints(cls)
    fields = tuple(f.name for f in dataclasses.fields(cls))  # type: ignore[arg-type]
    for key in values:
        choice(f"{cls.__name__} key", key, fields)
    return cls(
        **{
            key: from_dict(hints[key], value) if dataclasses.is_dataclass(hints[key]) else value
            for key, value in values.items()
        }
    )
