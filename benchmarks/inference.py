"""Time of the networks at batch 1 in every runtime, against the released module as its authors run it.

    python benchmarks/inference.py [--checkpoint sunet2enresconv_best_model.pth] [--markdown docs/runtimes.md]

Two networks in every runtime, and then whole extrapolators: the released one and ours, with the motion
estimate, warp and features that ours needs, side by side in each runtime.

The reference is the eager fp32 module under ``no_grad`` with the default allocator. Every row is a process
of its own with the same weights and inputs; the processes take turns, a few repetitions each, so that
whatever else the machine does meets all rows alike. Prints JSON; asserts nothing.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import platform
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from torch import nn

from agents.keyframe_cnn import FrameDetector
from nl_env.config import SPLITS, DrivingConfig
from nl_env.depth.extrapolators import WEIGHTS, PaperUNet, Warp
from nl_env.depth.learned import MotionWarpRefine
from nl_env.depth.learned_networks import load_learned
from nl_env.depth.runtime import NetworkRunner
from nl_env.depth.unet import UNet, load_released
from nl_env.history import SensorHistory
from nl_env.representations import voxel_from_bins
from nl_env.reproduction.document import check_document, update_document
from nl_env.runs import THREAD_VARIABLES
from nl_env.streams import SyntheticStream
from nl_env.training import seeded
from nl_env.types import RESOLUTIONS, DepthExtrapolator, ExtrapolationInput

Results = dict[str, dict[str, dict[str, dict[str, float]]]]
"""Numbers by contest, size and contestant."""
Row = tuple[str, str | None]
"""Runtime and precision."""
Call = Callable[[], list[NDArray[np.float32]]]
"""What is timed: one moment in a network, or the moments of one LiDAR interval in an extrapolator."""

EAGER: Row = ("eager", None)
ROWS: dict[str, Row] = {
    "eager": EAGER,
    "torch": ("torch", "fp32"),
    "OpenVINO": ("openvino", "fp32"),
    "OpenVINO bf16": ("openvino", "bf16"),
    "ONNX Runtime": ("onnxruntime", "fp32"),
}
UNET, DETECTOR = "released U-Net", "keyframe CNN"
EXTRAPOLATORS = ("released extrapolator", "our extrapolator")


@dataclass(frozen=True)
class Args:
    """What to measure and where to write it."""

    checkpoint: Path | None = None
    """Weights of the released U-Net; random ones by default, which take the same time."""
    sizes: tuple[str, ...] = tuple(RESOLUTIONS)
    """Which of full (480x640), half (240x320) and quarter (120x160)."""
    rounds: int = 9
    """Turns of every process."""
    repetitions: int = 5
    """Calls in a turn."""
    threads: int = 2
    """Of every process."""
    intervals: int = 2
    """Simulated LiDAR intervals, four moments each, that are run in turn."""
    ours: Path = WEIGHTS / "unet.safetensors"
    """Weights of our extrapolator."""
    markdown: Path | None = None
    """Document whose results are replaced."""


class OneSlice(nn.Module):
    """The paper's keyframe network at full size, without the memory that it does not have."""

    def __init__(self, height: int, width: int) -> None:
        super().__init__()
        with seeded(0):
            self.detector = FrameDetector(height, width, pool=1, inputs="raw")

    def forward(self, event_frame: torch.Tensor) -> torch.Tensor:
        """Logit ``(1, 1)`` of an event frame ``(1, H, W)``."""
        logits: torch.Tensor = self.detector.step(event_frame, event_frame.new_zeros(1, 0))[0]
        return logits


def simulated_intervals(size: str, count: int) -> list[list[ExtrapolationInput]]:
    """The moments between two LiDAR frames, in as many test worlds."""
    stream = SyntheticStream(DrivingConfig(resolution=size))
    intervals = []
    for seed in SPLITS["test"][:count]:
        history = SensorHistory(stream.camera, stream.max_depth, Warp())
        history.add(stream.reset(seed))
        moments = []
        for _ in range(2 * stream.lidar_period - 1):
            sample = stream.advance()
            history.add(sample)
            if sample.index > stream.lidar_period:
                moments.append(history.inputs(sample))
        intervals.append(moments)
    return intervals


def network_calls(
    name: str, row: Row, args: Args, intervals: Sequence[Sequence[ExtrapolationInput]]
) -> list[Call]:
    """One call a moment of the released U-Net or the keyframe CNN."""
    moments = [moment for interval in intervals for moment in interval]
    module: nn.Module
    shown: list[tuple[NDArray[np.float32], ...]]
    if name == UNET:
        module = paper_network(args)
        shown = [*map(paper_inputs, moments)]
    else:
        module = OneSlice(*moments[0].camera.shape)
        shown = [(voxel_from_bins(moment.bins[-1:]).sum(axis=0)[None],) for moment in moments]
    module.eval()

    def eager(*inputs: NDArray[np.float32]) -> tuple[NDArray[np.float32], ...]:
        with torch.no_grad():
            return (module(*map(torch.from_numpy, inputs)).numpy(),)

    run = eager if row == EAGER else NetworkRunner(module, row[0], threads=args.threads, precision=row[1])
    return [lambda inputs=inputs: list(run(*inputs)) for inputs in shown]  # type: ignore[misc]


def extrapolator_calls(
    name: str, row: Row, args: Args, intervals: Sequence[Sequence[ExtrapolationInput]]
) -> list[Call]:
    """One call a LiDAR interval of an extrapolator that is triggered at every moment of it."""
    runner = partial(NetworkRunner, runtime=row[0], threads=args.threads, precision=row[1])
    extrapolator: DepthExtrapolator
    if name == EXTRAPOLATORS[0]:
        extrapolator = PaperUNet(runner(paper_network(args)))
    else:
        ours = load_learned(args.ours)
        extrapolator = MotionWarpRefine(
            None if ours.motion is None else runner(ours.motion),
            None if ours.refine is None else runner(ours.refine),
            threshold=ours.threshold,
            warped=ours.warped,
            events=ours.events,
        )

    def run(interval: Sequence[ExtrapolationInput]) -> list[NDArray[np.float32]]:
        extrapolator.reset()
        return [extrapolator(moment).depth for moment in interval]

    return [partial(run, interval) for interval in intervals]


def paper_network(args: Args) -> UNet:
    """The released network, with random weights if there are no others."""
    if args.checkpoint is not None:
        return load_released(args.checkpoint)
    with seeded(0):
        return UNet().eval()


def paper_inputs(moment: ExtrapolationInput) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Prior and voxel grid as the released network takes them."""
    prior = moment.lidar_frames[-1]
    prior = np.where(prior < moment.max_depth, prior, np.float32(0))
    return prior[None, None], voxel_from_bins(moment.bins)[None]


def serve(
    connection: Connection,
    name: str,
    row: Row,
    args: Args,
    intervals: Sequence[Sequence[ExtrapolationInput]],
) -> None:
    """A process: answer with all outputs, then with times whenever asked.

    A time is milliseconds per depth frame (or decision), by the clock and of the processors.
    """
    torch.set_num_threads(args.threads)
    make = extrapolator_calls if name in EXTRAPOLATORS else network_calls
    calls = make(name, row, args, intervals)
    results = [call() for call in calls]
    connection.send([array for result in results for array in result])
    while connection.recv():
        taken = []
        for k in range(args.repetitions):
            start, start_cpu = time.perf_counter(), time.process_time()
            frames = len(calls[k % len(calls)]())
            elapsed, used = time.perf_counter() - start, time.process_time() - start_cpu
            taken.append((elapsed * 1e3 / frames, used * 1e3 / frames))
        connection.send(taken)


def measure(contestants: dict[str, tuple[str, Row]], size: str, args: Args) -> dict[str, dict[str, float]]:
    """Numbers by contestant; the first one is what the others are compared with.

    Args:
        contestants: network or extrapolator and row, by name.
        size: of the images.
    """
    intervals = simulated_intervals(size, args.intervals)
    context = multiprocessing.get_context("spawn")
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(args.threads)))
    connections: dict[str, Connection] = {}
    processes = []
    outputs: dict[str, list[NDArray[np.float32]]] = {}
    for title, (name, row) in contestants.items():
        connections[title], theirs = context.Pipe()
        process = context.Process(target=serve, args=(theirs, name, row, args, intervals), daemon=True)
        process.start()
        theirs.close()
        processes.append(process)
        outputs[title] = connections[title].recv()
    turns: dict[str, list[list[tuple[float, float]]]] = {title: [] for title in contestants}
    for turn in range(args.rounds + 1):
        for title, connection in connections.items():
            connection.send(True)
            taken = connection.recv()
            if turn:  # the first one warms up
                turns[title].append(taken)
    for connection, process in zip(connections.values(), processes, strict=True):
        connection.send(False)
        process.join()
    first = next(iter(contestants))
    return {
        title: summary(turns[title], turns[first], outputs[title], outputs[first]) for title in contestants
    }


def summary(
    turns: list[list[tuple[float, float]]],
    first_turns: list[list[tuple[float, float]]],
    outputs: list[NDArray[np.float32]],
    expected: list[NDArray[np.float32]],
) -> dict[str, float]:
    """Numbers of one contestant. The speed-up is the median over turns of the ratio of the turns' medians."""
    (clock, processors), (first_clock, first_processors) = _medians(turns), _medians(first_turns)
    difference = np.stack(outputs) - np.stack(expected)
    return {
        "median_ms": float(np.median(clock)),
        "min_ms": min(ms for turn in turns for ms, _ in turn),
        "speed_up": float(np.median(first_clock / clock)),
        "processor_ms": float(np.median(processors)),
        "speed_up_of_processor_time": float(np.median(first_processors / processors)),
        "largest_difference": float(np.abs(difference).max()),
        "rms_difference": float(np.sqrt(np.mean(difference.astype(np.float64) ** 2))),
    }


def _medians(turns: list[list[tuple[float, float]]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Median of every turn, by the clock and of the processors' time."""
    clock, processors = np.median(np.array(turns), axis=1).T
    return clock, processors


def table(results: Results) -> str:
    """Markdown: a row per network and runtime, a column per size."""
    sizes = list(next(iter(results.values())))
    shapes = ["x".join(map(str, RESOLUTIONS[size])) for size in sizes]
    lines = [
        "| what | runtime | " + " | ".join(shapes) + " | largest / rms difference |",
        "|---|---|" + "--:|" * len(sizes) + "--:|",
    ]
    for title, by_size in results.items():
        for row in by_size[sizes[0]]:
            found = [by_size[size][row] for size in sizes]
            cells = [f"{one['median_ms']:.3g} ms ({one['speed_up']:.2g}x)" for one in found]
            largest = max(one["largest_difference"] for one in found)
            rms = max(one["rms_difference"] for one in found)
            apart = "" if title.startswith("extrapolators") else f"{largest:.2g} / {rms:.2g}"
            lines.append(f"| {title} | {row} | {' | '.join(cells)} | {apart} |")
    return "\n".join(lines)


def main(args: Args) -> None:
    """Measure, print JSON, and write the document."""
    if args.markdown is not None:
        check_document(args.markdown, "results")
    contests = {name: {row: (name, ROWS[row]) for row in ROWS} for name in (UNET, DETECTOR)}
    for runtime in ("torch", "OpenVINO", "OpenVINO bf16"):
        contests[f"extrapolators, {runtime}"] = {name: (name, ROWS[runtime]) for name in EXTRAPOLATORS}
    results: Results = {}
    for title, contestants in contests.items():
        results[title] = {}
        for size in args.sizes:
            results[title][size] = measure(contestants, size, args)
            found = ", ".join(
                f"{name} {one['median_ms']:.3g} ms ({one['speed_up']:.2g}x)"
                for name, one in results[title][size].items()
            )
            print(f"{title}, {size}: {found}", file=sys.stderr)
    weights = "random" if args.checkpoint is None else args.checkpoint.name
    report = {
        "threads": args.threads,
        "weights": weights,
        "machine": platform.machine(),
        "results": results,
    }
    print(json.dumps(report, indent=2))
    if args.markdown is not None:
        note = (
            f"{args.threads} threads, batch 1, U-Net weights: {weights}. Median ms per depth frame or "
            "decision (times the first row of its kind)."
        )
        update_document(args.markdown, "results", f"{note}\n\n{table(results)}")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
