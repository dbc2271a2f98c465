"""Time of the event camera and of the Event Slicer, per 5 ms frame, on one thread. Prints JSON.

The frames are a synthetic drive: a still sky over textured ground that streams faster the closer it is,
with hard-edged patches, blurred by 0.6 pixels; ``speed`` scales the motion. Peers are timed on the same
frames when they are installed: v2e with every noise source of the ``realistic`` preset, eventify-dvs,
which has no noise and keeps no state between frames. Usage: ``python benchmarks/events.py [--frames 40]``.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from itertools import pairwise
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("NUMBA_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from nl_env.config import NOISE_PRESETS, EventCameraConfig
from nl_env.representations import event_frame, frame_from_bins, voxel_from_bins, voxel_grid
from nl_env.sensors.event_camera import EventCamera
from nl_env.types import BINS, RESOLUTIONS, SLICE_US, TICK_US

Frames = list[NDArray[np.float32]]


def drive(shape: tuple[int, int], count: int, speed: float, seed: int = 0) -> Frames:
    """``count`` images of the synthetic drive; the bottom row moves ``speed`` image widths a second."""
    height, width = shape
    rng = np.random.default_rng(seed)
    texture = np.zeros((height, 4 * width))
    for scale, contrast in ((0.0, 0.15), (1.5, 0.15), (6.0, 0.3)):
        layer = gaussian_filter(rng.standard_normal(texture.shape), scale, mode="wrap")
        texture += contrast * layer / layer.std()
    for _ in range(texture.size // 600):
        y, x = rng.integers(0, texture.shape[0]), rng.integers(0, texture.shape[1])
        texture[y : y + rng.integers(2, 14), x : x + rng.integers(2, 20)] = rng.normal(0, 0.6)
    texture = np.exp(gaussian_filter(texture, 0.6, mode="wrap") - 1.2)

    rows = np.arange(height)[:, None]
    nearness = np.clip((rows - 0.35 * height) / (0.65 * height), 0, 1)
    images = []
    for k in range(count):
        place = np.arange(width) + nearness * speed * width * k * TICK_US * 1e-6
        left = place.astype(int)
        part = place - left
        image = (1 - part) * texture[rows, left % (4 * width)] + part * texture[
            rows, (left + 1) % (4 * width)
        ]
        images.append(np.clip(image, 0.001, 1).astype(np.float32))
    return images


def milliseconds(steps: Iterator[Callable[[], Any]]) -> float:
    """Median time of a step, ms."""
    times = []
    for step in steps:
        start = time.perf_counter()
        step()
        times.append(time.perf_counter() - start)
    return round(1e3 * float(np.median(times)), 4)


def measure_camera(frames: Frames, preset: str) -> dict[str, float]:
    """Fused and materialised times of one preset, ms a frame, and how busy the frames are."""
    shape = frames[0].shape
    cam = EventCamera(EventCameraConfig.preset(preset), shape)
    bins = np.zeros((BINS, *shape), np.int16)
    lists: list[NDArray[np.void]] = []

    def fused() -> Iterator[Callable[[], Any]]:
        cam.reset(frames[0], 0, np.random.default_rng(0))
        for k, image in enumerate(frames[1:]):
            yield lambda k=k, image=image: cam.accumulate(
                image, (k + 1) * TICK_US, bins, k * TICK_US // SLICE_US * SLICE_US
            )

    def materialised() -> Iterator[Callable[[], Any]]:
        cam.reset(frames[0], 0, np.random.default_rng(0))
        for k, image in enumerate(frames[1:]):
            yield lambda k=k, image=image: lists.append(cam.events(image, (k + 1) * TICK_US))

    milliseconds(fused()), milliseconds(materialised())
    lists.clear()
    result = {"fused_ms": milliseconds(fused()), "materialised_ms": milliseconds(materialised())}
    pixels = frames[0].size
    active = [np.count_nonzero(np.bincount(e["y"].astype(int) * shape[1] + e["x"])) / pixels for e in lists]
    return result | {
        "active_share": round(float(np.mean(active)), 3),
        "events_per_frame": round(float(np.mean([len(e) for e in lists]))),
    }


def measure_slicer(shape: tuple[int, int]) -> dict[str, float]:
    """Representations of five slices: from bins, and from one million events; ms."""
    rng = np.random.default_rng(0)
    slices = [rng.integers(-3, 4, (BINS, *shape)).astype(np.int16) for _ in range(5)]
    events = np.zeros(1_000_000, [("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "i1")])
    events["t"] = np.sort(rng.integers(0, 100_000, events.size))
    events["x"], events["y"] = rng.integers(0, shape[1], events.size), rng.integers(0, shape[0], events.size)
    events["p"] = rng.choice([-1, 1], events.size)
    stages: dict[str, Callable[[], Any]] = {
        "voxel_from_bins_5_slices_ms": lambda: voxel_from_bins(slices),
        "frame_from_bins_ms": lambda: frame_from_bins(slices[0]),
        "event_frame_1m_events_ms": lambda: event_frame(events, shape, 0, 100_000),
        "voxel_grid_1m_events_ms": lambda: voxel_grid(events, shape, 0, 100_000),
    }
    for stage in stages.values():
        stage()
    return {name: milliseconds(iter([stage] * 9)) for name, stage in stages.items()}


def measure_eventify(frames: Frames) -> float | str:
    """eventify-dvs on consecutive pairs, ms a frame, or "not installed"."""
    if find_spec("eventify") is None:
        return "not installed"
    from eventify import frame_to_event_tuples

    grey = [255 * image for image in frames]
    threshold = EventCameraConfig().threshold_on
    return milliseconds(
        lambda a=a, b=b, k=k: frame_to_event_tuples(a, b, k * TICK_US, (k + 1) * TICK_US, threshold)
        for k, (a, b) in enumerate(pairwise(grey))
    )


def measure_v2e(frames: Frames) -> float | str:
    """v2e with the noise of the ``realistic`` preset, ms a frame, or "not installed"."""
    if find_spec("v2ecore") is None:
        return "not installed"
    import torch
    from v2ecore.emulator import EventEmulator

    torch.set_num_threads(1)
    config = EventCameraConfig.preset("realistic")
    emulator = EventEmulator(
        pos_thres=config.threshold_on,
        neg_thres=config.threshold_off,
        sigma_thres=config.threshold_mismatch,
        cutoff_hz=config.cutoff_hz,
        leak_rate_hz=config.leak_rate_hz,
        shot_noise_rate_hz=config.shot_rate_hz,
        refractory_period_s=config.refractory_us * 1e-6,
        device="cpu",
    )
    emulator.generate_events(255 * frames[0], 0.0)
    return milliseconds(
        lambda k=k, image=image: emulator.generate_events(255 * image, (k + 1) * TICK_US * 1e-6)
        for k, image in enumerate(frames[1:])
    )


def main() -> None:
    """Time everything and print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--frames", type=int, default=40, help="frames a measurement (default 40)")
    count = parser.parse_args().frames + 1
    results = []
    for resolution, shape in RESOLUTIONS.items():
        entry: dict[str, Any] = {"resolution": resolution, "shape": shape, "slicer": measure_slicer(shape)}
        for pace, speed in (("slow", 0.05), ("medium", 0.2), ("fast", 0.8)):
            frames = drive(shape, count, speed)
            entry[pace] = {preset: measure_camera(frames, preset) for preset in NOISE_PRESETS}
            entry[pace] |= {"eventify_ms": measure_eventify(frames), "v2e_ms": measure_v2e(frames)}
        results.append(entry)
    print(json.dumps({"threads": 1, "frames": count - 1, "results": results}, indent=2))


if __name__ == "__main__":
    main()
