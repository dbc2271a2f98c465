"""``nl_env/Replay-v0``: adaptive depth sensing on recordings and on ELiDAR."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from nl_env.config import SPLITS, choice
from nl_env.elidar import find_files
from nl_env.elidar.layout import HDF5_SUFFIXES, RANGE, hdf5_kind
from nl_env.elidar_stream import ElidarStream
from nl_env.env import AdaptiveDepthEnv
from nl_env.recording import Recording
from nl_env.recording_stream import RecordingStream
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
    * `max_depth`, `fov`: ELiDAR only, range in m (200; indoors 9), horizontal field of view in degrees (75).
    * `on_error`: ELiDAR only, `"raise"` (default) or `"skip"` for broken sequences.
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
        extrapolator: str | DepthExtrapolator = "unet",
        odometry: bool = False,
        runtime: str = "auto",
        obs_mode: str = "image",
        error: str = "log_mae",
        error_scale: float = 0.05,
        trigger_cost: float = 0.1,
        render_mode: str | None = None,
    ) -> None:
        recordings = find_recordings(Path(data))
        stream: RecordingStream | ElidarStream
        if recordings:
            stream = recording_stream(recordings, split, sequences, lidar_hz, beams)
            self._sequences = stream.seeds
            self.found = f"{len(stream.seeds)} recordings"
            min_depth = OUTDOOR_MIN_DEPTH
        else:
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
        )

    def _sequence(self, seed: int | None, options: dict[str, Any]) -> int:
        if "sequence" in options or seed in self._sequences:
            return super()._sequence(seed, options)
        return int(self._sequences[self.np_random.integers(len(self._sequences))])

    def _info(
        self, sample: Sample, triggered: bool, scores: dict[str, float], parts: dict[str, float]
    ) -> dict[str, Any]:
        info = super()._info(sample, triggered, scores, parts)
        if isinstance(self._stream, ElidarStream):  # steps differ in length
            times, ledger = self._stream.times_us, self._ledger
            elapsed = sample.t - times[0]
            frames = ledger.lidar_frames + ledger.triggers
            info["depth_age"] = sample.t - times[ledger.held_index]
            info["effective_rate"] = frames * 1e6 / elapsed if elapsed else 0.0
        return info


def find_recordings(data: Path) -> list[Path]:
    """The native recordings at ``data``; empty if it holds something else.

    Raises:
        FileNotFoundError: no such file or folder.
        ValueError: a single file that is no recording, or damaged files beside recordings.
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
    if recordings and unreadable:
        raise unreadable[0]
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


def _seed(path: Path) -> int:
    """Of a recording: its file name is the seed, or its content says."""
    if path.stem.isdecimal():
        return int(path.stem)
    with Recording(path) as recording:
        return recording.seed
