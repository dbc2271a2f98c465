"""What is in ELiDAR's files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nl_env.elidar import (
    ExtrapolationData,
    RawSequence,
    SlicingData,
    read_metadata,
    read_sequence_list,
    rebuild_timelines,
)
from nl_env.elidar.layout import SPLITS, ElidarFiles
from nl_env.inspection.findings import TILES, Findings, Reading
from nl_env.types import TICK_US


def inspect_elidar(files: ElidarFiles, reading: Reading) -> Iterator[Findings]:
    """Every part of a release that a folder holds; half of a part is a problem, not a refusal."""
    if files.pairs is not None and files.metadata is not None:
        yield inspect_pairs(files.pairs, files.metadata, reading)
    elif files.metadata is not None:
        found = inspect_metadata(files.metadata)
        found.problems.append(f"{files.folder}: found the CSV but no extrapolation HDF5 that can be read")
        yield found
    elif files.pairs is not None:
        problem = f"{files.folder}: found the HDF5 but no CSV, which says what belongs together"
        yield Findings("ELiDAR extrapolation HDF5", files.pairs, problems=[problem])
    if files.slicing is not None:
        yield inspect_slicing(files.slicing, reading)
    if files.raw:
        yield inspect_raw(files.raw, files.folder, reading)
    if files.lists:
        yield inspect_lists(files.lists, files.folder, files.metadata)
    if files.unreadable:
        yield Findings("unreadable HDF5", files.folder, problems=list(files.unreadable))


def inspect_metadata(path: Path) -> Findings:
    """Sequences, pairs by gap and time of an extrapolation CSV."""
    table = read_metadata(path, on_error="skip")
    ticks, problems = rebuild_timelines(table, on_error="skip")
    durations = [pairs.duration for pairs in table.sequences]
    facts = {
        "sequences": dict(Counter(pairs.split for pairs in table.sequences)),
        "pairs": len(table),
        "pairs_by_gap_ms": _by_gap(np.concatenate(durations)) if durations else {},
        "depth_frames": sum(map(len, ticks.values())),
        "seconds": sum(int(frames[-1]) for frames in ticks.values()) * TICK_US * 1e-6,
    }
    return Findings("ELiDAR extrapolation CSV", path, facts, [problem.message for problem in problems])


def inspect_pairs(hdf5: Path, metadata: Path, reading: Reading) -> Findings:
    """The extrapolation HDF5 together with its CSV."""
    found = inspect_metadata(metadata)
    found.kind, found.path = "ELiDAR extrapolation pairs", hdf5
    try:
        data = ExtrapolationData(hdf5, metadata, max_depth=reading.max_depth, on_error="skip")
    except ValueError as error:
        found.problems.append(str(error))
        return found
    found.problems = [problem.message for problem in data.problems]
    found.facts |= {"resolution": _size(data.shape), "megabytes": hdf5.stat().st_size / 1e6}
    if reading.verify:
        for index in range(len(data)):
            found.attempt(partial(data.__getitem__, index))
    if reading.pictures:
        for name, pairs in list(data.sequences.items())[:TILES]:
            row = len(pairs) // 2
            depth = data.depth(name, int(pairs.truth[row]))
            found.add_picture(
                depth, data.voxel(name, int(pairs.events_id[row])).sum(axis=0), reading.max_depth
            )
    data.close()
    return found


def inspect_slicing(path: Path, reading: Reading) -> Findings:
    """The labelled event frames of both splits."""
    found = Findings("ELiDAR labelled event frames", path, {"megabytes": path.stat().st_size / 1e6})
    for split in SPLITS:
        try:
            data = SlicingData(path, split)
        except ValueError as error:
            found.problems.append(str(error))
            continue
        found.facts[split] = {
            "frames": len(data),
            "keyframes": float(data.scores.mean()) if len(data) else 0.0,
            "resolution": _size(data.shape),
        }
        if reading.verify:
            for index in range(len(data)):
                found.attempt(partial(data.__getitem__, index))
        if reading.pictures and len(data):
            for place in np.linspace(0, len(data) - 1, TILES).astype(int).tolist():
                found.add_events(data[place][0])
        data.close()
    return found


def inspect_raw(files: Mapping[str, Path], where: Path, reading: Reading) -> Findings:
    """The raw sequences, by name."""
    found = Findings("ELiDAR raw sequences", where)
    lengths: Counter[str] = Counter()
    keyframes = slices = 0
    for place, path in enumerate(files.values()):
        try:
            raw = RawSequence(path)
        except ValueError as error:
            found.problems.append(str(error))
            continue
        lengths[f"{len(raw)} slices of {_size(raw.shape)}"] += 1
        keyframes += int(raw.keyframe.sum())
        slices += len(raw)
        if reading.verify:
            for k in range(len(raw)):
                found.attempt(partial(raw.frame, k))
        if reading.pictures and place < TILES:
            found.add_events(raw.frame(len(raw) // 2))
        raw.close()
    found.facts = {"sequences": dict(lengths), "keyframes": keyframes / max(slices, 1)}
    return found


def inspect_lists(files: Mapping[str, Path], where: Path, metadata: Path | None = None) -> Findings:
    """Sequence lists, and which of their test sequences the extrapolation release trains on."""
    lists = {split: read_sequence_list(path) for split, path in files.items()}
    found = Findings("ELiDAR sequence lists", where, {split: len(names) for split, names in lists.items()})
    both = set(lists.get("train", ())) & set(lists.get("test", ()))
    if both:
        found.problems.append(f"{where}: found in both lists: {', '.join(sorted(both))}")
    if metadata is not None:
        sequences = read_metadata(metadata, on_error="skip").sequences
        trained = {pairs.name for pairs in sequences if pairs.split == "train"}
        mixed = sorted(trained & set(lists.get("test", ())))
        if mixed:
            found.problems.append(
                f"{where}: {len(mixed)} test sequences of the slicing release are training sequences of the "
                f"extrapolation release; leave them out end to end: {', '.join(mixed)}"
            )
    return found


def _by_gap(durations: NDArray[np.int64]) -> dict[str, int]:
    gaps, counts = np.unique(durations, return_counts=True)
    return {str(gap * TICK_US // 1000): n for gap, n in zip(gaps.tolist(), counts.tolist(), strict=True)}


def _size(shape: tuple[int, int]) -> str:
    return f"{shape[0]}x{shape[1]}"
