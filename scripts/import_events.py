"""Turn a real event recording into a native one, which replays, is inspected and evaluated like the others.

Reads DSEC, M3ED and EvTTC (HDF5), and Prophesee's .raw (EVT 2.0, EVT 3.0) and .dat. Depth comes from an M3ED
depth file, from DSEC's disparity, or from nowhere, the ego speed from M3ED's poses or EvTTC's navigation; see
docs/importing.md for what then counts.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # runs from a checkout, wherever it is started

import tyro

from nl_env.command_line import run_command
from nl_env.importing import (
    EventSource,
    Imported,
    ImportOptions,
    NavigationTrack,
    PoseTrack,
    RectifiedEvents,
    StereoCalibration,
    holds_navigation,
    holds_poses,
    import_recording,
    open_depth,
    open_events,
)


@dataclass(frozen=True)
class Options:
    """Turn a real event recording into a native one."""

    source: tyro.conf.Positional[Path]
    """The event file: .h5 or .hdf5 of DSEC, M3ED or EvTTC, .raw or .dat."""
    out: Path
    """The recording to write (.h5)."""
    part: Annotated[ImportOptions, tyro.conf.OmitArgPrefixes]
    depth: Path | None = None
    """HDF5 with depth/prophesee/CAMERA (or depth) and ts, or DSEC's folder of disparity, which needs
    --calibration and --rectify-map; without it the recording has no depth."""
    poses: Path | None = None
    """HDF5 with Cn_T_C0 and ts; without it those of --depth, or EvTTC's speed, where there are some."""
    calibration: Path | None = None
    """DSEC's cam_to_cam.yaml; goes with --rectify-map."""
    rectify_map: Path | None = None
    """DSEC's rectify_map.h5: events are moved to the pixels of the rectified camera."""
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
    calibration = None if options.calibration is None else StereoCalibration.read(options.calibration)
    with ExitStack() as opened:
        source = opened.enter_context(closing(open_source(options, calibration)))
        depth = None
        if options.depth is not None:
            depth = opened.enter_context(closing(open_depth(options.depth, options.camera, calibration)))
        track = find_track(options, source.layout)
        options.out.parent.mkdir(parents=True, exist_ok=True)
        imported = import_recording(source, depth, options.out, options.part, track)
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
    if track is not None:
        print(
            f"  speed at {imported.speed_slices} and poses at {imported.pose_slices} "
            f"of {imported.slices + 1} slices"
        )
    return imported


def open_source(options: Options, calibration: StereoCalibration | None) -> EventSource:
    """The events, rectified if asked for.

    Raises:
        ValueError: a calibration without the map that leads to its pixels, or disparity without it.
    """
    if options.rectify_map is None:
        needs = "calibration" if calibration is not None else "depth"
        if calibration is not None or (options.depth is not None and options.depth.is_dir()):
            raise ValueError(
                f"{needs}: found {getattr(options, needs)}, which is of the rectified camera, "
                "expected --rectify-map, too"
            )
    sensor = None if options.sensor is None else (options.sensor[1], options.sensor[0])
    source = open_events(options.source, options.camera, sensor)
    if options.rectify_map is None:
        return source
    return RectifiedEvents(source, options.rectify_map, None if calibration is None else calibration.camera)


def find_track(options: Options, layout: str) -> PoseTrack | NavigationTrack | None:
    """The poses of their own file, those that a depth file has, too, or the speed beside EvTTC's events."""
    path = options.poses
    if path is None and options.depth is not None and options.depth.is_file() and holds_poses(options.depth):
        path = options.depth
    if path is not None:
        return PoseTrack(path, options.camera)
    if layout.startswith("EvTTC") and holds_navigation(options.source):
        return NavigationTrack(options.source)
    return None


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""

    def work(given: list[str]) -> None:
        run(tyro.cli(Options, args=given, description=__doc__))

    return run_command("import_events", work, arguments, errors=(ImportError,))


if __name__ == "__main__":
    sys.exit(main())
