"""Train a small network that says what a trigger is worth, from stored traces, and write it with a card.

The traces come from scripts/precompute.py. A training takes a minute or two on one core; the same command
gives the same weights. With --pictures the network is a small CNN that sees event frames in place of
statistics. docs/policies.md compares the objectives.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # agents/ is used from the checkout, wherever the command is started

import torch
import tyro

import nl_env
from agents.decisions import Decisions, collect
from agents.picture_training import PictureDecisions, TrainedPictures, train_pictures
from agents.rl_training.validation import Validation
from agents.supervised import ValueTraining
from agents.value_training import Trained, train
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
    pictures: bool = False
    """A CNN on pictures of event frames, obs_mode="dict", told the trigger cost whatever the objective."""
    data: Path = Path("runs/data/train-tables-unet")
    """Stored traces to learn from: a folder that scripts/precompute.py wrote."""
    validation: Path = Path("runs/data/val-tables-unet")
    """Stored traces that choose the best evaluation."""
    sequences: int | None = None
    """Only the first so many of the data."""
    out: Path | None = None
    """Output folder. Default: runs/value-OBJECTIVE-SEED, or runs/pictures-OBJECTIVE-SEED."""
    overwrite: bool = False
    """Replace the training that is in the output folder."""


def run(options: Options, command: str) -> Path:
    """Train and write; returns the path of the weights."""
    training = options.training
    training.validate()
    if options.sequences is not None:
        number("sequences", options.sequences, 1, 10**6)
    kind = "pictures" if options.pictures else "value"
    out = options.out or Path("runs") / f"{kind}-{training.objective}-{training.seed}"
    weights = out / WEIGHTS
    if weights.exists() and not options.overwrite:
        raise FileExistsError(f"out: found {weights}; choose another folder, or overwrite it")
    torch.set_num_threads(1)
    if options.pictures:
        return run_pictures(options, weights, command)
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


def run_pictures(options: Options, weights: Path, command: str) -> Path:
    """As :func:`run`, on pictures."""
    seeds = list(trace_files(options.data))[: options.sequences]
    traces = list(open_traces(options.data, seeds).values())
    validation = Validation.of(list(open_traces(options.validation).values()))
    weights.parent.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    trained = train_pictures(PictureDecisions.of(traces), validation, options.training, _report_regret)
    seconds = time.perf_counter() - start
    write_weights(weights, trained.network.state_dict(), picture_card(options, trained, command, seconds))
    print(f"regret {trained.best.criterion:.4f} at step {trained.best_step}: {weights}")
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
        training=_facts(options, command, trained.best.step, seconds),
        metrics={
            "validation_excess_log_mae": trained.best.excess,
            "history": [
                {"step": step, "loss": loss, "validation_excess_log_mae": excess}
                for step, loss, excess in trained.history
            ],
        },
    )


def picture_card(options: Options, trained: TrainedPictures, command: str, seconds: float) -> Card:
    """As :func:`card`, of a network on pictures."""
    return Card(
        what=f"trigger policy on pictures of event frames, objective {options.training.objective}",
        architecture="trigger-network",
        options=trained.network.options,
        data={
            name: {
                "folder": str(folder),
                "sequences": list(trace_files(folder))[:count],
                "extrapolator": _extrapolator(folder),
            }
            for name, folder, count in (
                ("train", options.data, options.sequences),
                ("validation", options.validation, None),
            )
        },
        training=_facts(options, command, trained.best_step, seconds),
        metrics={
            "validation": trained.best.metrics,
            "history": [
                {"step": step, "loss": loss, "regret": regret} for step, loss, regret in trained.history
            ],
        },
    )


def _facts(options: Options, command: str, best_step: int, seconds: float) -> dict[str, Any]:
    return {
        "command": command,
        **asdict(options.training),
        "hidden": list(options.training.hidden),
        "best_step": best_step,
        "seconds": round(seconds, 1),
        "nl_env": nl_env.__version__,
        "torch": torch.__version__,
    }


def _extrapolator(folder: Path) -> dict[str, str | bool]:
    """Whose errors the traces hold."""
    source = read_source(next(iter(trace_files(folder).values())))
    return {"name": source.extrapolator, "weights": source.weights, "odometry": source.odometry}


def _report(step: int, loss: float, excess: float) -> None:
    print(f"step {step}: loss {loss:.4f}, validation excess {1e5 * excess:.1f}e-5", flush=True)


def _report_regret(step: int, loss: float, regret: float) -> None:
    print(f"step {step}: loss {loss:.4f}, validation regret {regret:.4f}", flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""

    def work(given: list[str]) -> None:
        run(tyro.cli(Options, args=given, description=__doc__), command_line("train_value", given))

    return run_command("train_value", work, arguments)


if __name__ == "__main__":
    sys.exit(main())
