"""Error of the extrapolators without learning at the paper's five gaps, in both metric sets.

    python benchmarks/extrapolators.py --markdown docs/extrapolators.md

Every pair is a LiDAR frame, the one 100 ms before it, and the truth one gap later, at 480x640 in test
worlds. Prints JSON: mean and standard error over worlds, and the change against Repeat.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import tyro

from nl_env.config import SPLITS, DrivingConfig
from nl_env.depth.extrapolators import make_extrapolator
from nl_env.depth.metrics import METRIC_NAMES, full_metrics, paper_metrics
from nl_env.realism.published import GAPS_MS
from nl_env.reproduction.document import check_document, update_document
from nl_env.scene.scene import DrivingScene
from nl_env.sensors.lidar import quantise
from nl_env.types import SLICE_US, ExtrapolationInput

METHODS = (("repeat", False), ("linear", False), ("exponential", False), ("warp", False), ("warp", True))
"""Extrapolator and whether it is given the true camera poses."""
SHOWN = ("log_mae", "imae", "bad_25", "false_return", "rmse", "abs_rel", "delta_1")
_PERIOD_US = 100_000


@dataclass(frozen=True)
class Args:
    """What to measure and where to write it."""

    worlds: int = 24
    """Number of test worlds."""
    pairs: int = 6
    """LiDAR frames per world, at random slices."""
    seed_start: int = 0
    """First test world."""
    workers: int = 2
    """Processes of one thread each."""
    markdown: Path | None = None
    """Document whose results are replaced."""


def label(name: str, odometry: bool) -> str:
    """Row name of a method."""
    return f"{name} (true motion)" if odometry else name


def measure_world(seed: int, pairs: int) -> np.ndarray:
    """``(methods, gaps, metrics)`` means of the world of ``seed``."""
    config = DrivingConfig(resolution="full")
    scene = DrivingScene(config.scene, config.camera, seed)
    far = config.lidar.max_depth
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(11,)))
    intensity = np.zeros(config.camera.shape, np.float32)
    depth = np.zeros(config.camera.shape, np.float32)

    def look(t: int) -> np.ndarray:
        scene.render(t, intensity, depth)
        return quantise(depth, far)

    latest = config.scene.slices - GAPS_MS[-1] * 1000 // SLICE_US
    scores = []
    for k in rng.integers(_PERIOD_US // SLICE_US, latest, pairs):
        now = int(k) * SLICE_US
        frames, times = (look(now - _PERIOD_US), look(now)), (now - _PERIOD_US, now)
        truths = [look(now + gap * 1000) for gap in GAPS_MS]
        rows = []
        for name, odometry in METHODS:
            method = make_extrapolator(name, odometry=odometry)
            row = []
            for gap, truth in zip(GAPS_MS, truths, strict=True):
                t = now + gap * 1000
                poses = tuple(scene.pose(at) for at in (*times, t)) if odometry else ()
                inputs = ExtrapolationInput(t, config.camera, far, frames, times, (), poses)
                predicted = method(inputs).depth
                paper, full = paper_metrics(predicted, truth, far), full_metrics(predicted, truth, far)
                row.append([*paper, *full])
            rows.append(row)
        scores.append(rows)
    return np.nanmean(np.array(scores), axis=0)


def summarise(worlds: np.ndarray) -> dict[str, Any]:
    """Means, standard errors, changes against Repeat of ``(worlds, methods, gaps, metrics)``; JSON-ready."""
    overall = np.concatenate([worlds, worlds.mean(2, keepdims=True)], axis=2)
    gaps = [*map(str, GAPS_MS), "mean"]
    mean, spread = overall.mean(0), overall.std(0, ddof=1) / np.sqrt(len(overall))
    return {
        label(*method): {
            gap: {
                metric: {
                    "mean": float(mean[i, g, m]),
                    "standard_error": float(spread[i, g, m]),
                    "against_repeat": float(mean[i, g, m] / mean[0, g, m] - 1),
                }
                for m, metric in enumerate(METRIC_NAMES)
            }
            for g, gap in enumerate(gaps)
        }
        for i, method in enumerate(METHODS)
    }


def table(summary: dict[str, Any]) -> str:
    """Markdown rows: method by gap, with the change against Repeat of the errors that decide."""
    lines = ["| gap ms | method | " + " | ".join(SHOWN) + " |", "|---|---|" + "--:|" * len(SHOWN)]
    for gap in next(iter(summary.values())):
        for method, by_gap in summary.items():
            cells = []
            for metric in SHOWN:
                value = by_gap[gap][metric]
                change = "" if method == "repeat" else f" ({value['against_repeat']:+.0%})"
                cells.append(f"{value['mean']:.4g}{change}")
            lines.append(f"| {gap} | {method} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(args: Args) -> None:
    """Measure, print JSON, and write the document."""
    if args.markdown is not None:
        check_document(args.markdown, "results")
    for variable in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ[variable] = "1"
    seeds = SPLITS["test"][args.seed_start : args.seed_start + args.worlds]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(args.workers, mp_context=context) as pool:
        worlds = np.array(list(pool.map(measure_world, seeds, [args.pairs] * len(seeds))))
    summary = summarise(worlds)
    print(json.dumps({"worlds": args.worlds, "pairs": args.pairs, "methods": summary}, indent=2))
    if args.markdown is not None:
        note = f"{args.worlds} test worlds, {args.pairs} LiDAR frames each, 480x640."
        update_document(args.markdown, "results", f"{note}\n\n{table(summary)}")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
