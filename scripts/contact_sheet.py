"""Draw every scenario in every style, the fourteen weathers in turn: intensity, depth and events."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # runs from a checkout, wherever it is started

import numpy as np
import tyro
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from tqdm import tqdm

from nl_env import colours
from nl_env.command_line import run_command
from nl_env.config import SCENARIOS, SPLITS, STYLES, WEATHERS, DrivingConfig, SceneConfig, number
from nl_env.representations import frame_from_bins
from nl_env.scene.scene import DrivingScene
from nl_env.sensors.event_camera import EventCamera
from nl_env.types import BINS, SLICE_US, TICK_US

TILE = (320, 240)
"""Width and height of the intensity image, px; depth and events are half as wide and high."""
GAP = 6
CAPTION = 15
BACKGROUND, INK = (255, 255, 255), (40, 44, 52)


@dataclass(frozen=True)
class Options:
    """Draw the contact sheet of the synthetic scenes."""

    out: Path = Path("docs/images/contact_sheet.png")
    """The picture to write."""
    seed_start: int = 0
    """First test sequence; every tile shows the next one."""
    time: float = 4.0
    """Moment of each sequence, seconds; the event frame covers the 20 ms before it."""
    resolution: str = "half"
    """Sensor resolution: full (480x640), half (240x320) or quarter (120x160)."""
    palette: int = 128
    """Colours of the picture (2 to 256): fewer make a smaller file."""

    def validate(self) -> None:
        """Raise ``ValueError`` naming the option, what was found and what was expected."""
        number("seed_start", self.seed_start, 0, len(SPLITS["test"]) - len(SCENARIOS) * len(STYLES))
        number("time", self.time, 0.1, SceneConfig().duration_s)
        number("palette", self.palette, 2, 256)
        DrivingConfig(resolution=self.resolution)


def draw_tile(config: DrivingConfig, seed: int, time_s: float) -> Image.Image:
    """One scene with its caption."""
    scene = DrivingScene(config.scene, config.camera, seed)
    intensity, depth, events = sense(config, scene, round(time_s * 1e6 / SLICE_US) * SLICE_US)
    width, height = TILE
    tile = Image.new("RGB", (width, CAPTION + height + height // 2), BACKGROUND)
    caption = f"{scene.scenario}, {scene.style}, {scene.weather}"
    ImageDraw.Draw(tile).text((1, 0), caption, INK, ImageFont.load_default(11))
    pictures = (
        (colours.grey(intensity), (0, CAPTION), TILE),
        (colours.depth(depth, 1.0, config.lidar.max_depth), (0, CAPTION + height), (width // 2, height // 2)),
        (colours.events(events), (width // 2, CAPTION + height), (width // 2, height // 2)),
    )
    for pixels, corner, size in pictures:
        tile.paste(Image.fromarray(pixels).resize(size, Image.Resampling.BOX), corner)
    return tile


def sense(
    config: DrivingConfig, scene: DrivingScene, t: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int16]]:
    """Intensity, depth and event frame at ``t`` us, each ``(H, W)``; the camera starts two slices earlier."""
    intensity, depth = (np.zeros(config.camera.shape, np.float32) for _ in range(2))
    camera = EventCamera(config.events, config.camera.shape)
    camera.noise_scale = scene.noise_scale
    start = t - 2 * SLICE_US
    scene.render(start, intensity)
    camera.reset(intensity, start, np.random.default_rng(scene.seed))
    bins = np.zeros((2, BINS, *config.camera.shape), np.int16)
    for tick in range(2 * SLICE_US // TICK_US):
        piece = tick * TICK_US // SLICE_US
        now = start + (tick + 1) * TICK_US
        scene.render(now, intensity, depth)
        camera.accumulate(intensity, now, bins[piece], start + piece * SLICE_US)
    return intensity, depth, frame_from_bins(bins[1])


def draw_sheet(options: Options) -> Image.Image:
    """Scenarios from left to right, styles from top to bottom."""
    width, height = TILE[0], CAPTION + TILE[1] + TILE[1] // 2
    columns, rows = len(SCENARIOS), len(STYLES)
    sheet = Image.new("RGB", (columns * (width + GAP) + GAP, rows * (height + GAP) + GAP), BACKGROUND)
    for k in tqdm(range(columns * rows), desc="scenes", unit="scene", disable=None):
        row, column = divmod(k, columns)
        world = SceneConfig(
            SCENARIOS[column], STYLES[row], WEATHERS[(k + 5 * (k // len(WEATHERS))) % len(WEATHERS)]
        )
        config = DrivingConfig(resolution=options.resolution, scene=world)
        tile = draw_tile(config, SPLITS["test"][options.seed_start + k], options.time)
        sheet.paste(tile, (GAP + column * (width + GAP), GAP + row * (height + GAP)))
    return sheet.quantize(options.palette, dither=Image.Dither.NONE)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""

    def work(given: list[str]) -> None:
        options = tyro.cli(Options, args=given, description=__doc__)
        options.validate()
        options.out.parent.mkdir(parents=True, exist_ok=True)
        draw_sheet(options).save(options.out, optimize=True)
        print(f"{options.out}: {options.out.stat().st_size / 1e6:.2f} MB")

    return run_command("contact_sheet", work, arguments)


if __name__ == "__main__":
    sys.exit(main())
