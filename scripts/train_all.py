"""Remake the shipped weights from nothing: record, train every seed, measure the tables, ship.

Every step is one command of this repository. Finished steps are not repeated, and an interrupted one goes on
where it was, so starting this command again continues it.
"""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # runs from a checkout, wherever the command is started

import tyro

from nl_env.command_line import run_command
from nl_env.config import choice, number
from nl_env.depth.extrapolators import WEIGHTS
from nl_env.runs import THREAD_VARIABLES, write_text
from nl_env.weight_files import Card, card_path, read_card, read_tensors, write_weights

STAGES = ("record", "pairs", "train", "ablations", "tables", "ship")
"""In order. The steps of "train" and "ablations" do not depend on each other."""

ABLATIONS = {
    "ours-motion-network": "ours --estimate",
    "ours-warp-only": "ours --parts motion",
    "ours-refine-only": "ours --parts refine",
    "ours-no-events": "ours --no-events",
    "ours-true-motion": "ours --odometry",
    "ours-one-head": "ours --heads 1",
    "paper-text": "paper --variant paper",
    "paper-loss": "paper --loss.weights paper",
    "paper-without-events": "paper --variant without-events",
    "paper-event-frame": "paper --variant event-frame",
    "paper-data-concat": "paper --variant data-concat",
    "paper-without-skip": "paper --variant without-skip",
}
"""Trained variants of the ablation table: arguments of scripts/train_extrapolator.py."""

MAX_BYTES = 4_000_000
"""Of one shipped file of weights."""


@dataclass(frozen=True)
class Options:
    """Remake the shipped weights from nothing."""

    out: Path = Path("runs")
    """Recordings (data/), trainings (unet-0/ ...), tables (table-rates/ ...), logs (train-all/) go here."""
    weights: Path = WEIGHTS
    """Where the weights are shipped to."""
    stages: tuple[str, ...] = ("record", "pairs", "train", "tables", "ship")
    """Which of record, pairs, train, ablations, tables, ship to do; table-ablation is a part of ablations."""
    seeds: int = 3
    """Training seeds of each network; the first is shipped, the others tell how much training varies."""
    train_sequences: int = 128
    """Training sequences, 10 s each."""
    val_sequences: int = 16
    """Validation sequences, 10 s each."""
    test_sequences: int = 48
    """Test sequences, 20 s each."""
    jobs: int = 2
    """Trainings at a time, one thread each; also the worker processes of everything else."""
    device: str = "auto"
    """Where to train: auto, cpu or cuda."""

    def validate(self) -> None:
        """Raise ``ValueError`` naming the option, what was found and what was expected."""
        for stage in self.stages:
            choice("stages", stage, STAGES)
        number("seeds", self.seeds, 1, 100)
        number("jobs", self.jobs, 1, 1024)
        choice("device", self.device, ("auto", "cpu", "cuda"))


@dataclass(frozen=True)
class Step:
    """One command.

    Attributes:
        name: of its log and of its record.
        command: script and arguments.
    """

    name: str
    command: tuple[str, ...]


@dataclass(frozen=True)
class Network:
    """One shipped network.

    Attributes:
        name: of its weights.
        train: arguments of its training.
        file: what the training leaves in its folder.
        seed_options: how the training is told its seed.
        device_options: how it is told its device.
        table: where it is measured.
        row: its row there.
    """

    name: str
    train: tuple[str, ...]
    file: str
    seed_options: tuple[str, ...]
    device_options: tuple[str, ...]
    table: str
    row: str


EXTRAPOLATOR, KEYFRAME = "scripts/train_extrapolator.py", "scripts/train_keyframe.py"
NETWORKS = (
    Network(
        "unet",
        (EXTRAPOLATOR, "ours"),
        "extrapolator.safetensors",
        ("--seed",),
        ("--motion.device", "--refine.device"),
        "table-rates",
        "ours",
    ),
    Network(
        "unet-paper",
        (EXTRAPOLATOR, "paper"),
        "extrapolator.safetensors",
        ("--seed",),
        ("--training.device",),
        "table-rates",
        "paper's network",
    ),
    Network(
        "keyframe-cnn",
        (KEYFRAME, "cnn"),
        "best.safetensors",
        ("--training.seed",),
        ("--training.device",),
        "table-keyframe",
        "keyframe-cnn",
    ),
    Network(
        "keyframe-cnn-temporal",
        (KEYFRAME, "temporal"),
        "best.safetensors",
        ("--training.seed", "--memory-training.seed"),
        ("--training.device", "--memory-training.device"),
        "table-keyframe",
        "keyframe-cnn-temporal",
    ),
)


class Plan:
    """The steps of every stage, for the given options."""

    def __init__(self, options: Options) -> None:
        self.options = options
        self.data = {split: options.out / "data" / split for split in ("train", "val", "test")}

    def steps(self, stage: str) -> list[Step]:
        """The commands of one stage, in order."""
        options = self.options
        if stage == "record":
            return [
                self._record("train", options.train_sequences, 10),
                self._record("val", options.val_sequences, 10),
                self._record("test", options.test_sequences, 20),
            ]
        if stage == "pairs":
            # The first detector's training also cuts the slices that all of them learn from.
            detector = next(network for network in NETWORKS if network.train[0] == KEYFRAME)
            pairs = Step("pairs", (EXTRAPOLATOR, "pairs", *self._pair_options()))
            return [pairs, self._train(detector, 0)]
        if stage == "train":
            return [self._train(network, seed) for seed in range(options.seeds) for network in NETWORKS]
        if stage == "ablations":
            return [self._ablation(name) for name in ABLATIONS]
        if stage == "tables":
            return self._tables()
        return []

    def trained(self, network: Network, seed: int) -> Path:
        """The weights that a training leaves."""
        return self.options.out / f"{network.name}-{seed}" / network.file

    def results(self, table: str) -> Path:
        """What a table leaves."""
        return self.options.out / table / "results.json"

    def _record(self, split: str, sequences: int, seconds: int) -> Step:
        command = f"scripts/record.py --split {split} --sequences {sequences} --duration {seconds}"
        more = ("--depth-period-ms", "10", "--workers", str(self.options.jobs), "--resume")
        return Step(f"record-{split}", (*command.split(), "--out", str(self.data[split]), *more))

    def _pair_options(self) -> tuple[str, ...]:
        folders = {"data": self.data["train"], "validation": self.data["val"]}
        folders["pairs"] = self.options.out / "pairs"
        given = [part for name, path in folders.items() for part in (f"--{name}", str(path))]
        return (*given, "--workers", str(self.options.jobs))

    def _train(self, network: Network, seed: int) -> Step:
        data: tuple[str, ...] = self._pair_options()
        if network.train[0] == KEYFRAME:
            data = ("--data", str(self.data["train"]), "--validation", str(self.data["val"]))
        device = [part for option in network.device_options for part in (option, self.options.device)]
        out = str(self.trained(network, seed).parent)
        numbered = [part for option in network.seed_options for part in (option, str(seed))]
        return Step(
            f"train-{network.name}-{seed}",
            (*network.train, *numbered, *device, *data, "--out", out, "--resume"),
        )

    def _ablation(self, name: str) -> Step:
        out = str(self.options.out / name)
        command = (EXTRAPOLATOR, *ABLATIONS[name].split(), *self._pair_options(), "--out", out, "--resume")
        return Step(f"train-{name}", command)

    def _tables(self) -> list[Step]:
        seeds = range(self.options.seeds)
        shown = min(self.options.train_sequences, self.options.test_sequences)
        ours, paper, frames, temporal = (
            [str(self.trained(network, seed)) for seed in seeds] for network in NETWORKS
        )
        tables = {
            "table-keyframe": [
                *("--train", str(self.data["train"]), "--train-sequences", str(shown)),
                *("--weights", *frames, "--temporal-weights", *temporal),
            ],
            "table-rates": ["--weights", *ours, "--paper-weights", *paper],
            "table-end-to-end": [
                *("--weights", ours[0], "--paper-weights", paper[0]),
                *("--keyframe-weights", frames[0], "--temporal-weights", temporal[0]),
            ],
        }
        if "ablations" in self.options.stages:
            trained = [str(self.options.out / name / NETWORKS[0].file) for name in ABLATIONS]
            variants = [*paper, *ours, *trained]
            tables["table-ablation"] = ["--variants", *variants, "--weights", *ours]
        common = ["--data", str(self.data["test"]), "--workers", str(self.options.jobs), "--resume"]
        return [
            Step(name, ("scripts/reproduce.py", name, *given, *common, "--out", str(self.options.out / name)))
            for name, given in tables.items()
        ]


class Runner:
    """Runs steps, keeps their logs, and remembers which are finished.

    Args:
        folder: of the logs and records.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def run(self, steps: Sequence[Step], jobs: int) -> None:
        """Run what is not finished, ``jobs`` at a time.

        Raises:
            RuntimeError: a step failed; the others of its stage are finished first.
        """
        waiting = [step for step in steps if not self.finished(step)]
        with ThreadPoolExecutor(jobs) as pool:
            running = [pool.submit(self._run, step) for step in waiting]
            try:
                failed = [step.name for step, ok in zip(waiting, running, strict=True) if not ok.result()]
            except BaseException:
                pool.shutdown(cancel_futures=True)  # an interrupt ends the commands under way by itself
                raise
        if failed:
            raise RuntimeError(f"failed: {', '.join(failed)}; see the logs in {self.folder}")

    def finished(self, step: Step) -> bool:
        """Whether exactly this command has ended well before."""
        record = self._record(step)
        return record.is_file() and json.loads(record.read_text(encoding="utf-8"))["command"] == list(
            step.command
        )

    def _record(self, step: Step) -> Path:
        return self.folder / f"{step.name}.json"

    def _run(self, step: Step) -> bool:
        print(f"{step.name}: python {shlex.join(step.command)}", flush=True)
        threads = dict.fromkeys(THREAD_VARIABLES, "1")
        began = time.monotonic()
        with open(self.folder / f"{step.name}.log", "ab") as log:
            ended = subprocess.run(
                [sys.executable, *step.command],
                cwd=ROOT,
                env={**os.environ, **threads},
                stdout=log,
                stderr=subprocess.STDOUT,
                check=False,
            )
        seconds = round(time.monotonic() - began, 1)
        if ended.returncode == 0:
            content = {"command": list(step.command), "seconds": seconds}
            write_text(self._record(step), json.dumps(content, indent=1) + "\n")
        print(f"{step.name}: exit status {ended.returncode} after {seconds} s", flush=True)
        return ended.returncode == 0


def placed(path: Path) -> Path:
    """``path`` as the steps name it, which run in the checkout: relative to it, where it lies inside."""
    path = path.resolve()
    return path.relative_to(ROOT) if path.is_relative_to(ROOT) else path


def ship(plan: Plan) -> None:
    """Copy the first seed's weights, with what the tables measured on their cards.

    Raises:
        FileNotFoundError: weights, card or table are missing.
        ValueError: weights too large to ship.
    """
    folder = ROOT / plan.options.weights
    folder.mkdir(parents=True, exist_ok=True)
    for network in NETWORKS:
        source = ROOT / plan.trained(network, 0)
        if source.stat().st_size > MAX_BYTES:
            raise ValueError(
                f"weights: found {source.stat().st_size} bytes in {source}, expected at most {MAX_BYTES}"
            )
        card = read_card(source)
        if card is None:
            raise FileNotFoundError(f"card: found no {card_path(source)}")
        table = json.loads((ROOT / plan.results(network.table)).read_text(encoding="utf-8"))
        metrics = {**card.metrics, "test": measured(table, network)}
        card = Card(**from_checkout(asdict(replace(card, metrics=metrics))))
        target = folder / f"{network.name}.safetensors"
        write_weights(target, read_tensors(source), card)
        print(f"shipped: {target} ({target.stat().st_size / 1e6:.2f} MB)")


def from_checkout(value: Any) -> Any:
    """JSON-ready ``value`` with every path inside the checkout relative to it."""
    if isinstance(value, dict):
        return {key: from_checkout(item) for key, item in value.items()}
    if isinstance(value, list):
        return [from_checkout(item) for item in value]
    return value.replace(f"{ROOT}{os.sep}", "") if isinstance(value, str) else value


def measured(table: Mapping[str, Any], network: Network) -> dict[str, Any]:
    """What a card says of the test split: means over all training seeds, with intervals over sequences."""
    figures = table["figures"]
    if network.table == "table-keyframe":
        return {"command": table["command"], "figures": figures["splits"]["test"]["rows"][network.row]}
    return {
        "command": table["command"],
        "figures": figures[network.row]["mean"],
        "note": "mean over gaps of 20, 50, 100, 200 and 500 ms; change is against Repeat",
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""

    def work(given: list[str]) -> None:
        options = tyro.cli(Options, args=given, description=__doc__)
        options.validate()
        options = replace(options, out=placed(options.out), weights=placed(options.weights))
        plan, runner = Plan(options), Runner(ROOT / options.out / "train-all")
        for stage in STAGES:
            if stage not in options.stages:
                continue
            # Recording and tables use all cores by themselves.
            runner.run(plan.steps(stage), options.jobs if stage in ("train", "ablations") else 1)
            if stage == "ship":
                ship(plan)

    kept = "finished steps are kept"
    return run_command("train_all", work, arguments, kept=kept, again="", errors=(RuntimeError,))


if __name__ == "__main__":
    sys.exit(main())
