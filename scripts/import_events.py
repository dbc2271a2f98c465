"""Turn a real event recording into a native one, which replays, is inspected and evaluated like the others.

Reads DSEC, M3ED and EvTTC (HDF5), and Prophesee's .raw (EVT 2.0, EVT 3.0) and .dat. Depth comes from an M3ED
depth file, or from none; see docs/importing.md for what then counts.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # runs from a checkout, wherever it is started

import tyro

from nl_env.command_line import run_command
from nl_env.importing import DepthMaps, Imported, ImportOptions, import_recording, open_events


@dataclass(frozen=True)
class Options:
    """Turn a real event recording into a native one."""

    source: tyro.conf.Positional[Path]
    """The event file: .h5 or .hdf5 of DSEC, M3ED or EvTTC, .raw or .dat."""
    out: Path
    """The recording to write (.h5)."""
    part: Annotated[ImportOptions, tyro.conf.OmitArgPrefixes]
    depth: Path | None = None
    """HDF5 with depth/prophesee/CAMERA (or depth) and ts; without it the recording has no depth."""
    camera: str = "left"
    """left or right, where a file holds both."""
    sensor: tuple[int, int] | None = None
    """Width and height of the sensor, where a .raw or .dat does not say."""
    overwrite: bool = False
    """Replace the output file."""


def run(options: Options) -> Imported:
    """Import, and say what came of it."""
    if options.out.exists() and not options.overwrite:
        raise FileExistsError(f"out: {options.out} exists; choose another name or pass --overwrite")
    sensor = None if options.sensor is None else (options.sensor[1], options.sensor[0])
    source = open_events(options.source, options.camera, sensor)
    depth = None if options.depth is None else DepthMaps(options.depth, options.camera)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    try:
        imported = import_recording(source, depth, options.out, options.part)
    finally:
        source.close()
        if depth is not None:
            depth.close()
    crop = imported.crop
    print(f"{options.out}: {source.layout}, {imported.slices} slices of 20 ms, seed {imported.seed}")
    print(
        f"  crop of {crop.shape[1] * crop.k}x{crop.shape[0] * crop.k} at column {crop.left}, row {crop.top}, "
        f"binned {crop.k}x{crop.k}; kept {imported.events_kept} of {imported.events_read} events"
    )
    if depth is None:
        print("  no depth: errors of depth mean nothing in this recording")
    else:
        print(
            f"  depth at {imported.depth_slices} of {imported.slices + 1} slices, "
            f"at most {imported.depth_offset_ms:.1f} ms off; use the paper's metrics (error='abs_rel')"
        )
    return imported


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""

    def work(given: list[str]) -> None:
        run(tyro.cli(Options, args=given, description=__doc__))

    return run_command("import_events", work, arguments, errors=(ImportError,))


if __name__ == "__main__":
    sys.exit(main())
