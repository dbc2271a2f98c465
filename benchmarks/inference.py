"""Time of the networks at batch 1 in every runtime, against the released module as its authors run it.

    python benchmarks/inference.py [--checkpoint sunet2enresconv_best_model.pth] [--markdown docs/runtimes.md]
    python benchmarks/inference.py --results runs/inference.json --minutes 6  # and again, until it is whole

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
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from torch import nn

from agents.keyframe_cnn import FrameDetector
from nl_env.config import SPLITS, DrivingConfig, choice
from nl_env.depth.extrapolators import WEIGHTS, PaperUNet, Warp
from nl_env.depth.learned import MotionWarpRefine
from nl_env.depth.learned_networks import load_learned, run_refinement
from nl_env.depth.runtime import NetworkRunner
from nl_env.depth.unet import UNet, load_released
from nl_env.history import SensorHistory
from nl_env.representations import voxel_from_bins
from nl_env.reproduction.document import check_document, machine, update_document
from nl_env.runs import THREAD_VARIABLES, write_text
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
CONTESTS: dict[str, dict[str, tuple[str, Row]]] = {
    **{name: {row: (name, ROWS[row]) for row in ROWS} for name in (UNET, DETECTOR)},
    **{
        f"extrapolators, {runtime}": {name: (name, ROWS[runtime]) for name in EXTRAPOLATORS}
        for runtime in ("torch", "OpenVINO", "OpenVINO bf16")
    },
}
"""Network or extrapolator and row of every contestant, by contest; the first one is the reference."""
SETTINGS = ("weights", "threads", "rounds", "repetitions", "intervals")
"""What has to be the same in runs whose results stand in one file."""


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
    contests: tuple[str, ...] = tuple(CONTESTS)
    """Which of the contests."""
    minutes: float = float("inf")
    """No other measurement is begun after this long."""
    results: Path | None = None
    """JSON file that takes every measurement as soon as it is made; those it has are not made again."""
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
    how: dict[str, Any] = {"runtime": row[0], "threads": args.threads, "precision": row[1]}
    extrapolator: DepthExtrapolator
    if name == EXTRAPOLATORS[0]:
        extrapolator = PaperUNet(NetworkRunner(paper_network(args), **how))
    else:
        ours = load_learned(args.ours)
        extrapolator = MotionWarpRefine(
            None if ours.motion is None else NetworkRunner(ours.motion, **how),
            None if ours.refine is None else run_refinement(ours.refine, **how),
            threshold=ours.threshold,
            warped=ours.warped,
            events=ours.events,
            threads=args.threads,
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
    sizes = [size for size in RESOLUTIONS if any(size in by_size for by_size in results.values())]
    shapes = ["x".join(map(str, RESOLUTIONS[size])) for size in sizes]
    lines = ["| what | runtime | " + " | ".join(shapes) + " |", "|---|---|" + "--:|" * len(sizes)]
    for title, by_size in results.items():
        for row in CONTESTS[title]:
            cells = [
                f"{by_size[size][row]['median_ms']:.3g} ms ({by_size[size][row]['speed_up']:.2g}x)"
                if size in by_size
                else "-"
                for size in sizes
            ]
            lines.append(f"| {title} | {row} | {' | '.join(cells)} |")
    return "\n".join(lines)


def differences(results: Results) -> str:
    """How far the runtimes' outputs are from eager's, in words; nothing without any."""
    sentences = []
    for title, unit in ((UNET, " m"), (DETECTOR, "")):
        for row in CONTESTS[title]:
            found = [by_row[row] for by_row in results.get(title, {}).values()]
            if found and ROWS[row] != EAGER:
                largest = max(one["largest_difference"] for one in found)
                rms = max(one["rms_difference"] for one in found)
                sentences.append(f"{title}, {row}: {largest:.2g}{unit} at most, {rms:.2g}{unit} RMS")
    return f"Differences from eager, the worst of the sizes. {'; '.join(sentences)}." if sentences else ""


def read_results(args: Args, settings: dict[str, object]) -> Results:
    """What ``args.results`` holds already, if there is such a file.

    Raises:
        ValueError: it is no file of results, or they were measured with other settings.
    """
    if args.results is None or not args.results.is_file():
        return {}
    try:
        report = json.loads(args.results.read_text(encoding="utf-8"))
        found, results = {name: report[name] for name in SETTINGS}, report["results"]
    except (ValueError, KeyError, TypeError) as cause:
        raise ValueError(f"results: found no results in {str(args.results)!r} ({cause!r})") from cause
    expected = {name: settings[name] for name in SETTINGS}
    if found != expected:
        raise ValueError(f"results: found {found} in {str(args.results)!r}, expected {expected}")
    return {title: results[title] for title in CONTESTS if title in results}


def main(args: Args) -> None:
    """Measure, print JSON, and write the document."""
    for title in args.contests:
        choice("contests", title, tuple(CONTESTS))
    if args.markdown is not None:
        check_document(args.markdown, "results")
    settings: dict[str, object] = {
        "weights": "random" if args.checkpoint is None else args.checkpoint.name,
        "threads": args.threads,
        "rounds": args.rounds,
        "repetitions": args.repetitions,
        "intervals": args.intervals,
        "machine": machine(),
    }
    results = read_results(args, settings)
    wanted = [(title, size) for title in args.contests for size in args.sizes]
    missing = [(title, size) for title, size in wanted if size not in results.get(title, {})]
    start = time.monotonic()
    while missing and time.monotonic() - start < args.minutes * 60:
        title, size = missing.pop(0)
        numbers = measure(CONTESTS[title], size, args)
        results.setdefault(title, {})[size] = numbers
        results = {name: results[name] for name in CONTESTS if name in results}
        found = ", ".join(
            f"{name} {one['median_ms']:.3g} ms ({one['speed_up']:.2g}x)" for name, one in numbers.items()
        )
        print(f"{title}, {size}: {found}", file=sys.stderr)
        if args.results is not None:
            write_text(args.results, json.dumps({**settings, "results": results}, indent=2) + "\n")
    if missing:
        print("not measured yet: " + "; ".join(map(", ".join, missing)), file=sys.stderr)
    print(json.dumps({**settings, "results": results}, indent=2))
    if args.markdown is not None:
        note = (
            f"{settings['machine']}, {args.threads} threads, batch 1, U-Net weights: {settings['weights']}. "
            "Median ms per depth frame or decision (times as fast as the first row of its kind)."
        )
        text = f"{note}\n\n{table(results)}\n\n{differences(results)}"
        update_document(args.markdown, "results", text)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
