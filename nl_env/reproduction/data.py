"""The recorded sequences that tables are measured on: a folder as ``scripts/record.py`` writes it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

MANIFEST = "manifest.json"


@dataclass(frozen=True)
class Sequences:
    """Recordings of one folder.

    Attributes:
        split: train, val or test.
        files: recording of each sequence seed.
        digest: SHA-256 over seeds and hashes of the recordings.
        settings: how they were recorded.
    """

    split: str
    files: Mapping[int, Path]
    digest: str
    settings: Mapping[str, Any]


def find_sequences(folder: Path, most: int | None = None) -> Sequences:
    """The first ``most`` recordings of ``folder``, or all of them.

    Raises:
        FileNotFoundError: no manifest (an unfinished folder has none), or a recording it lists is gone.
        ValueError: a manifest that cannot be understood, or fewer recordings than asked for.
    """
    path = folder / MANIFEST
    if not path.is_file():
        raise FileNotFoundError(f"data: found no {path}, expected a finished folder of scripts/record.py")
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
        entries = [(int(e["seed"]), str(e["file"]), str(e["sha256"])) for e in manifest["sequences"]]
        settings = {name: manifest[name] for name in ("split", "resolution", "duration", "noise", "lidar_hz")}
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"data: found no manifest of recordings in {path} ({error!r})") from error
    if most is not None and not 1 <= most <= len(entries):
        raise ValueError(f"sequences: found {most}, expected 1 to {len(entries)}, what {path} lists")
    chosen = entries[:most]
    files = {seed: folder / file for seed, file, _ in chosen}
    for file in files.values():
        if not file.is_file():
            raise FileNotFoundError(f"data: found no {file}, which {path} lists")
    digest = hashlib.sha256(json.dumps([(seed, sha) for seed, _, sha in chosen]).encode()).hexdigest()
    return Sequences(str(settings.pop("split")), files, digest, settings)
