"""Writing ELiDAR's files from recordings, so that the authors' own scripts run on them.

Each sequence becomes one *part*, an HDF5 file of its own; :func:`assemble` copies the compressed chunks of
all parts into the two files of the release and removes nothing. The time axis is the release's: depth frames
at 5 ms ticks, the last at least one tick before the end, and one slice of 20 ms less than the sequence has.
"""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from nl_env.elidar.hdf5 import Hdf5Reader
from nl_env.elidar.layout import (
    FAR_PLANE,
    METADATA_FILE,
    PAIRS_FILE,
    RAW_FOLDER,
    SEQUENCE_LISTS,
    SLICING_FILE,
    SPLITS,
    tick_us,
)
from nl_env.elidar.metadata import SequencePairs, write_metadata
from nl_env.elidar.plan import draw_pairs
from nl_env.recording import Recording
from nl_env.representations import frame_from_bins
from nl_env.runs import replacing, write_text
from nl_env.types import BINS, TICKS_PER_SLICE

TICK_GRID = 2
"""Every gap is even, so depth is needed at even ticks only, every 10 ms."""

PAIRS_STREAM, SLICES_STREAM = 0, 1
"""Spawn keys of what is drawn for a sequence."""

ZIP_DATE = (1980, 1, 1, 0, 0, 0)
"""Time stamp inside every archive: the same data give the same bytes."""


@dataclass(frozen=True)
class ExportOptions:
    """What is exported.

    Attributes:
        slices_per_sequence: event frames of each sequence in the keyframe HDF5, drawn without replacement
            (the release has 24,720 of 114 and 11,220 of 50 sequences, about 220 each); 0 takes all.
        raw: also write the ``.npz`` of every slice.
        seed: of the drawing of pairs and slices, next to each sequence's own seed.
    """

    slices_per_sequence: int = 220
    raw: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        if self.slices_per_sequence < 0:
            raise ValueError(f"slices_per_sequence: found {self.slices_per_sequence}, expected 0 or more")
        if self.seed < 0:
            raise ValueError(f"seed: found {self.seed}, expected 0 or more")


def write_part(
    path: Path, recording: Recording, name: str, split: str, options: ExportOptions, data_folder: Path
) -> None:
    """Export one sequence to the part ``path``, and its ``.npz`` into ``data_folder`` if asked for.

    Both appear whole or not at all. The bytes depend on the recording and the options.

    Raises:
        ValueError: a recording without depth every 10 ms, or shorter than two slices.
    """
    if recording.depth_period_us > tick_us(TICK_GRID) or tick_us(TICK_GRID) % recording.depth_period_us:
        raise ValueError(
            f"{name}: found depth every {recording.depth_period_us / 1000:g} ms, expected every "
            f"{tick_us(TICK_GRID) / 1000:g} ms or finer: record with --depth-period-ms 10"
        )
    if recording.slices < 2:
        raise ValueError(f"{name}: found a sequence of {recording.slices} slices, expected at least 2")
    if options.raw:
        raw = data_folder / RAW_FOLDER / f"{name}.npz"
        raw.parent.mkdir(parents=True, exist_ok=True)
        with replacing(raw) as temporary:
            _write_raw(temporary, recording)
    with replacing(path) as temporary, h5py.File(temporary, "w") as file:
        plan = draw_pairs(recording.slices * TICKS_PER_SLICE, _generator(recording, options, PAIRS_STREAM))
        height, width = recording.camera.shape
        depth = _images(file, "depth_frames", (len(plan.ticks), 1, height, width), np.float32)
        for frame, tick in enumerate(plan.ticks):
            metres = recording.depth(tick_us(tick))
            depth[frame, 0] = np.where(metres > 0, metres, np.float32(FAR_PLANE))
        events = _images(file, "events", (len(plan.prior), BINS, height, width), np.float32)
        for row, (prior, truth) in enumerate(zip(plan.prior, plan.truth, strict=True)):
            events[row] = recording.voxel(tick_us(plan.ticks[prior]), tick_us(plan.ticks[truth]))
        for column in ("prior", "truth", "duration"):
            file.create_dataset(column, data=getattr(plan, column), track_times=False)
        chosen = _drawn_slices(recording, options)
        frames = _images(file, "event_frames", (len(chosen), height, width), np.int16)
        for place, k in enumerate(chosen):
            frames[place] = frame_from_bins(recording.bins(int(k)))
        scores = recording.keyframe[chosen].astype(np.float32)
        file.create_dataset("scores", data=scores, track_times=False)
        file.attrs["name"] = name
        file.attrs["split"] = split


def assemble(parts: Sequence[Path], data_folder: Path) -> None:
    """Put the parts together as ELiDAR's two HDF5 files, CSV and sequence lists, each written atomically.

    Raises:
        ValueError: no part, or one that cannot be read.
    """
    if not parts:
        raise ValueError(f"{data_folder}: found no sequence to export, expected at least one")
    for file in (PAIRS_FILE, SLICING_FILE):
        (data_folder / file).parent.mkdir(parents=True, exist_ok=True)
    table = []
    with replacing(data_folder / PAIRS_FILE) as temporary, h5py.File(temporary, "w") as out:
        for path in parts:
            with Hdf5Reader(path) as part:
                pairs = _part_pairs(part)
                group = out.create_group(pairs.name)
                for name in ("depth_frames", "events"):
                    part.file.copy(name, group)
                table.append(pairs)
    with replacing(data_folder / SLICING_FILE) as temporary, h5py.File(temporary, "w") as out:
        for split in SPLITS:
            members = [path for path, pairs in zip(parts, table, strict=True) if pairs.split == split]
            _join_slices(out.create_group(split), members, like=parts[0])
    for split, file in SEQUENCE_LISTS.items():
        write_text(data_folder / file, "".join(f"{pairs.name}\n" for pairs in table if pairs.split == split))
    write_metadata(data_folder / METADATA_FILE, table)


def _generator(recording: Recording, options: ExportOptions, stream: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence((options.seed, recording.seed), spawn_key=(stream,)))


def _drawn_slices(recording: Recording, options: ExportOptions) -> NDArray[np.int64]:
    """Slices (1 to ``slices - 1``) whose event frames go into the keyframe HDF5, ascending."""
    available = np.arange(1, recording.slices)
    wanted = options.slices_per_sequence
    if wanted == 0 or wanted >= len(available):
        return available
    rng = _generator(recording, options, SLICES_STREAM)
    return np.sort(rng.choice(available, wanted, replace=False))


def _images(file: h5py.File, name: str, shape: tuple[int, ...], dtype: Any) -> h5py.Dataset:
    """A dataset of images, one chunk each, in filters that every HDF5 library has; chunks carry checksums."""
    return file.create_dataset(
        name,
        shape,
        dtype,
        chunks=(1, *shape[1:]),
        maxshape=(None, *shape[1:]),  # allows a length of zero
        compression="gzip",
        compression_opts=1,
        shuffle=True,
        fletcher32=True,
        track_times=False,
    )


def _part_pairs(part: Hdf5Reader) -> SequencePairs:
    prior, truth, duration = (part.read(name, slice(None)) for name in ("prior", "truth", "duration"))
    rows = np.arange(len(prior), dtype=np.int64)
    attributes = part.file.attrs
    return SequencePairs(
        part.path, str(attributes["name"]), str(attributes["split"]), rows + 2, rows, prior, truth, duration
    )


def _join_slices(group: h5py.Group, paths: Sequence[Path], like: Path) -> None:
    """Concatenate event frames and labels, moving compressed chunks as they are; images as in ``like``."""
    with Hdf5Reader(like) as part:
        example = part.dataset("event_frames")
        shape, dtype = example.shape[1:], example.dtype
    scores = np.concatenate([np.zeros(0, np.float32), *map(_scores, paths)])
    group.create_dataset("scores", data=scores, track_times=False)
    frames = _images(group, "event_frames", (len(scores), *shape), dtype)
    start = 0
    for path in paths:
        with Hdf5Reader(path) as part:
            source = part.dataset("event_frames")
            for k in range(len(source)):
                mask, chunk = source.id.read_direct_chunk((k, 0, 0))
                frames.id.write_direct_chunk((start + k, 0, 0), chunk, mask)
            start += len(source)


def _scores(path: Path) -> NDArray[np.float32]:
    with Hdf5Reader(path) as part:
        return part.read("scores", slice(None))


def _write_raw(path: Path, recording: Recording) -> None:
    """The ``.npz`` of a sequence: one event frame, label and ego state for each slice, frame by frame."""
    used = slice(1, recording.slices)
    arrays: dict[str, NDArray[Any]] = {
        "key_frame": recording.keyframe[used].astype(np.int64),
        "ego_velocity": np.asarray(recording.speed[used], np.float64),
        "shortest_distance": np.asarray(recording.shortest_distance[used], np.float64),
        "num_new_actors": np.asarray(recording.new_actors[used], np.int64),
    }
    shape = (recording.slices - 1, *recording.camera.shape)
    with zipfile.ZipFile(path, "w") as archive:
        with _member(archive, "frames") as file:
            header = {"descr": "<i2", "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(file, header)
            for k in range(1, recording.slices):
                file.write(frame_from_bins(recording.bins(k)).astype("<i2", copy=False).tobytes())
        for name, array in arrays.items():
            with _member(archive, name) as file:
                np.lib.format.write_array(file, array, allow_pickle=False)


def _member(archive: zipfile.ZipFile, name: str) -> IO[bytes]:
    info = zipfile.ZipInfo(f"{name}.npy", ZIP_DATE)
    info.compress_type = zipfile.ZIP_DEFLATED
    return archive.open(info, "w", force_zip64=True)
