"""Export recordings in ELiDAR's layout and naming, so that its authors' scripts run on them.

The output folder is what those scripts call ``data``. Every finished sequence is kept, so an interrupted
export continues with --resume.
"""

from __future__ import annotations

import json
import os
import shutil
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
from nl_env.elidar.export import ExportOptions, assemble, write_part
from nl_env.elidar.layout import SHAPE, SPLITS
from nl_env.elidar.plan import sequence_names, split_of_seed
from nl_env.recording import Recording
from nl_env.runs import Entry, open_folder, run_sequences, write_text

MANIFEST_FILE = "sequences.json"
"""Written last: which recording became which sequence. A folder without it is not finished."""


@dataclass(frozen=True)
class Options:
    """Export recordings in ELiDAR's layout."""

    recordings: tyro.conf.Positional[tuple[Path, ...]]
    """Recordings (.h5) or folders of them. Training and test seeds become the two splits."""
    export: Annotated[ExportOptions, tyro.conf.OmitArgPrefixes]
    keep_resolution: bool = False
    """Export recordings of another resolution than ELiDAR's 480x640."""
    workers: int = os.cpu_count() or 1
    """Processes of one thread each; 0 runs in this one. The files do not depend on it."""
    out: Path = Path("runs/elidar")
    """Output folder: extrapolation/, slicing/, raw_data/ and sequences.json."""
    overwrite: bool = False
    """Replace the export that is in the output folder."""
    resume: bool = False
    """Continue the export that is in the output folder; recordings and options must be the same."""


@dataclass(frozen=True)
class ExportedSequence(Entry):
    """One exported sequence, as the manifest lists it."""

    name: str
    split: str
    seed: int
    recording: str
    description: dict[str, Any]


@dataclass(frozen=True)
class ExportSequence:
    """The work of one process: turn one recording into its part."""

    files: dict[int, Path]
    entries: dict[int, ExportedSequence]
    options: ExportOptions
    parts: Path
    data_folder: Path

    def __call__(self, seed: int) -> ExportedSequence:
        """Write the part ``SEED.h5``."""
        entry = self.entries[seed]
        with Recording(self.files[seed]) as recording:
            part = self.parts / f"{seed}.h5"
            write_part(part, recording, entry.name, entry.split, self.options, self.data_folder)
        return entry


def find_recordings(paths: Sequence[Path]) -> list[Path]:
    """The recordings among ``paths``: files as they are, folders with every .h5 below, by name."""
    if not paths:
        raise ValueError("recordings: found none, expected files or folders")
    found: list[Path] = []
    for path in paths:
        files = sorted(path.rglob("*.h5")) if path.is_dir() else [path]
        if not files:
            raise FileNotFoundError(f"recordings: found no .h5 in {path}, expected a folder of recordings")
        found += files
    return found


def describe_recordings(
    paths: Sequence[Path], keep_resolution: bool
) -> tuple[dict[int, Path], list[ExportedSequence]]:
    """Files by seed, and what each becomes.

    Raises:
        ValueError: not a recording, two of one seed, of different sizes, or not of ELiDAR's.
    """
    files: dict[int, Path] = {}
    descriptions = []
    shapes = set()
    for path in paths:
        with Recording(path) as recording:
            shape, seed = recording.camera.shape, recording.seed
            descriptions.append(recording.description)
        if seed in files:
            raise ValueError(f"recordings: found seed {seed} twice, in {files[seed]} and {path}")
        files[seed] = path
        shapes.add(shape)
        if len(shapes) > 1:
            raise ValueError(f"recordings: {path}: found {shape} images, expected the size of the others")
        if shape != SHAPE and not keep_resolution:
            raise ValueError(
                f"recordings: {path}: found {shape} images, expected {SHAPE} as in ELiDAR: record with "
                "--resolution full, or pass --keep-resolution"
            )
    names = sequence_names(descriptions)
    entries = [
        ExportedSequence(name, split_of_seed(seed), seed, path.name, description)
        for name, (seed, path), description in zip(names, files.items(), descriptions, strict=True)
    ]
    return files, entries


def run(options: Options) -> list[dict[str, Any]]:
    """Export, write the manifest, and return its sequences."""
    files, entries = describe_recordings(find_recordings(options.recordings), options.keep_resolution)
    identity = {
        "nl_env_version": nl_env.__version__,
        **asdict(options.export),
        "recordings": {entry.name: entry.recording for entry in entries},
    }
    manifest = options.out / MANIFEST_FILE
    parts = open_folder(options.out, identity, overwrite=options.overwrite, resume=options.resume)
    content = [asdict(entry) for entry in entries]
    if options.resume and manifest.exists():
        parts.rmdir()
        print(f"finished before: {manifest}")
        return content
    manifest.unlink(missing_ok=True)
    by_seed = {entry.seed: entry for entry in entries}
    with tqdm(total=len(entries), desc="sequences", unit="sequence", disable=None) as bar:
        run_sequences(
            ExportSequence(files, by_seed, options.export, parts, options.out),
            ExportedSequence.load,
            list(files),
            parts,
            workers=options.workers,
            suffix=".json",
            progress=bar.update,
        )
    assemble([parts / f"{seed}.h5" for seed in files], options.out)
    write_text(manifest, json.dumps(content, indent=1, allow_nan=False) + "\n")
    shutil.rmtree(parts)
    counts = {split: sum(entry.split == split for entry in entries) for split in SPLITS}
    print(f"{counts['train']} training and {counts['test']} test sequences: {options.out}")
    for split, count in counts.items():
        if count == 0:
            print(f"no {split} sequence: the authors' scripts need both splits", file=sys.stderr)
    return content


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""

    def work(given: list[str]) -> None:
        run(tyro.cli(Options, args=given, description=__doc__))

    return run_command("export_elidar", work, arguments, kept="finished sequences are kept")


if __name__ == "__main__":
    sys.exit(main())
