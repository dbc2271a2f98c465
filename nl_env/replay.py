"""``nl_env/Replay-v0``: adaptive depth sensing on recordings and on ELiDAR."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.config import SPLITS, choice
from nl_env.costs import TriggerCost
from nl_env.elidar import find_files
from nl_env.elidar.layout import HDF5_SUFFIXES, RANGE, hdf5_kind
from nl_env.elidar.metadata import ON_ERROR
from nl_env.elidar_stream import ElidarStream
from nl_env.env import INFO_METRICS, AdaptiveDepthEnv
from nl_env.held_depth import HeldDepth
from nl_env.recording import Recording
from nl_env.recording_stream import RecordingStream
from nl_env.trace_files import default_folder
from nl_env.trace_source import identify_extrapolator
from nl_env.trace_stream import TabulatedDepth, TraceFolder, TraceStream
from nl_env.types import DepthExtrapolator, Sample

INDOOR_RANGE = 20.0
"""Sensors with a range up to this are indoor ones, m."""
OUTDOOR_MIN_DEPTH, INDOOR_MIN_DEPTH = 1.0, 0.1
"""Depths below are read as this one by the full-image metrics, m."""


class ReplayEnv(AdaptiveDepthEnv):
    """
    ## Description
    The task of `nl_env/Driving-v0` on data from files: recordings of the synthetic sensors
    (`scripts/record.py`), or the ELiDAR release (`docs/data.md`). A recording replays exactly as it was live,
    observation, reward and info.

    ELiDAR's extrapolation files hold depth frames at irregular times and the events between some of them.
    There a step leads from one depth frame to the next of a chain, 20 to 500 ms later; every second frame is
    a LiDAR frame, and at the others the agent decides. Errors are against the stored depth.

    ## Action Space
    As in `nl_env/Driving-v0`.

    ## Observation Space
    As in `nl_env/Driving-v0`, at the size of the data. On ELiDAR the event frame covers the whole window
    since the last step (the sum of the stored grid's bins), and the times in `state` count steps.

    ## Rewards
    As in `nl_env/Driving-v0`.

    ## Starting State
    `reset(seed=s)` replays sequence s where the data have it: the seed of a recording, or the number of an
    ELiDAR episode (`env.unwrapped.stream.episodes`). Any other seed, and `reset()`, draw a sequence from the
    environment's own generator. `reset(options={"sequence": s})` replays sequence s.

    ## Episode End
    Truncated at the end of the sequence.

    ## Information
    The keys of `nl_env/Driving-v0`. On ELiDAR `t` is the time since the start of the sequence, `event_count`
    the sum of the absolute values of the stored grid; without a raw sequence beside it `ego_speed` is -1,
    `shortest_distance` infinite and `keyframe` False. `env.unwrapped.found` says what the data are.

    ## Arguments
    * `data`: a recording, a folder of recordings, or a folder with ELiDAR's files.
    * `split`: `"train"`, `"val"` or `"test"` (ELiDAR: `"train"` or `"test"`), or None (default) for all.
    * `sequences`: seeds of recordings, or names of ELiDAR sequences, or None (default) for all.
    * `lidar_hz`, `beams`: recordings only, another LiDAR than the recorded one; None keeps it.
    * `errors`: `"compute"` (default) runs the extrapolator; `"table"` looks its errors up in what
      `scripts/precompute.py` stored: the same observations, rewards and infos without a network, and without
      depth frames: `env.unwrapped.depth` and its like raise `RuntimeError`. Recordings only.
    * `tables`: folder of the stored traces; None is `DATA-tables-EXTRAPOLATOR`, beside the data.
    * `max_depth`, `fov`: ELiDAR only, range in m (200; indoors 9), horizontal field of view in degrees (75).
    * `on_error`: `"raise"` (default), or `"skip"`: broken ELiDAR sequences, and files beside recordings that
      cannot be read, are left out, and a warning names each.
    * `extrapolator`, `odometry`, `runtime`, `obs_mode`, `error`, `error_scale`, `trigger_cost`,
      `render_mode`: as in `nl_env/Driving-v0`. ELiDAR has no odometry. Recordings render if
      they were made with pictures.

    ## Version History
    * v0: first version.
    """

    def __init__(
        self,
        *,
        data: str | Path,
        split: str | None = None,
        sequences: Sequence[int] | Sequence[str] | None = None,
        lidar_hz: int | None = None,
        beams: int | None = None,
        max_depth: float = RANGE,
        fov: float = 75.0,
        on_error: str = "raise",
        errors: str = "compute",
        tables: str | Path | None = None,
        extrapolator: str | DepthExtrapolator = "unet",
        odometry: bool = False,
        runtime: str = "auto",
        obs_mode: str = "image",
        error: str = "log_mae",
        error_scale: float = 0.05,
        trigger_cost: TriggerCost = 0.1,
        render_mode: str | None = None,
    ) -> None:
        choice("errors", errors, ("compute", "table"))
        if tables is not None and errors != "table":
            raise ValueError(f"tables: found {str(tables)!r} with errors={errors!r}, expected errors='table'")
        choice("on_error", on_error, ON_ERROR)
        recordings = find_recordings(Path(data), on_error)
        stream: RecordingStream | ElidarStream | TraceStream
        held_depth: HeldDepth | None = None
        if recordings:
            stream = recording_stream(recordings, split, sequences, lidar_hz, beams)
            if odometry:
                require_poses(recordings)
            if errors == "table":
                if render_mode is not None:
                    raise ValueError(
                        f"render_mode: found {render_mode!r} with errors='table', which has no depth frames "
                        "to draw, expected None or errors='compute'"
                    )
                stream = trace_stream(stream, Path(data), tables, extrapolator, odometry)
                held_depth = TabulatedDepth(stream, dict.fromkeys((*INFO_METRICS, error)))
            self._sequences = stream.seeds
            self.found = f"{len(stream.seeds)} recordings"
            min_depth = OUTDOOR_MIN_DEPTH
        else:
            if errors == "table":
                raise ValueError(f"errors: found 'table', but {data} holds ELiDAR; expected 'compute'")
            if odometry:
                raise ValueError(f"odometry: found True, but ELiDAR ({data}) holds no poses; expected False")
            if lidar_hz is not None or beams is not None:
                raise ValueError("lidar_hz, beams: ELiDAR has its own LiDAR, expected None")
            stream = ElidarStream(
                find_files(Path(data)),
                split=split,
                sequences=None if sequences is None else [str(name) for name in sequences],
                max_depth=max_depth,
                fov_deg=fov,
                on_error=on_error,
            )
            self._sequences = tuple(range(len(stream.episodes)))
            self.found = f"{len(stream.data.sequences)} ELiDAR sequences, {len(stream.episodes)} episodes"
            min_depth = OUTDOOR_MIN_DEPTH if max_depth > INDOOR_RANGE else INDOOR_MIN_DEPTH
        super().__init__(
            stream,
            extrapolator=extrapolator,
            odometry=odometry,
            runtime=runtime,
            obs_mode=obs_mode,
            error=error,
            error_scale=error_scale,
            trigger_cost=trigger_cost,
            min_depth=min_depth,
            render_mode=render_mode,
            held_depth=held_depth,
        )

    def _sequence(self, seed: int | None, options: dict[str, Any]) -> int:
        return choose_sequence(self._sequences, seed, options, self.np_random)

    def _statistics(self, sample: Sample) -> NDArray[np.float32]:
        if isinstance(self._stream, TraceStream):  # described once for all episodes
            return self._stream.trace.statistics[sample.index]
        return super()._statistics(sample)

    def _info(
        self, sample: Sample, triggered: bool, scores: Mapping[str, float], parts: dict[str, float]
    ) -> dict[str, Any]:
        info = super()._info(sample, triggered, scores, parts)
        if isinstance(self._stream, ElidarStream):  # steps differ in length
            times, ledger = self._stream.times_us, self._ledger
            elapsed = sample.t - times[0]
            frames = ledger.lidar_frames + ledger.triggers
            info["depth_age"] = sample.t - times[ledger.held_index]
            info["effective_rate"] = frames * 1e6 / elapsed if elapsed else 0.0
        return info


def choose_sequence(
    sequences: Sequence[int], seed: int | None, options: Mapping[str, Any], rng: np.random.Generator
) -> int:
    """The sequence of an episode that starts: given by ``options`` or ``seed``, or else drawn."""
    if "sequence" in options:
        return int(options["sequence"])
    if seed is not None and seed in sequences:
        return int(seed)
    return sequences[int(rng.integers(len(sequences)))]


def find_recordings(data: Path, on_error: str = "raise") -> list[Path]:
    """The native recordings at ``data``; empty if it holds something else.

    Args:
        data: a recording, or a folder of recordings.
        on_error: ``"skip"`` warns of files beside recordings that cannot be read instead of raising.

    Raises:
        FileNotFoundError: no such file or folder.
        ValueError: a single file that is no recording, or (``"raise"``) damaged files beside recordings.
    """
    if data.is_file():
        kind = hdf5_kind(data)
        if kind != "recording":
            raise ValueError(f"{data}: found an HDF5 file that is no recording, expected a folder for ELiDAR")
        return [data]
    if not data.is_dir():
        raise FileNotFoundError(f"{data}: no such file or folder; expected recordings or ELiDAR's files")
    recordings, unreadable = [], []
    for path in sorted(data.rglob("*")):
        if path.suffix in HDF5_SUFFIXES and not path.name.startswith("."):
            try:
                if hdf5_kind(path) == "recording":
                    recordings.append(path)
            except ValueError as error:
                unreadable.append(error)
    if recordings and unreadable and on_error == "raise":
        raise unreadable[0]
    if recordings:
        for reason in unreadable:
            warnings.warn(f"left out {reason}", stacklevel=3)
    return recordings


def recording_stream(
    paths: Sequence[Path],
    split: str | None,
    sequences: Sequence[int] | Sequence[str] | None,
    lidar_hz: int | None,
    beams: int | None,
) -> RecordingStream:
    """The recordings of ``split`` and ``sequences`` (both None: all) as a stream.

    Raises:
        ValueError: none is left, a seed that is not recorded, or an argument out of range.
    """
    choice("split", split, (None, *SPLITS))
    files = {_seed(path): path for path in paths}
    for seed in sequences or ():
        if seed not in files:
            raise ValueError(f"sequences: found {seed!r}, expected seeds of recordings in {paths[0].parent}")
    wanted = [
        path
        for seed, path in files.items()
        if (split is None or seed in SPLITS[split]) and (sequences is None or seed in sequences)
    ]
    if not wanted:
        raise ValueError(f"split: found no recording of split {split!r} in {paths[0].parent}")
    with Recording(wanted[0]) as recording:
        recorded = recording.config.lidar
    lidar = replace(
        recorded,
        rate_hz=recorded.rate_hz if lidar_hz is None else lidar_hz,
        beams=recorded.beams if beams is None else beams,
    )
    return RecordingStream(wanted, lidar)


def trace_stream(
    recordings: RecordingStream,
    data: Path,
    tables: str | Path | None,
    extrapolator: str | DepthExtrapolator,
    odometry: bool,
) -> TraceStream:
    """The stored traces of ``recordings`` as a stream.

    Args:
        recordings: what is replayed, with its LiDAR.
        data: where the recordings lie.
        tables: folder of the traces; None finds it beside ``data``.
        extrapolator, odometry: what must have made them.

    Raises:
        TypeError: an extrapolator that is no name and no path.
        FileNotFoundError: no traces, or none of a recording.
        ValueError: traces of another extrapolator or LiDAR, or damaged ones.
    """
    if not isinstance(extrapolator, (str, os.PathLike)):
        raise TypeError(
            f"extrapolator: found {extrapolator!r} with errors='table', expected a name or a path to weights"
        )
    identity = identify_extrapolator(extrapolator, odometry)
    folder = default_folder(data, extrapolator, odometry) if tables is None else Path(tables)
    lidar = recordings.config.lidar
    return TraceStream(
        TraceFolder(folder, recordings.files, identity, lidar, OUTDOOR_MIN_DEPTH),
        recordings.camera,
        recordings.max_depth,
        recordings.slices,
        recordings.lidar_period,
    )


def require_poses(paths: Sequence[Path]) -> None:
    """Raise ``ValueError`` if a recording was imported without a camera pose at every slice."""
    for path in paths:
        with Recording(path) as recording:
            known = recording.description.get("pose_slices", 0)
            if "layout" in recording.description and known <= recording.slices:
                raise ValueError(
                    f"odometry: found True, but {path} holds poses at {known} of {recording.slices + 1} "
                    "slices; expected False"
                )


def _seed(path: Path) -> int:
    """Of a recording: its file name is the seed, or its content says."""
    if path.stem.isdecimal():
        return int(path.stem)
    with Recording(path) as recording:
        return recording.seed
