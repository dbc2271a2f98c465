"""Train a small network that says what a trigger is worth, from stored traces, and write it with a card.

The traces come from scripts/precompute.py. A training takes a minute or two on one core; the same command
gives the same weights. docs/policies.md compares the objectives.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # agents/ is used from the checkout, wherever the command is started

import torch
import tyro

import nl_env
from agents.decisions import Decisions, collect
from agents.value_training import Trained, ValueTraining, train
from nl_env.command_line import command_line, run_command
from nl_env.config import number
from nl_env.trace_files import open_traces, read_source, trace_files
from nl_env.weight_files import Card, write_weights

WEIGHTS = "value.safetensors"
"""Name of the weights in the output folder."""


@dataclass(frozen=True)
class Options:
    """Train a small network that says what a trigger is worth."""

    training: Annotated[ValueTraining, tyro.conf.OmitArgPrefixes]
    data: Path = Path("runs/data/train-tables-unet")
    """Stored traces to learn from: a folder that scripts/precompute.py wrote."""
    validation: Path = Path("runs/data/val-tables-unet")
    """Stored traces that choose the best evaluation."""
    sequences: int | None = None
    """Only the first so many of the data."""
    out: Path | None = None
    """Output folder. Default: runs/value-OBJECTIVE-SEED."""
    overwrite: bool = False
    """Replace the training that is in the output folder."""


def run(options: Options, command: str) -> Path:
    """Train and write; returns the path of the weights."""
    training = options.training
    training.validate()
    if options.sequences is not None:
        number("sequences", options.sequences, 1, 10**6)
    out = options.out or Path("runs") / f"value-{training.objective}-{training.seed}"
    weights = out / WEIGHTS
    if weights.exists() and not options.overwrite:
        raise FileExistsError(f"out: found {weights}; choose another folder, or overwrite it")
    torch.set_num_threads(1)
    data = load(options.data, options.sequences)
    validation = load(options.validation, None)
    out.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    trained = train(data, validation, training, _report)
    write_weights(
        weights,
        trained.network.state_dict(),
        card(options, trained, data, validation, command, time.perf_counter() - start),
    )
    print(f"excess {1e5 * trained.best.excess:.1f}e-5 at step {trained.best.step}: {weights}")
    return weights


def load(folder: Path, sequences: int | None) -> Decisions:
    """Decisions of the stored traces in ``folder``."""
    seeds = list(trace_files(folder))[:sequences]
    return collect(open_traces(folder, seeds).values())


def card(
    options: Options, trained: Trained, data: Decisions, validation: Decisions, command: str, seconds: float
) -> Card:
    """What the weights are, how they were made and what they reach on the validation sequences."""
    training, network = options.training, trained.network
    return Card(
        what=f"value of a trigger from event statistics, objective {training.objective}",
        architecture="trigger-value",
        options={
            "conditioned": network.conditioned,
            "hidden": list(training.hidden),
            "unit": network.unit,
            "cost_range": list(network.cost_range),
            "error_scale": network.error_scale,
        },
        data={
            name: {
                "folder": str(folder),
                "sequences": sorted({int(seed) for seed in decisions.sequence}),
                "lidar_period": decisions.period,
                "extrapolator": _extrapolator(folder),
            }
            for name, folder, decisions in (
                ("train", options.data, data),
                ("validation", options.validation, validation),
            )
        },
        training={
            "command": command,
            **asdict(training),
            "hidden": list(training.hidden),
            "best_step": trained.best.step,
            "seconds": round(seconds, 1),
            "nl_env": nl_env.__version__,
            "torch": torch.__version__,
        },
        metrics={
            "validation_excess_log_mae": trained.best.excess,
            "history": [
                {"step": step, "loss": loss, "validation_excess_log_mae": excess}
                for step, loss, excess in trained.history
            ],
        },
    )


def _extrapolator(folder: Path) -> dict[str, str | bool]:
    """Whose errors the traces hold."""
    source = read_source(next(iter(trace_files(folder).values())))
    return {"name": source.extrapolator, "weights": source.weights, "odometry": source.odometry}


def _report(step: int, loss: float, excess: float) -> None:
    print(f"step {step}: loss {loss:.4f}, validation excess {1e5 * excess:.1f}e-5", flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""

    def work(given: list[str]) -> None:
        run(tyro.cli(Options, args=given, description=__doc__), command_line("train_value", given))

    return run_command("train_value", work, arguments)


if __name__ == "__main__":
    sys.exit(main())
