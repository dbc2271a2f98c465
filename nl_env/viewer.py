"""The panel that ``render`` draws, and the window that shows it."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from nl_env import colours

CELL = (320, 240)
"""Width and height of one picture, px."""
MARGIN = 8
TITLE = 20
STRIP = 96
"""Height of the time line, px."""
WIDTH = 3 * CELL[0] + 4 * MARGIN
HEIGHT = 2 * (CELL[1] + TITLE + MARGIN) + STRIP + 2 * MARGIN

BACKGROUND = (32, 34, 42)
INK = (226, 229, 236)
FAINT = (120, 126, 140)
LIDAR_INK = (150, 156, 170)
TRIGGER_INK = (255, 176, 64)
KEYFRAME_INK = (64, 178, 150)


@dataclass
class Timeline:
    """What happened at every slice so far, t = 0 first."""

    lidar: list[bool] = field(default_factory=list)
    triggered: list[bool] = field(default_factory=list)
    keyframe: list[bool] = field(default_factory=list)
    error: list[float] = field(default_factory=list)

    def add(self, lidar: bool, triggered: bool, keyframe: bool, error: float) -> None:
        """Append one slice; a NaN error is drawn as 0."""
        self.lidar.append(lidar)
        self.triggered.append(triggered)
        self.keyframe.append(keyframe)
        self.error.append(0.0 if math.isnan(error) else error)


@dataclass(frozen=True)
class PanelView:
    """Everything one panel shows; images are ``(H, W)``, depth in metres with 0 = no return."""

    t_us: int
    intensity: NDArray[np.float32]
    event_frame: NDArray[np.int16]
    true_depth: NDArray[np.float32]
    held_depth: NDArray[np.float32]
    max_depth: float
    min_depth: float
    held_source: str
    held_age_us: int
    effective_rate: float
    ego_speed: float
    error_name: str
    slices: int
    timeline: Timeline


def draw_panel(view: PanelView) -> NDArray[np.uint8]:
    """The panel as ``(HEIGHT, WIDTH, 3)`` uint8."""
    limits = view.min_depth, view.max_depth
    error = colours.log_error(view.held_depth, view.true_depth, *limits)
    canvas = Image.new("RGB", (WIDTH, HEIGHT), BACKGROUND)
    draw = ImageDraw.Draw(canvas)
    _picture(canvas, draw, 0, 0, "intensity", colours.grey(view.intensity))
    _picture(canvas, draw, 0, 1, "event frame (20 ms)", colours.events(view.event_frame))
    _picture(canvas, draw, 0, 2, "error of the held depth", error)
    _picture(canvas, draw, 1, 0, "true depth", colours.depth(view.true_depth, *limits))
    _picture(canvas, draw, 1, 1, "held depth", colours.depth(view.held_depth, *limits))
    _numbers(draw, view)
    _time_line(draw, view)
    return np.asarray(canvas)


def _corner(row: int, column: int) -> tuple[int, int]:
    return MARGIN + column * (CELL[0] + MARGIN), MARGIN + row * (CELL[1] + TITLE + MARGIN)


def _picture(
    canvas: Image.Image,
    draw: ImageDraw.ImageDraw,
    row: int,
    column: int,
    title: str,
    pixels: NDArray[np.uint8],
) -> None:
    left, top = _corner(row, column)
    draw.text((left, top + 2), title, INK, _font(13))
    enlarging = pixels.shape[1] < CELL[0]
    resampling = Image.Resampling.NEAREST if enlarging else Image.Resampling.BOX
    canvas.paste(Image.fromarray(pixels).resize(CELL, resampling), (left, top + TITLE))


def _numbers(draw: ImageDraw.ImageDraw, view: PanelView) -> None:
    left, top = _corner(1, 2)
    lines = (
        ("time", f"{view.t_us / 1e6:.2f} s"),
        ("held frame", f"{view.held_source}, {view.held_age_us // 1000} ms old"),
        (view.error_name, f"{view.timeline.error[-1]:.4f}"),
        ("effective rate", f"{view.effective_rate:.1f} Hz"),
        ("ego speed", f"{view.ego_speed * 3.6:.0f} km/h"),
    )
    for line, (name, value) in enumerate(lines):
        y = top + TITLE + 40 * line
        draw.text((left + 12, y + 4), name, FAINT, _font(13))
        draw.text((left + 132, y), value, INK, _font(17))


def _time_line(draw: ImageDraw.ImageDraw, view: PanelView) -> None:
    """Keyframe band, LiDAR ticks, trigger ticks and the error curve over the whole sequence."""
    timeline = view.timeline
    left, right = MARGIN, WIDTH - MARGIN - 1
    top = HEIGHT - STRIP - MARGIN
    curve_top, curve_bottom = top + TITLE, top + STRIP - 28
    legend = (("LiDAR", LIDAR_INK), ("trigger", TRIGGER_INK), ("keyframe", KEYFRAME_INK), ("error", INK))
    for place, (name, ink) in enumerate(legend):
        draw.text((left + 90 * place, top), name, ink, _font(13))

    step = (right - left) / (view.slices + 1)
    peak = max(max(timeline.error), 1e-9)
    curve = []
    for k, error in enumerate(timeline.error):
        x = left + step * k
        if timeline.keyframe[k]:
            draw.rectangle((x, curve_bottom + 20, max(x + step - 1, x), curve_bottom + 27), KEYFRAME_INK)
        if timeline.lidar[k] or timeline.triggered[k]:
            ink = LIDAR_INK if timeline.lidar[k] else TRIGGER_INK
            draw.line((x, curve_bottom + 4, x, curve_bottom + 16), ink)
        curve.append((x, curve_bottom - (curve_bottom - curve_top) * error / peak))
    if len(curve) > 1:
        draw.line(curve, INK)
    draw.line((left, curve_bottom + 1, right, curve_bottom + 1), FAINT)


def _font(size: int) -> Any:
    return ImageFont.load_default(size)


class Window:
    """A desktop window that opens with the first frame shown; pygame is imported only then."""

    def __init__(self, fps: int) -> None:
        self._fps = fps
        self._pygame: Any = None
        self._surface: Any = None
        self._clock: Any = None

    def show(self, frame: NDArray[np.uint8]) -> None:
        """Show one ``(H, W, 3)`` uint8 frame and keep to the frame rate."""
        if self._surface is None:
            self._open(frame.shape[1], frame.shape[0])
        pygame = self._pygame
        pygame.event.pump()
        pygame.surfarray.blit_array(self._surface, frame.swapaxes(0, 1))
        pygame.display.flip()
        self._clock.tick(self._fps)

    def close(self) -> None:
        """Close the window; may be called twice."""
        if self._surface is not None:
            self._pygame.display.quit()
            self._pygame = self._surface = self._clock = None

    def _open(self, width: int, height: int) -> None:
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        import pygame

        pygame.display.init()
        pygame.display.set_caption("nl_env")
        self._pygame, self._clock = pygame, pygame.time.Clock()
        self._surface = pygame.display.set_mode((width, height))

    def __getstate__(self) -> dict[str, Any]:
        """A copy in another process opens a window of its own."""
        return {"_fps": self._fps, "_pygame": None, "_surface": None, "_clock": None}
