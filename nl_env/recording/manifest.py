"""Folders of recordings: the manifest that ``scripts/record.py`` writes when all of them are finished."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

MANIFEST = "manifest.json"
"""Beside the recordings."""


@dataclass(frozen=True)
class Manifest:
    """What a folder of recordings holds.

    Attributes:
        path: the file.
        sha256: of its bytes.
        split: train, val or test.
        entries: what is known of each recording, by its seed: ``file``, ``sha256``, ``description``.
        content: the whole file.
    """

    path: Path
    sha256: str
    split: str
    entries: Mapping[int, Mapping[str, Any]]
    content: Mapping[str, Any]

    @property
    def files(self) -> dict[int, Path]:
        """Recording of each seed."""
        return {seed: self.path.parent / entry["file"] for seed, entry in self.entries.items()}


def read_manifest(folder: Path, argument: str = "recordings") -> Manifest:
    """The manifest in ``folder``.

    Args:
        folder: output of ``scripts/record.py``.
        argument: named in messages.

    Raises:
        FileNotFoundError: none there (an unfinished folder has none).
        ValueError: one that cannot be understood.
    """
    path = folder / MANIFEST
    if not path.is_file():
        raise FileNotFoundError(f"{argument}: found no {path}, expected a finished folder of record.py")
    text = path.read_bytes()
    try:
        content = json.loads(text)
        entries = {
            int(entry["seed"]): {**entry, "file": str(entry["file"])} for entry in content["sequences"]
        }
        split = str(content["split"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{argument}: found no manifest of recordings in {path} ({error!r})") from error
    return Manifest(path, hashlib.sha256(text).hexdigest(), split, entries, content)
