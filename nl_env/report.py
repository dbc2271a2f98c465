"""A finished comparison as files: ``results.json``, ``table.md``, figures, and one page that works offline.

``docs/results-schema.md`` describes ``results.json``.
"""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

import nl_env
from nl_env.comparison import Comparison
from nl_env.evaluation import DECIDING_METRIC
from nl_env.frame_rates import KINDS, rate_by_kind, rate_by_speed
from nl_env.page import html_report
from nl_env.plots import adaptive_policies, save_plots
from nl_env.runs import write_text
from nl_env.tables import markdown_report
from nl_env.types import SLICE_US

SCHEMA = 2
"""Version of ``results.json``; grows when a field changes its meaning or goes."""

CURVE_POINTS = 200
"""The floor is thinned to this many points in the files; it has one per trigger."""


def write_report(comparison: Comparison, folder: Path) -> dict[str, Any]:
    """Write every file of the report into ``folder`` and return the content of ``results.json``."""
    results = results_json(comparison)
    write_text(folder / "results.json", json.dumps(results, indent=1, allow_nan=False) + "\n")
    write_text(folder / "table.md", markdown_report(comparison))
    save_plots(comparison, folder)
    write_text(folder / "report.html", html_report(comparison, results))
    return results


def results_json(comparison: Comparison) -> dict[str, Any]:
    """Every number of the comparison, JSON-ready; what was not measured is null."""
    keep = np.unique(np.linspace(0, len(comparison.floor) - 1, CURVE_POINTS).astype(int))
    return _null_for_nan(
        {
            "schema": SCHEMA,
            "version": nl_env.__version__,
            "settings": comparison.settings,
            "deciding_metric": DECIDING_METRIC,
            "sequences": [
                {
                    "seed": result.seed,
                    "description": result.description,
                    "duration_s": result.slices * SLICE_US / 1e6,
                    "mean_speed": float(result.ego_speed.mean()),
                    "keyframe_share": float(result.keyframe[1:].mean()),
                }
                for result in comparison.sequences
            ],
            "policies": [_policy_json(comparison, i) for i in range(len(comparison.policies))],
            "floor": {
                "rate": comparison.floor_rates[keep].tolist(),
                "error": comparison.floor[keep].tolist(),
            },
            "frontier": None if comparison.frontier is None else _plain(comparison.frontier.families),
            "rate_by_speed": {
                comparison.policies[i].name: _plain(rate_by_speed(comparison.sequences, i))
                for i in adaptive_policies(comparison)
            },
            "rate_by_kind": {
                entry: {
                    comparison.policies[i].name: _plain(rate_by_kind(comparison.sequences, i, entry))
                    for i in adaptive_policies(comparison)
                }
                for entry in KINDS
            },
        }
    )


def _policy_json(comparison: Comparison, index: int) -> dict[str, Any]:
    summary = dataclasses.asdict(comparison.summaries[index])
    rate_range = {"min": summary.pop("rate_min"), "max": summary.pop("rate_max")}
    records = [result.records[index] for result in comparison.sequences]
    return {
        **dataclasses.asdict(comparison.policies[index]),
        **{key: value for key, value in summary.items() if key != "policy"},
        "rate": summary["rate"] | rate_range,
        "saved": dataclasses.asdict(comparison.saved[index]),
        "above_floor": comparison.above_floor(index),
        "per_sequence": {
            "rate": [record.effective_rate for record in records],
            "error": [record.held[DECIDING_METRIC] for record in records],
        },
    }


def _plain(value: Any) -> Any:
    """Dataclasses as objects, arrays and tuples as lists."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {entry.name: _plain(getattr(value, entry.name)) for entry in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [_plain(item) for item in value] if isinstance(value, (list, tuple)) else value


def _null_for_nan(value: Any) -> Any:
    """JSON has no nan: null instead."""
    if isinstance(value, dict):
        return {key: _null_for_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_null_for_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
