"""Time of every stage of the synthetic environment, on one thread, at three resolutions. Asserts nothing.

One test world per scenario; style and weather follow from its seed. Prints JSON; ``--markdown`` writes
the page ``docs/performance.md``. Usage: ``python benchmarks/stages.py [--worlds 7] [--slices 30]``.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

os.environ.update(NUMBA_NUM_THREADS="1", OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import nl_env
from nl_env.config import SCENARIOS, SPLITS, DrivingConfig, SceneConfig
from nl_env.depth.extrapolators import Repeat, Warp
from nl_env.depth.metrics import full_metrics, paper_metrics
from nl_env.depth.motion import estimate_motion
from nl_env.history import SensorHistory
from nl_env.representations import frame_from_bins, voxel_from_bins
from nl_env.scene.scene import DrivingScene
from nl_env.scene.traffic import simulate
from nl_env.sensors.event_camera import EventCamera
from nl_env.sensors.lidar import Lidar
from nl_env.types import BINS, RESOLUTIONS, SLICE_US, TICK_US, TICKS_PER_SLICE, Sample

STAGES = {
    "traffic": "simulate all traffic of a 20 s sequence",
    "world": "build and light the world around it",
    "reset": "`env.reset`: traffic, world, first slice",
    "render": "one 5 ms frame: intensity, every fourth time depth too",
    "events": "`realistic` event camera, one frame, into the bins",
    "event frame": "Eq. 1, one slice, from its bins",
    "voxel grid": "Eq. 2, all slices since the last LiDAR frame, from their bins",
    "lidar": "measure one depth frame",
    "metrics": "both metric sets of one depth frame",
    "repeat": "extrapolate one frame with `repeat`",
    "motion": "estimate the ego motion between two LiDAR frames (ICP), once per LiDAR frame",
    "warp": "warp one frame by a known motion (splat)",
    "step, repeat": "one `env.step` (20 ms), `repeat`, triggering always",
    "step, warp": "one `env.step` (20 ms), `warp`, triggering always",
}
RATES = {
    "sensors": "render + events + event frame + voxel grid, frames/s",
    "sensors and traffic": "the same, with the simulation of the traffic spread over its 20 s, frames/s",
    "sensors and reset": "the same, with the traffic and the world spread over the 20 s, frames/s",
    "env, repeat": "`nl_env/Driving-v0` with `repeat`, steps/s",
    "env, warp": "`nl_env/Driving-v0` with `warp`, steps/s",
}

World = tuple[str, int]
"""Scenario and sequence seed."""
Result = TypeVar("Result")


class Stopwatch:
    """Times of each stage in seconds, and rates of each world."""

    def __init__(self) -> None:
        self.times: defaultdict[str, list[float]] = defaultdict(list)
        self.rates: defaultdict[str, list[float]] = defaultdict(list)

    def timed(self, stage: str, call: Callable[..., Result], *args: Any, **kwargs: Any) -> Result:
        """Call and remember how long it took."""
        start = time.perf_counter()
        result = call(*args, **kwargs)
        self.times[stage].append(time.perf_counter() - start)
        return result

    def report(self) -> dict[str, Any]:
        """Median and fastest call of each stage; mean and slowest world of each rate."""
        return {
            "stages": {
                stage: {"median_ms": _rounded(1e3 * np.median(t)), "min_ms": _rounded(1e3 * min(t))}
                for stage, t in self.times.items()
            },
            "rates": {
                name: {"mean": _rounded(np.mean(r)), "slowest": _rounded(min(r))}
                for name, r in self.rates.items()
            },
        }


def measure(resolution: str, worlds: Sequence[World], slices: int) -> dict[str, Any]:
    """All stages at one resolution, over ``slices`` slices of each world."""
    watch = Stopwatch()
    for scenario, seed in worlds:
        config = DrivingConfig(resolution=resolution, scene=SceneConfig(scenario=scenario))
        time_sensors(watch, config, seed, slices)
        samples = time_env(watch, config, "repeat", seed, slices)
        time_consumers(watch, config, samples)
        time_env(watch, config, "warp", seed, slices)
    return watch.report()


def time_sensors(watch: Stopwatch, config: DrivingConfig, seed: int, slices: int) -> None:
    """Build one world and run what a sensor stream runs."""
    start = time.perf_counter()
    watch.timed("traffic", simulate, str(config.scene.scenario), seed, config.scene.duration_s)
    middle = time.perf_counter()
    scene = DrivingScene(config.scene, config.camera, seed)
    both = time.perf_counter() - middle
    traffic = middle - start
    watch.times["world"].append(both - traffic)  # the scene simulates its traffic itself

    event_camera = EventCamera(config.events, config.camera.shape)
    event_camera.noise_scale = scene.noise_scale
    intensity = np.zeros(config.camera.shape, np.float32)
    depth = np.zeros(config.camera.shape, np.float32)
    scene.render(0, intensity, depth)
    event_camera.reset(intensity, 0, np.random.default_rng(seed))
    window: list[NDArray[np.int16]] = []
    start = time.perf_counter()
    for k in range(slices):
        bins = np.zeros((BINS, *config.camera.shape), np.int16)
        for tick in range(1, TICKS_PER_SLICE + 1):
            t = k * SLICE_US + tick * TICK_US
            watch.timed("render", scene.render, t, intensity, depth if tick == TICKS_PER_SLICE else None)
            watch.timed("events", event_camera.accumulate, intensity, t, bins, k * SLICE_US)
        if k % config.lidar.period == 0:
            window.clear()
        window.append(bins)
        watch.timed("event frame", frame_from_bins, bins)
        watch.timed("voxel grid", voxel_from_bins, window)
    elapsed = time.perf_counter() - start
    frames, share = slices * TICKS_PER_SLICE, slices / config.scene.slices
    watch.rates["sensors"].append(frames / elapsed)
    watch.rates["sensors and traffic"].append(frames / (elapsed + share * traffic))
    watch.rates["sensors and reset"].append(frames / (elapsed + share * both))


def time_env(
    watch: Stopwatch, config: DrivingConfig, extrapolator: str, seed: int, slices: int
) -> list[Sample]:
    """Step the registered environment, triggering always; returns the samples it went through."""
    env = make_env(config, extrapolator)
    watch.timed("reset", env.reset, seed=seed)
    samples = []
    stage = f"step, {extrapolator}"
    for _ in range(slices):
        samples.append(env.unwrapped.sample)  # type: ignore[attr-defined]
        watch.timed(stage, env.step, 1)
    env.close()
    watch.rates[f"env, {extrapolator}"].append(slices / sum(watch.times[stage][-slices:]))
    return samples


def make_env(config: DrivingConfig, extrapolator: str) -> gym.Env[Any, Any]:
    """The environment as a user makes it."""
    return gym.make(
        "nl_env/Driving-v0",
        resolution=config.resolution,
        scenario=config.scene.scenario,
        extrapolator=extrapolator,
    )


def time_consumers(watch: Stopwatch, config: DrivingConfig, samples: Sequence[Sample]) -> None:
    """Everything that happens to samples: LiDAR, extrapolators, metrics."""
    camera, max_depth = config.camera, config.lidar.max_depth
    lidar, repeat, warp = Lidar(config.lidar, camera), Repeat(), Warp(odometry=True)
    history = SensorHistory(camera, max_depth, warp)
    first = next(k for k, sample in enumerate(samples) if sample.lidar is not None)
    for sample in samples[first:]:
        history.add(sample)
        watch.timed("lidar", lidar.measure, sample.depth)
        inputs = history.inputs(sample)
        if sample.lidar is None:
            watch.timed("repeat", repeat, inputs)
            if len(inputs.lidar_frames) == 2:
                watch.timed("warp", warp, inputs)
            produced = inputs.lidar_frames[-1]
            watch.timed("metrics", _both_metrics, produced, sample.depth, max_depth)
        elif len(inputs.lidar_frames) == 2:
            watch.timed("motion", estimate_motion, *inputs.lidar_frames, camera, max_depth)


def _both_metrics(produced: NDArray[np.float32], truth: NDArray[np.float32], max_depth: float) -> None:
    paper_metrics(produced, truth, max_depth)
    full_metrics(produced, truth, max_depth)


def steps_per_second(worlds: Sequence[World], slices: int) -> float:
    """Steps per second of one process with ``repeat`` at quarter resolution, resets not counted."""
    watch = Stopwatch()
    for scenario, seed in worlds:
        time_env(watch, DrivingConfig(scene=SceneConfig(scenario=scenario)), "repeat", seed, slices)
    return slices * len(worlds) / sum(watch.times["step, repeat"])


def measure_processes(worlds: Sequence[World], slices: int) -> dict[str, float]:
    """Steps per second of one process, and of two together."""
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        list(pool.map(steps_per_second, [worlds[:1]] * 2, [1] * 2))
        together = sum(pool.map(steps_per_second, [worlds] * 2, [slices] * 2))
    return {"one": _rounded(steps_per_second(worlds, slices)), "two": _rounded(together)}


def machine() -> dict[str, Any]:
    """What the numbers were measured on."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        model = names[0].split(":", 1)[1].strip() if names else model
    return {
        "cpu": model,
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        **{name: version(name) for name in ("numpy", "numba", "gymnasium")},
        "nl-env": nl_env.__version__,
    }


def markdown(report: dict[str, Any], command: str) -> str:
    """The page ``docs/performance.md``."""
    m, resolutions = report["machine"], report["resolutions"]
    header = "".join(f" {name} {RESOLUTIONS[name][0]}x{RESOLUTIONS[name][1]} |" for name in resolutions)
    rule = "|---|" + "--:|" * len(resolutions) + "---|"
    scenarios = ", ".join(scenario for scenario, _ in report["worlds"])
    lines = [
        "# Performance",
        "",
        f"Written by `{command}`; the same numbers as JSON are in `performance.json`. Machine: {m['cpu']},",
        f"{m['cores']} cores; Python {m['python']}, NumPy {m['numpy']}, Numba {m['numba']}. One thread.",
        f"Worlds: the first {len(report['worlds'])} test seeds, one a scenario ({scenarios}),",
        f"{report['slices']} slices of 20 ms each. Kernels were compiled before.",
        "",
        "## Stages",
        "",
        "Median (fastest) call in ms, over all worlds.",
        "",
        f"| stage |{header} what it is |",
        rule,
    ]
    for stage, meaning in STAGES.items():
        times = [report["stages"].get(stage) for report in resolutions.values()]
        cells = [f"{_shown(t['median_ms'])} ({_shown(t['min_ms'])})" if t else "-" for t in times]
        lines.append(f"| {stage} | {' | '.join(cells)} | {meaning} |")
    lines += [
        "",
        "## Rates",
        "",
        "Mean over worlds (slowest world). Real time is 200 frames/s and 50 steps/s.",
        "",
        f"| rate |{header} what it is |",
        rule,
    ]
    for name, meaning in RATES.items():
        rates = [report["rates"][name] for report in resolutions.values()]
        cells = [f"{r['mean']:,.0f} ({r['slowest']:,.0f})" for r in rates]
        lines.append(f"| {name} | {' | '.join(cells)} | {meaning} |")
    processes = report["processes"]
    lines += [
        "",
        "Processes of one thread each, `nl_env/Driving-v0` at quarter resolution with `repeat`, resets not",
        f"counted: one {processes['one']:,.0f} steps/s, two together {processes['two']:,.0f} steps/s.",
    ]
    return "\n".join(lines) + "\n"


def _shown(ms: float) -> str:
    return f"{ms:.0f}" if ms >= 100 else f"{ms:.3g}"


def _rounded(value: Any) -> float:
    return float(f"{float(value):.4g}")


def main() -> None:
    """Time everything, print one JSON object, and write the files asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "--worlds", type=int, default=len(SCENARIOS), help="number of worlds, 1 to 7 (default 7)"
    )
    parser.add_argument("--slices", type=int, default=30, help="slices of each world (default 30)")
    parser.add_argument("--json", type=Path, help="also write the JSON to this file")
    parser.add_argument("--markdown", type=Path, help="also write the page to this file")
    args = parser.parse_args()
    if not 1 <= args.worlds <= len(SCENARIOS):
        parser.error(f"--worlds: found {args.worlds}, expected 1 to {len(SCENARIOS)}")
    if args.slices < 11:
        parser.error(f"--slices: found {args.slices}, expected at least 11, which hold three LiDAR frames")

    worlds: list[World] = list(zip(SCENARIOS, SPLITS["test"], strict=False))[: args.worlds]
    measure("quarter", worlds[:1], 11)  # compiles or loads every kernel
    report = {
        "machine": machine(),
        "threads": 1,
        "worlds": worlds,
        "slices": args.slices,
        "resolutions": {name: measure(name, worlds, args.slices) for name in RESOLUTIONS},
        "processes": measure_processes(worlds, args.slices),
    }
    text = json.dumps(report, indent=1) + "\n"
    print(text, end="")
    if args.json:
        args.json.write_text(text, encoding="utf-8")
    if args.markdown:
        args.markdown.write_text(markdown(report, "make bench"), encoding="utf-8")


if __name__ == "__main__":
    main()
