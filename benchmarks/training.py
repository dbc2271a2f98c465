"""Training speed: the released loop, each change to it, and the engine, side by side at 120x160.

    python benchmarks/training.py --markdown docs/training.md > docs/training.json

Every row trains the same network on the same batches in a process of its own; the processes take turns,
a few steps each, so that whatever else the machine does hits all of them. Prints JSON: the median over the
turns of samples per second of time (and of processor time, which other work on the machine disturbs less),
and the ratio to the released loop, turn by turn. Asserts nothing.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import platform
import sys
import tempfile
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from statistics import median
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import torch
import tyro
from torch import Tensor, nn
from torch.nn import functional

from agents.keyframe_networks import FrameDetector
from nl_env.depth.losses import meter_loss
from nl_env.depth.runtime.allocator import keep_large_blocks
from nl_env.depth.unet import UNet
from nl_env.reproduction.document import check_document, update_document
from nl_env.training import Forward, TrainingOptions, train
from nl_env.training.options import uses_bf16
from nl_env.weight_files import Card

SHAPE = (120, 160)


@dataclass(frozen=True)
class Args:
    """What to measure and where to write it."""

    turns: int = 7
    """Turns of every row."""
    steps: int = 4
    """Steps a turn; one more, before them, is not counted."""
    unet_batch: int = 8
    """Samples a step of the U-Net; the released code has 8."""
    keyframe_batch: int = 64
    """Samples a step of the keyframe CNN; the paper has 64."""
    threads: int = 2
    """CPU threads of every row."""
    markdown: Path | None = None
    """Document whose results are replaced."""


@dataclass(frozen=True)
class Loop:
    """What a hand-written loop does other than the released one."""

    fast_loss: bool = False
    channels_last: bool = False
    bf16: bool = False
    keep_memory: bool = False


LADDER = {
    "released loop": Loop(),
    "and separable loss": Loop(fast_loss=True),
    "and channels_last": Loop(fast_loss=True, channels_last=True),
    "and bf16": Loop(fast_loss=True, channels_last=True, bf16=True),
    "and memory kept": Loop(fast_loss=True, channels_last=True, bf16=True, keep_memory=True),
}
ENGINE = "`nl_env.training`"
NETWORKS = {"U-Net": [*LADDER, ENGINE], "keyframe CNN": ["released loop", ENGINE]}


def released_loss(predicted: Tensor, target: Tensor) -> Tensor:
    """The METER loss as it is commonly written: 2-D windows, and gradients anew for every part."""
    kernel = torch.exp(-((torch.arange(11.0) - 5) ** 2) / (2 * 1.5**2))
    window = (torch.outer(kernel, kernel) / kernel.sum() ** 2)[None, None]

    def smooth(image: Tensor) -> Tensor:
        return functional.conv2d(image, window)

    def slopes(image: Tensor) -> Tensor:
        x = torch.tensor([[1.0, 0, -1], [2, 0, -2], [1, 0, -1]])
        return functional.conv2d(image, torch.stack([x, x.T])[:, None], padding=1)

    def normals(image: Tensor) -> Tensor:
        return torch.cat([-slopes(image), torch.ones_like(image)], 1)

    mean_p, mean_t = smooth(predicted), smooth(target)
    var_p, var_t = smooth(predicted**2) - mean_p**2, smooth(target**2) - mean_t**2
    covariance = smooth(predicted * target) - mean_p * mean_t
    ssim = (2 * mean_p * mean_t + 4) * (2 * covariance + 36)
    ssim = (ssim / ((mean_p**2 + mean_t**2 + 4) * (var_p + var_t + 36))).mean()
    gradient = (slopes(predicted) - slopes(target)).abs().mean((0, 2, 3)).sum()
    cosine = functional.cosine_similarity(normals(predicted), normals(target), dim=1)
    squared = functional.mse_loss(predicted, target)
    return squared + 10 * (1 - ssim) + 0.01 * gradient + (1 - cosine).abs().mean()


class Task:
    """What the engine wants of a task; notes the clocks each time the loss is called, once a step."""

    criterion = "none"
    size: int

    def __init__(self) -> None:
        self.clocks: list[tuple[float, float]] = []

    def note(self) -> None:
        self.clocks.append((time.perf_counter(), time.process_time()))

    def evaluate(self, model: nn.Module) -> dict[str, float]:
        return {"none": 0.0}


class UNetTask(Task):
    """The released U-Net on random depths and events."""

    size = 64

    def __init__(self, fast_loss: bool) -> None:
        super().__init__()
        self.fast_loss = fast_loss
        rng = np.random.default_rng(0)
        self.prior = rng.uniform(0, 80, (self.size, 1, *SHAPE)).astype(np.float32)
        self.voxel = rng.normal(scale=2, size=(self.size, 5, *SHAPE)).round().astype(np.float32)

    def network(self) -> nn.Module:
        return UNet()

    def batch(self, indices: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
        return self.prior[indices], self.voxel[indices], self.prior[indices] + np.float32(1)

    def loss(self, model: Forward, batch: tuple[Tensor, ...]) -> tuple[Tensor, dict[str, Tensor]]:
        self.note()
        prior, voxel, target = batch
        predicted = model(prior, voxel)
        return meter_loss(predicted, target) if self.fast_loss else (released_loss(predicted, target), {})


class KeyframeTask(Task):
    """The paper's keyframe CNN on random event frames; its loss has nothing to make faster."""

    size = 512

    def __init__(self, fast_loss: bool) -> None:
        super().__init__()
        rng = np.random.default_rng(0)
        self.frames = rng.normal(size=(self.size, 1, *SHAPE)).round().astype(np.float32)
        self.labels = rng.integers(0, 2, self.size).astype(np.float32)

    def network(self) -> nn.Module:
        return FrameDetector(*SHAPE, pool=1, inputs="raw")

    def batch(self, indices: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
        return self.frames[indices], self.labels[indices]

    def loss(self, model: Forward, batch: tuple[Tensor, ...]) -> tuple[Tensor, dict[str, Tensor]]:
        self.note()
        frames, labels = batch
        return functional.binary_cross_entropy_with_logits(model(frames)[:, 0, 0], labels), {}


@dataclass(frozen=True)
class Row:
    """One row of the table."""

    network: str
    name: str
    batch: int
    threads: int

    def task(self) -> UNetTask | KeyframeTask:
        """What it trains."""
        fast = self.name == ENGINE or LADDER[self.name].fast_loss
        return UNetTask(fast) if self.network == "U-Net" else KeyframeTask(fast)


def plain_loop(row: Row, task: UNetTask | KeyframeTask, network: nn.Module, steps: int) -> None:
    """The loop as it is commonly written, with the changes of the row."""
    loop = LADDER[row.name]
    if loop.keep_memory:
        keep_large_blocks()
    layout = torch.channels_last if loop.channels_last else torch.contiguous_format
    for parameter in network.parameters():
        if parameter.dim() == 4:
            parameter.data = parameter.data.to(memory_format=layout)
    optimiser = torch.optim.NAdam(network.parameters(), lr=1e-3, weight_decay=1e-4)

    def model(*inputs: Tensor) -> Tensor:
        with torch.autocast("cpu", torch.bfloat16, enabled=loop.bf16):
            return network(*inputs).float()

    rng = np.random.default_rng(0)
    for _ in range(steps):
        arrays = task.batch(rng.integers(0, task.size, row.batch), rng)
        batch = tuple(torch.from_numpy(array) for array in arrays)
        batch = tuple(x.to(memory_format=layout) if x.dim() == 4 else x for x in batch)
        optimiser.zero_grad(set_to_none=True)
        loss, _ = task.loss(model, batch)
        loss.backward()
        optimiser.step()
        loss.item()


def engine(row: Row, task: UNetTask | KeyframeTask, network: nn.Module, steps: int) -> None:
    """The project's own loop, as the training scripts use it."""
    options = TrainingOptions(
        steps=steps, batch_size=row.batch, optimiser="nadam", threads=row.threads, device="cpu"
    )
    with tempfile.TemporaryDirectory() as folder:
        card = Card("a benchmark", row.network)
        train(network, task, options, Path(folder), card, tensorboard=False, quiet=True)


def serve(row: Row, steps: int, connection: Connection) -> None:
    """In a process of its own: whenever asked, train and answer with the seconds of a step on both clocks."""
    torch.set_num_threads(row.threads)
    run = engine if row.name == ENGINE else plain_loop
    while connection.recv():
        task = row.task()
        run(row, task, task.network(), steps + 2)
        begin, end = task.clocks[1], task.clocks[-1]
        connection.send([(e - b) / steps for b, e in zip(begin, end, strict=True)])


def measure(rows: list[Row], args: Args) -> np.ndarray:
    """Samples per second of time and of processor time, ``(rows, turns, 2)``."""
    context = multiprocessing.get_context("spawn")
    pipes, processes = [], []
    for row in rows:
        mine, theirs = context.Pipe()
        process = context.Process(target=serve, args=(row, args.steps, theirs), daemon=True)
        process.start()
        pipes.append(mine)
        processes.append(process)
    rates = np.empty((len(rows), args.turns, 2))
    for turn in range(-1, args.turns):  # the first warms up
        for i, (row, pipe) in enumerate(zip(rows, pipes, strict=True)):
            pipe.send(True)
            seconds = pipe.recv()
            if turn >= 0:
                rates[i, turn] = row.batch / np.array(seconds)
    for pipe, process in zip(pipes, processes, strict=True):
        pipe.send(False)
        process.join()
    return rates


def summarise(rows: list[Row], rates: np.ndarray) -> list[dict[str, Any]]:
    """Medians over turns, JSON-ready; ratios are taken within a turn."""
    base = {row.network: i for i, row in enumerate(rows) if row.name == "released loop"}
    summary = []
    for i, row in enumerate(rows):
        ratios = rates[i] / rates[base[row.network]]
        summary.append(
            {
                "network": row.network,
                "row": row.name,
                "batch": row.batch,
                "samples_per_s": median(rates[i, :, 0]),
                "samples_per_processor_s": median(rates[i, :, 1]),
                "ratio": median(ratios[:, 0]),
                "processor_ratio": median(ratios[:, 1]),
            }
        )
    return summary


def table(summary: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = [
        "| network | loop | samples/s | against released | per processor second | against released |",
        "|---|---|--:|--:|--:|--:|",
    ]
    for row in summary:
        lines.append(
            f"| {row['network']}, batch {row['batch']} | {row['row']} "
            f"| {row['samples_per_s']:.1f} | {row['ratio']:.2f}x "
            f"| {row['samples_per_processor_s']:.1f} | {row['processor_ratio']:.2f}x |"
        )
    return "\n".join(lines)


def main(args: Args) -> None:
    """Measure, print JSON, and write the document."""
    if args.markdown is not None:
        check_document(args.markdown, "results")
    os.environ["OMP_NUM_THREADS"] = str(args.threads)
    batches = {"U-Net": args.unet_batch, "keyframe CNN": args.keyframe_batch}
    rows = [
        Row(network, name, batches[network], args.threads)
        for network, names in NETWORKS.items()
        for name in names
    ]
    summary = summarise(rows, measure(rows, args))
    machine = {
        "cores": os.cpu_count(),
        "threads": args.threads,
        "bf16": uses_bf16("auto", torch.device("cpu")),
        "torch": torch.__version__,
        "python": platform.python_version(),
    }
    print(json.dumps({"machine": machine, "shape": SHAPE, "rows": summary}, indent=2))
    if args.markdown is not None:
        note = (
            f"120x160, {args.threads} threads on {machine['cores']} cores, "
            f"PyTorch {machine['torch']}, {args.turns} turns of {args.steps} steps."
        )
        update_document(args.markdown, "results", f"{note}\n\n{table(summary)}")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
