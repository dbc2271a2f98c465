"""Measure how close the synthetic scenes come to ELiDAR, beside what the paper publishes.

Runs at 480x640 on test sequences. Every finished world is kept in the output folder, so an interrupted run
continues with --resume.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # runs from a checkout, wherever it is started

import numpy as np
import tyro
from tqdm import tqdm

from nl_env.command_line import run_command
from nl_env.config import SPLITS, DrivingConfig, EventCameraConfig, number
from nl_env.realism.plots import DEPTH_PLOT, EVENT_PLOT, save_plots
from nl_env.realism.summary import Summary, summarise
from nl_env.realism.tables import markdown
from nl_env.realism.targets import targets
from nl_env.realism.world import WorldReport, WorldTask
from nl_env.runs import open_folder, run_sequences, write_text

BEGIN, END = "<!-- begin results -->", "<!-- end results -->"
"""The document keeps its words; what is between these lines is replaced."""


@dataclass(frozen=True)
class Settings:
    """What determines the results."""

    worlds: int = 48
    """Number of test worlds."""
    pairs: int = 10
    """Prior/truth pairs per gap and world, at random times."""
    seed_start: int = 0
    """First test world; runs that do not overlap are independent."""
    events: bool = True
    """Simulate the event camera (most of the time); without it only depth and keyframes are measured."""
    noise: str = "realistic"
    """Event camera: realistic, or ideal (the one ELiDAR was simulated with)."""
    checkpoint: str | None = None
    """The released checkpoint (a state dict): adds its error, its controls and the batch-norm distance."""
    network_pairs: int = 4
    """The checkpoint runs on this many pairs per gap and world (about half a second each)."""
    control_pairs: int = 1
    """Its three controls run on this many of them."""

    def validate(self) -> None:
        """Raise ``ValueError`` naming the option, what was found and what was expected."""
        number("worlds", self.worlds, 1, 100_000)
        number("pairs", self.pairs, 1, 1_000)
        number("seed_start", self.seed_start, 0, len(SPLITS["test"]) - self.worlds)
        number("network_pairs", self.network_pairs, 1, 1_000)
        number("control_pairs", self.control_pairs, 0, self.network_pairs)
        self.config  # noqa: B018 - validates the noise preset
        if self.checkpoint is not None:
            from nl_env.depth.unet import load_released

            load_released(self.checkpoint)

    @property
    def config(self) -> DrivingConfig:
        """The generator as it is shipped, at the paper's resolution."""
        return DrivingConfig(resolution="full", events=EventCameraConfig.preset(self.noise))

    @property
    def world_seeds(self) -> range:
        """Sequence seeds of the worlds."""
        return SPLITS["test"][self.seed_start : self.seed_start + self.worlds]

    @property
    def task(self) -> WorldTask:
        """What one process does with one seed."""
        return WorldTask(
            self.config, self.pairs, self.events, self.checkpoint, self.network_pairs, self.control_pairs
        )


@dataclass(frozen=True)
class Options:
    """Measure how close the synthetic scenes come to ELiDAR."""

    settings: Annotated[Settings, tyro.conf.OmitArgPrefixes]
    workers: int = os.cpu_count() or 1
    """Processes of one thread each; 0 runs in this one. The results do not depend on it."""
    out: Path = Path("runs/realism")
    """Output folder: results.json, table.md, two plots, and the finished worlds."""
    markdown: Path | None = None
    """Also put the tables between the result marks of this document, and the plots into images/ beside it."""
    overwrite: bool = False
    """Replace the run that is in the output folder."""
    resume: bool = False
    """Continue the run that is in the output folder; the settings must be the same."""


def jsonable(value: Any) -> Any:
    """Plain JSON: what was not measured is null."""
    if isinstance(value, dict):
        return {key: jsonable(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [jsonable(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def results(settings: Settings, summary: Summary, reports: Sequence[WorldReport]) -> dict[str, Any]:
    """Content of ``results.json``."""
    return jsonable(
        {
            "settings": asdict(settings),
            **asdict(summary),
            "targets": [{**asdict(target), "met": target.met} for target in targets(summary)],
            "sequences": [
                {
                    "seed": report.seed,
                    "description": report.description,
                    "mean_speed": float(report.speed.mean()),
                    "repeat": np.nanmean(report.repeat, axis=0).tolist(),
                }
                for report in reports
            ],
        }
    )


def around_results(document: Path) -> tuple[str, str]:
    """What is before and after the results of ``document``.

    Raises:
        ValueError: the marks are missing.
    """
    text = document.read_text(encoding="utf-8")
    if text.count(BEGIN) != 1 or text.count(END) != 1:
        raise ValueError(f"markdown: found no {BEGIN} ... {END} in {document}, expected each once")
    return text.split(BEGIN)[0], text.split(END)[1]


def update_document(document: Path, settings: Settings, summary: Summary) -> None:
    """Replace the results of ``document``, and its plots in ``images/`` beside it."""
    head, tail = around_results(document)
    images = document.parent / "images"
    images.mkdir(exist_ok=True)
    save_plots(summary, images)
    plots = "\n\n".join(f"![{name}](images/{name})" for name in (DEPTH_PLOT, EVENT_PLOT))
    shown = ", ".join(f"{name} {value}" for name, value in asdict(settings).items() if name != "checkpoint")
    text = f"Settings: {shown}.\n\n{markdown(summary)}\n{plots}"
    write_text(document, f"{head}{BEGIN}\n\n{text}\n\n{END}{tail}")


def run(options: Options) -> Summary:
    """Measure, write the output folder, print the tables."""
    settings = options.settings
    settings.validate()
    if options.markdown is not None:
        around_results(options.markdown)  # fails before the work
    folder = open_folder(options.out, asdict(settings), overwrite=options.overwrite, resume=options.resume)
    with tqdm(total=settings.worlds, desc="worlds", unit="world", disable=None) as bar:
        reports = run_sequences(
            settings.task,
            WorldReport.load,
            settings.world_seeds,
            folder,
            workers=options.workers,
            progress=bar.update,
        )
    summary = summarise(reports, settings.checkpoint, settings.config.lidar.period)
    found = results(settings, summary, reports)
    write_text(options.out / "results.json", json.dumps(found, indent=1, allow_nan=False) + "\n")
    write_text(options.out / "table.md", "# Realism of the synthetic scenes\n\n" + markdown(summary))
    save_plots(summary, options.out)
    if options.markdown is not None:
        update_document(options.markdown, settings, summary)
    print(markdown(summary))
    return summary


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""

    def work(given: list[str]) -> None:
        run(tyro.cli(Options, args=given, description=__doc__))

    return run_command("realism", work, arguments, kept="finished worlds are kept")


if __name__ == "__main__":
    sys.exit(main())
