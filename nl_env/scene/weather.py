"""CARLA's fourteen weather and light presets, as what they do to a grey-level scene and to the sensors.

Noon has a high sun, Sunset a low and weaker one. Clouds flatten the shading, wetness darkens the ground
and lays a reflecting film over it, rain adds streaks, haze and sensor noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nl_env.scene.render import Light
from nl_env.scene.textures import GAMMA


@dataclass(frozen=True)
class Weather:
    """One preset.

    Attributes:
        sun_elevation: radians above the horizon.
        ambient: share of the light that comes from the whole sky.
        exposure: overall brightness.
        sky: linear grey level of the sky at the horizon.
        clouds: contrast of the cloud layer.
        fog: extinction, 1/m.
        wetness: 0 dry to 1 standing water.
        streaks: rain streaks per frame of a 640-pixel-wide view.
        noise_scale: factor on the event camera's shot noise.
    """

    sun_elevation: float
    ambient: float
    exposure: float
    sky: float
    clouds: float
    fog: float
    wetness: float
    streaks: int
    noise_scale: float

    def light(self) -> Light:
        """What the renderer needs."""
        ground = self.shade(np.array([[0.0], [0.0], [1.0]]), 0.0)[0] * (1 - 0.35 * self.wetness)
        haze = (0.85 * self.sky) ** GAMMA
        return Light(
            sky=self.sky**GAMMA,
            zenith=-0.22,
            clouds=self.clouds,
            ground=float(ground**GAMMA),
            fog=self.fog,
            haze=haze,
            gloss=0.5 * self.wetness,
        )

    def shade(self, normals: NDArray[np.floating], azimuth: float) -> NDArray[np.float64]:
        """Linear brightness of surfaces with ``(3, N)`` unit ``normals``; sun at ``azimuth`` (radians)."""
        horizontal = math.cos(self.sun_elevation)
        sun = np.array(
            [horizontal * math.cos(azimuth), horizontal * math.sin(azimuth), math.sin(self.sun_elevation)]
        )
        direct = np.clip(sun @ normals, 0.0, None)
        return np.asarray(self.exposure * (self.ambient + (1 - self.ambient) * 1.3 * direct), np.float64)


_SKIES = {
    #             ambient exposure sky  clouds  fog   wetness streaks noise
    "Clear": (0.45, 1.10, 0.85, 0.25, 0.0000, 0.0, 0, 1.0),
    "Cloudy": (0.75, 0.85, 0.75, 0.50, 0.0002, 0.0, 0, 1.0),
    "Wet": (0.50, 1.00, 0.80, 0.25, 0.0000, 0.6, 0, 1.0),
    "WetCloudy": (0.80, 0.80, 0.70, 0.50, 0.0004, 0.6, 0, 1.1),
    "SoftRain": (0.82, 0.75, 0.66, 0.40, 0.0008, 0.5, 40, 1.2),
    "MidRain": (0.85, 0.70, 0.62, 0.35, 0.0015, 0.8, 90, 1.5),
    "HardRain": (0.88, 0.62, 0.56, 0.25, 0.0030, 1.0, 180, 2.0),
}


def preset(name: str) -> Weather:
    """The preset ``name``, one of ``config.WEATHERS``."""
    sunset = name.endswith("Sunset")
    ambient, exposure, sky, clouds, fog, wetness, streaks, noise = _SKIES[
        name.removesuffix("Sunset").removesuffix("Noon")
    ]
    if sunset:
        return Weather(
            math.radians(12),
            0.9 * ambient,
            0.78 * exposure,
            0.8 * sky,
            clouds,
            fog,
            wetness,
            streaks,
            1.5 * noise,
        )
    return Weather(math.radians(58), ambient, exposure, sky, clouds, fog, wetness, streaks, noise)
