"""What is in event files of other projects."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nl_env.importing import EventSource, open_events
from nl_env.inspection.findings import Findings, Reading
from nl_env.representations import event_frame
from nl_env.types import SLICE_US


def inspect_events(path: Path, camera: str, reading: Reading) -> Findings:
    """One camera of an event file: how many events, when, and what is wrong with them."""
    found = Findings("events", path)
    try:
        source = open_events(path, camera)
        try:
            found.kind = f"{source.layout} events"
            _describe(source, camera, found, reading)
        finally:
            source.close()
    except (ValueError, ImportError) as error:
        found.problems.append(str(error))
    return found


def _describe(source: EventSource, camera: str, found: Findings, reading: Reading) -> None:
    """Fill in what a source says."""
    first, last = source.span()
    found.facts = {
        "camera": camera,
        "resolution": f"{source.shape[0]}x{source.shape[1]}",
        "events": len(source),
        "first_us": first,
        "seconds": (last - first) / 1e6,
        "megabytes": source.path.stat().st_size / 1e6,
    }
    if last > first:
        found.facts["events_per_second"] = len(source) / ((last - first) / 1e6)
    if source.calibration is not None:
        found.facts["focal_px"] = source.calibration.focal
    if reading.verify:
        source.verify()
    if reading.pictures:
        middle = (first + last) // 2
        frame = np.zeros(source.shape, np.int16)
        for block in source.blocks(middle, middle + SLICE_US):
            frame += event_frame(block, source.shape, middle, middle + SLICE_US)
        found.add_events(frame)
