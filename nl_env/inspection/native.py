"""What is in recordings and in files of weights."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from nl_env.inspection.findings import TILES, Findings, Reading
from nl_env.recording import Recording
from nl_env.types import SLICE_US
from nl_env.weight_files import read_card, read_tensors


def inspect_recordings(paths: Sequence[Path], where: Path, reading: Reading) -> Findings:
    """Native recordings: how many of which kind, how much of what."""
    found = Findings("recordings" if len(paths) > 1 else "recording", where)
    kinds: Counter[str] = Counter()
    weathers: Counter[str] = Counter()
    scenarios: Counter[str] = Counter()
    slices = keyframes = events = 0
    for path in paths:
        try:
            with Recording(path) as recording:
                kind = _kind(recording)
                if reading.verify:
                    recording.verify()
                if reading.pictures and len(found.pictures) < 2 * TILES:
                    _add_picture(found, recording)
                counted = int(recording.event_counts.sum())
                labelled = int(recording.keyframe[1:].sum())
                length, description = recording.slices, recording.description
        except (ValueError, OSError) as error:
            found.problems.append(str(error))
            continue
        kinds[kind] += 1
        weathers[str(description.get("weather"))] += 1
        scenarios[str(description.get("scenario"))] += 1
        slices, keyframes, events = slices + length, keyframes + labelled, events + counted
    seconds = slices * SLICE_US * 1e-6
    found.facts = {"sequences": sum(kinds.values()), "kinds": dict(kinds), "seconds": seconds}
    if slices:
        found.facts |= {
            "events_per_second": events / seconds,
            "keyframes": keyframes / slices,
            "scenarios": dict(scenarios),
            "weathers": dict(weathers),
            "megabytes": sum(path.stat().st_size for path in paths) / 1e6,
        }
    return found


def inspect_weights(path: Path) -> Findings:
    """Tensors of a file of weights, and its card."""
    found = Findings("weights", path)
    try:
        tensors = read_tensors(path)
        found.facts = {
            "tensors": len(tensors),
            "parameters": sum(tensor.numel() for tensor in tensors.values()),
            "kilobytes": path.stat().st_size / 1e3,
        }
        card = read_card(path)
    except ValueError as error:
        found.problems.append(str(error))
        return found
    if card is not None:
        found.facts |= {name: value for name, value in asdict(card).items() if value}
    return found


def _add_picture(found: Findings, recording: Recording) -> None:
    """Depth and events of the LiDAR frame in the middle; of real sensors others may be empty, or all."""
    period = recording.config.lidar.period
    k = max(recording.slices // 2 // period, 1) * period
    depth, events = recording.depth(k * SLICE_US), recording.bins(k).sum(axis=0)
    if depth.any():
        found.add_picture(depth, events, recording.max_depth)
    else:
        found.add_events(events)


def _kind(recording: Recording) -> str:
    height, width = recording.camera.shape
    lidar_hz = recording.config.lidar.rate_hz
    period = recording.depth_period_us // 1000
    return f"{height}x{width}, LiDAR {lidar_hz} Hz, depth every {period} ms"
