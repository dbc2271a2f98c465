"""Extrapolators exported to ONNX: a folder of ``.onnx`` files and one JSON that says how to run them.

Reading one needs neither PyTorch nor the weights it was made from, only ONNX Runtime or OpenVINO.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from nl_env.depth.runtime.compiled import CompiledNetwork
from nl_env.depth.runtime.onnx_file import load_onnx
from nl_env.runs import replacing, write_text

DESCRIPTION = "extrapolator.json"
PARTS = {"unet-paper": ("network",), "motion-warp-refine": ("motion", "refine")}
"""Networks of every architecture; ours may lack either."""


@dataclass(frozen=True)
class Export:
    """An extrapolator's networks for one image size.

    Attributes:
        architecture: as on the card of its weights.
        options: what besides the networks it was made with.
        resolution: ``[H, W]`` of the images it takes.
        precision: ``"fp32"`` or ``"fp16"``.
        files: SHA-256 of ``PART.onnx`` by part.
        weights: name of the file it was made from.
    """

    architecture: str
    options: dict[str, Any]
    resolution: list[int]
    precision: str
    files: dict[str, str]
    weights: str


def write_export(folder: Path, export: Export, models: Mapping[str, bytes]) -> Export:
    """Write ``models`` by part, then the description with their checksums, which it returns.

    Raises:
        OSError: the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for part, model in models.items():
        with replacing(folder / f"{part}.onnx") as temporary:
            temporary.write_bytes(model)
    files = {part: hashlib.sha256(model).hexdigest() for part, model in models.items()}
    written = Export(**(asdict(export) | {"files": files}))
    write_text(folder / DESCRIPTION, json.dumps(asdict(written), indent=2) + "\n")
    return written


def read_export(folder: Path) -> Export:
    """The description in ``folder``, its files checked.

    Raises:
        FileNotFoundError: no description, or a file it names is missing.
        ValueError: the description is damaged, or a file is not the one it was written with.
    """
    path = folder / DESCRIPTION
    if not path.is_file():
        raise FileNotFoundError(f"extrapolator: found no {DESCRIPTION} in {str(folder)!r}")
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        export = Export(**values)
    except (ValueError, TypeError) as cause:
        expected = ", ".join(field.name for field in fields(Export))
        raise ValueError(f"{str(path)!r}: found no JSON object of the fields {expected} ({cause})") from cause
    known = PARTS.get(export.architecture, ())
    if not export.files.keys() <= set(known):
        raise ValueError(
            f"{str(path)!r}: found architecture {export.architecture!r} with {sorted(export.files)}, "
            f"expected one of {', '.join(PARTS)} with its own parts"
        )
    for part, digest in export.files.items():
        file = folder / f"{part}.onnx"
        if not file.is_file():
            raise FileNotFoundError(f"extrapolator: found no file {str(file)!r}, which {DESCRIPTION} names")
        if hashlib.sha256(file.read_bytes()).hexdigest() != digest:
            raise ValueError(f"{str(file)!r}: found another file than the one that was exported")
    return export


def load_parts(
    folder: Path, export: Export, runtime: str = "auto", precision: str | None = None
) -> dict[str, CompiledNetwork]:
    """The networks of ``folder`` by part; arguments and errors as :func:`load_onnx`."""
    return {part: load_onnx(folder / f"{part}.onnx", runtime, precision=precision) for part in export.files}
