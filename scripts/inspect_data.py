"""Say what is in a file or folder: recordings, ELiDAR's files, real sensors', or weights, and what is wrong.

Its name is not inspect.py because that would hide Python's own module of this name from every script here.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # runs from a checkout, wherever it is started

import tyro
from PIL import Image

from nl_env.command_line import run_command
from nl_env.elidar.layout import RANGE
from nl_env.inspection import Findings, Reading, inspect_path
from nl_env.runs import replacing

TILE_HEIGHT = 120
"""Of the pictures of a contact sheet, px."""


@dataclass(frozen=True)
class Options:
    """Say what is in a file or folder."""

    path: tyro.conf.Positional[Path]
    """A recording, a folder of recordings, a file or folder of ELiDAR or of real sensors, or weights."""
    verify: bool = False
    """Read everything, so that damage is found wherever it is."""
    max_depth: float = RANGE
    """Range of ELiDAR's depth, metres: 200 outdoors, 9 indoors."""
    figure: Path | None = None
    """Also write a contact sheet (.png) of depth and events."""
    json: bool = False
    """Print JSON."""


def write_figure(path: Path, found: Sequence[Findings]) -> None:
    """One row of pictures for each finding that has some, scaled to one height."""
    rows = []
    for findings in found:
        if findings.pictures:
            images = [Image.fromarray(picture) for picture in findings.pictures]
            sizes = [(round(image.width * TILE_HEIGHT / image.height), TILE_HEIGHT) for image in images]
            row = Image.new("RGB", (sum(width for width, _ in sizes), TILE_HEIGHT))
            left = 0
            for image, size in zip(images, sizes, strict=True):
                row.paste(image.resize(size, Image.Resampling.BOX), (left, 0))
                left += size[0]
            rows.append(row)
    if not rows:
        raise ValueError("figure: found nothing to draw, expected depth or events")
    sheet = Image.new("RGB", (max(row.width for row in rows), TILE_HEIGHT * len(rows)), (255, 255, 255))
    for number, row in enumerate(rows):
        sheet.paste(row, (0, TILE_HEIGHT * number))
    with replacing(path) as temporary:
        sheet.save(temporary, format="PNG")


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status: 1 where there are problems, 2 where nothing could be read."""

    def work(given: list[str]) -> int:
        options = tyro.cli(Options, args=given, description=__doc__)
        reading = Reading(options.verify, options.max_depth, pictures=options.figure is not None)
        found = inspect_path(options.path, reading)
        if options.json:
            print(json.dumps([findings.as_json() for findings in found], indent=1, allow_nan=False))
        else:
            print("\n".join(findings.text() for findings in found))
        if options.figure:
            write_figure(options.figure, found)
        return 1 if any(findings.problems for findings in found) else 0

    return run_command("inspect_data", work, arguments)


if __name__ == "__main__":
    sys.exit(main())
