"""Record sequences of the synthetic sensors: one HDF5 file each, and a manifest.

Every finished sequence is kept in the output folder, so an interrupted run continues with --resume, and a
finished one grows with --resume and more --sequences.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # runs from a checkout, wherever it is started

import tyro
from tqdm import tqdm

import nl_env
from nl_env.command_line import run_command
from nl_env.config import (
    SPLITS,
    DrivingConfig,
    EventCameraConfig,
    LidarConfig,
    SceneConfig,
    choice,
    number,
    to_dict,
)
from nl_env.recording import Recording, record_sequence
from nl_env.recording.schema import DEPTH_PERIODS_US, VERSION
from nl_env.runs import Entry, open_folder, run_sequences, write_text

MANIFEST_FILE = "manifest.json"
"""Written last: a folder without it is not finished."""


@dataclass(frozen=True)
class Settings:
    """What determines the recordings."""

    split: str = "train"
    """train, val or test: which sequence seeds."""
    start: int = 0
    """First sequence of the split."""
    resolution: str = "quarter"
    """full (480x640), half (240x320) or quarter (120x160)."""
    duration: float = 20.0
    """Length of each sequence, seconds."""
    noise: str = "realistic"
    """Event camera: realistic or ideal."""
    lidar_hz: int = 10
    """LiDAR frames per second: 1, 2, 5, 10 or 25. A replay may choose another."""
    beams: int = 0
    """Scan lines of the LiDAR: 16, 32, 64, 128, or 0 for a dense one. A replay may choose another."""
    depth_period_ms: int = 20
    """Time between depth frames and poses: 20, 10 or 5."""
    intensity: bool = False
    """Also store an 8-bit picture per slice, which rendering a replay needs."""

    def validate(self) -> None:
        """Raise ``ValueError`` naming the option, what was found and what was expected."""
        choice("split", self.split, tuple(SPLITS))
        number("start", self.start, 0, len(SPLITS[self.split]) - 1)
        choice("depth_period_ms", self.depth_period_ms, tuple(us // 1000 for us in DEPTH_PERIODS_US))
        self.config  # noqa: B018 - validates the rest

    @property
    def config(self) -> DrivingConfig:
        """The generator's configuration."""
        return DrivingConfig(
            resolution=self.resolution,
            scene=SceneConfig(duration_s=self.duration),
            events=EventCameraConfig.preset(self.noise),
            lidar=LidarConfig(rate_hz=self.lidar_hz, beams=self.beams),
        )


@dataclass(frozen=True)
class Options:
    """Record sequences of the synthetic sensors."""

    settings: Annotated[Settings, tyro.conf.OmitArgPrefixes]
    sequences: int = 8
    """Number of sequences."""
    workers: int = os.cpu_count() or 1
    """Processes of one thread each; 0 runs in this one. The files do not depend on it."""
    out: Path = Path("runs/recordings")
    """Output folder: manifest.json and the recordings, sequences/SEED.h5."""
    overwrite: bool = False
    """Replace the recordings that are in the output folder."""
    resume: bool = False
    """Continue the run that is in the output folder; the settings must be the same."""


@dataclass(frozen=True)
class RecordedSequence(Entry):
    """One finished recording, as the manifest lists it."""

    seed: int
    file: str
    bytes: int
    sha256: str
    slices: int
    events: int
    description: dict[str, Any]


@dataclass(frozen=True)
class RecordSequence:
    """The work of one process: record one sequence into ``folder`` and describe the file."""

    settings: Settings
    folder: Path

    def __call__(self, seed: int) -> RecordedSequence:
        """Write ``SEED.h5``."""
        settings, path = self.settings, self.folder / f"{seed}.h5"
        record_sequence(
            path, settings.config, seed, 1000 * settings.depth_period_ms, intensity=settings.intensity
        )
        with Recording(path) as recording:
            return RecordedSequence(
                seed=seed,
                file=f"{self.folder.name}/{path.name}",
                bytes=path.stat().st_size,
                sha256=sha256(path),
                slices=recording.slices,
                events=int(recording.event_counts.sum()),
                description=recording.description,
            )


def sha256(path: Path) -> str:
    """Hex digest of a file's bytes."""
    sha = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            sha.update(block)
    return sha.hexdigest()


def check_no_fewer(folder: Path, seeds: Sequence[int]) -> None:
    """Raise ``ValueError`` where the folder holds recordings that the manifest would not list."""
    others = sorted({int(path.stem) for path in folder.glob("*.h5")} - set(seeds))
    if others:
        raise ValueError(
            f"sequences: found {len(seeds)}, but {folder} holds {len(others)} more (such as {others[0]}.h5); "
            "resume with as many or more, or overwrite"
        )


def drop_lost(folder: Path) -> None:
    """Forget the finished sequences whose recording was removed or cut short, so that they are redone."""
    for path in folder.glob("*.json"):
        recording = path.with_suffix(".h5")
        if not recording.exists() or recording.stat().st_size != RecordedSequence.load(path).bytes:
            path.unlink()


def run(options: Options) -> dict[str, Any]:
    """Record, write the manifest, and return its content."""
    settings = options.settings
    settings.validate()
    number("sequences", options.sequences, 1, len(SPLITS[settings.split]) - settings.start)
    number("workers", options.workers, 0, 1_000)
    seeds = SPLITS[settings.split][settings.start : settings.start + options.sequences]
    identity = {"nl_env_version": nl_env.__version__, "schema_version": VERSION, **asdict(settings)}
    manifest = options.out / MANIFEST_FILE
    folder = open_folder(options.out, identity, overwrite=options.overwrite, resume=options.resume)
    check_no_fewer(folder, seeds)
    manifest.unlink(missing_ok=True)
    drop_lost(folder)
    with tqdm(total=options.sequences, desc="sequences", unit="sequence", disable=None) as bar:
        entries = run_sequences(
            RecordSequence(settings, folder),
            RecordedSequence.load,
            seeds,
            folder,
            workers=options.workers,
            suffix=".json",
            progress=bar.update,
        )
    content = {
        **identity,
        "config": to_dict(settings.config),
        "seeds": list(seeds),
        "sequences": [asdict(entry) for entry in entries],
    }
    write_text(manifest, json.dumps(content, indent=1, allow_nan=False) + "\n")
    size, events = (sum(values) for values in zip(*((e.bytes, e.events) for e in entries), strict=True))
    print(f"{len(entries)} sequences, {events / 1e6:.1f} million events, {size / 1e6:.1f} MB: {manifest}")
    return content


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""

    def work(given: list[str]) -> None:
        run(tyro.cli(Options, args=given, description=__doc__))

    return run_command("record", work, arguments, kept="finished sequences are kept")


if __name__ == "__main__":
    sys.exit(main())
