"""The sequences that tables are measured on, as ``scripts/record.py`` writes them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nl_env.config import DrivingConfig, to_dict
from nl_env.recording.manifest import read_manifest


@dataclass(frozen=True)
class Sequences:
    """Sequences of one folder.

    Attributes:
        split: train, val or test.
        files: of each sequence seed.
        digest: SHA-256 over what identifies the files.
        settings: how they were recorded.
        left_out: why others cannot be used.
    """

    split: str
    files: Mapping[int, Path]
    digest: str
    settings: Mapping[str, Any]
    left_out: tuple[str, ...] = ()

    @property
    def seeds(self) -> tuple[int, ...]:
        """Of the sequences."""
        return tuple(self.files)


@dataclass(frozen=True)
class SimulatedWorlds:
    """Sequences that are simulated while they are measured.

    Attributes:
        split: train, val or test.
        seeds: of the sequences.
        config: what is simulated.
    """

    split: str
    seeds: tuple[int, ...]
    config: DrivingConfig

    @property
    def left_out(self) -> tuple[str, ...]:
        """None: a simulation cannot be damaged."""
        return ()

    @property
    def digest(self) -> str:
        """SHA-256 over the seeds and the configuration."""
        content = {"seeds": self.seeds, "config": to_dict(self.config)}
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    @property
    def settings(self) -> Mapping[str, Any]:
        """What readers of a table are told."""
        return {"resolution": self.config.resolution, "duration": self.config.scene.duration_s}


def find_sequences(folder: Path, most: int | None = None) -> Sequences:
    """The first ``most`` recordings of ``folder``, or all of them.

    Raises:
        FileNotFoundError: no manifest (an unfinished folder has none), or a recording it lists is gone.
        ValueError: a manifest that cannot be understood, or fewer recordings than asked for.
    """
    manifest = read_manifest(folder, "data")
    path, content = manifest.path, manifest.content
    try:
        entries = [(seed, entry["file"], str(entry["sha256"])) for seed, entry in manifest.entries.items()]
        settings = {name: content[name] for name in ("resolution", "duration", "noise", "lidar_hz")}
    except KeyError as error:
        raise ValueError(f"data: found no manifest of recordings in {path} ({error!r})") from error
    if most is not None and not 1 <= most <= len(entries):
        raise ValueError(f"sequences: found {most}, expected 1 to {len(entries)}, what {path} lists")
    chosen = entries[:most]
    files = {seed: folder / file for seed, file, _ in chosen}
    for file in files.values():
        if not file.is_file():
            raise FileNotFoundError(f"data: found no {file}, which {path} lists")
    digest = hashlib.sha256(json.dumps([(seed, sha) for seed, _, sha in chosen]).encode()).hexdigest()
    return Sequences(manifest.split, files, digest, settings)
