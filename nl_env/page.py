"""The page: tables, curves and a player in one HTML file without a link to anything outside it."""

from __future__ import annotations

import base64
import gzip
import json
from importlib import resources
from typing import Any

import numpy as np

from nl_env.colours import INFERNO, VIRIDIS
from nl_env.comparison import Comparison
from nl_env.depth.metrics import FULL_METRICS, PAPER_METRICS
from nl_env.frame_rates import RATE_WINDOW_S
from nl_env.plots import curve_colours
from nl_env.tables import FRONTIER_NOTES, NOTES, metric_label
from nl_env.traces import NEAREST_SHARE
from nl_env.types import SLICE_US


def html_report(comparison: Comparison, results: dict[str, Any]) -> str:
    """``report.html`` from the comparison and the content of its ``results.json``."""
    page = resources.files("nl_env").joinpath("report_page.html").read_text(encoding="utf-8")
    data = {
        "results": results,
        "metrics": {
            "full": [[name, metric_label(name)] for name in FULL_METRICS],
            "paper": [[name, metric_label(name)] for name in PAPER_METRICS],
        },
        "colours": curve_colours(comparison),
        "notes": NOTES.replace("\\", ""),
        "frontier_notes": FRONTIER_NOTES.replace("`", ""),
        "slice_s": SLICE_US / 1e6,
        "player": None if comparison.shown is None else _player_json(comparison),
    }
    # "<" cannot end the script element that holds the data.
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return page.replace("@@DATA@@", text).replace("@@FRAMES@@", _packed_frames(comparison))


def _player_json(comparison: Comparison) -> dict[str, Any]:
    """What the player needs next to the frames: it rebuilds any policy's held depth from the triggers."""
    assert comparison.shown is not None
    result = comparison.sequences[comparison.shown]
    assert result.frames is not None
    frames, rows, columns = result.frames.events.shape
    return {
        "seed": result.seed,
        "description": result.description,
        "frames": frames,
        "rows": rows,
        "columns": columns,
        "slice_s": SLICE_US / 1e6,
        "rate_window": int(RATE_WINDOW_S * 1e6) // SLICE_US,
        "max_depth": result.frames.max_depth,
        "nearest_share": NEAREST_SHARE,
        "lidar": np.flatnonzero(result.lidar).tolist(),
        "keyframe": np.flatnonzero(result.keyframe).tolist(),
        "speed": np.round(result.ego_speed, 2).tolist(),
        "errors": [[None if np.isnan(e) else round(float(e), 5) for e in row] for row in result.errors],
        "depth_colours": VIRIDIS.ravel().tolist(),
        "error_colours": INFERNO.ravel().tolist(),
        "policies": [
            {
                "name": policy.name,
                "family": policy.family,
                "listed": policy.listed,
                "adaptive": policy.adaptive,
                "triggers": list(record.triggers),
            }
            for policy, record in zip(comparison.policies, result.records, strict=True)
        ],
    }


def _packed_frames(comparison: Comparison) -> str:
    """Events, truth, and produced minus truth (mod 256, mostly zeros) as gzipped bytes in base64."""
    if comparison.shown is None:
        return ""
    frames = comparison.sequences[comparison.shown].frames
    assert frames is not None
    raw = np.stack([frames.events, frames.truth, frames.produced - frames.truth])
    return base64.b64encode(gzip.compress(raw.tobytes(), compresslevel=9, mtime=0)).decode("ascii")
