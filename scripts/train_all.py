"""Remake the shipped weights from nothing: record, train every seed, measure, ship, trigger policies last.

Extrapolators and detectors come first. All drives are then stored as traces with the shipped extrapolator,
and on those the trigger policies are trained, compared and shipped. Every step is one command of this
repository. Finished steps are not repeated, and an interrupted one goes on where it was, so starting this
command again continues it.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # runs from a checkout, wherever the command is started

import tyro

from agents.catalogue import parse_policy
from nl_env.command_line import run_command
from nl_env.config import choice, number
from nl_env.depth.extrapolators import WEIGHTS
from nl_env.steps import Runner, Step
from nl_env.trace_files import default_folder
from scripts import ship as shipping
from scripts.frontier import ROWS
from scripts.ship import POLICIES, Trained, ship_policies, ship_weights

STAGES = (
    "record",
    "pairs",
    "train",
    "ablations",
    "tables",
    "ship",
    "precompute",
    "policies",
    "frontier",
    "ship-policies",
)
"""In order. The steps of one of PARALLEL do not depend on each other."""
PARALLEL = ("train", "ablations", "policies")

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


@dataclass(frozen=True)
class Options:
    """Remake the shipped weights from nothing."""

    out: Path = Path("runs")
    """Recordings (data/), trainings (unet-0/ ...), tables (table-rates/ ...), logs (train-all/) go here."""
    weights: Path = WEIGHTS
    """Where the weights are shipped to."""
    stages: tuple[str, ...] = tuple(stage for stage in STAGES if stage != "ablations")
    """Which to do of record, pairs, train, ablations, tables, ship, precompute, policies, frontier,
    ship-policies; table-ablation is a part of ablations."""
    seeds: int = 3
    """Training seeds of each network. The first one is shipped, of trigger policies the best on validation
    drives; the others tell how much training varies."""
    train_sequences: int = 128
    """Training sequences, 10 s each."""
    val_sequences: int = 16
    """Validation sequences, 10 s each."""
    more_train_sequences: int = 160
    """Further training sequences, 10 s each, for the detector with a memory."""
    more_val_sequences: int = 16
    """Further validation sequences, 10 s each, for the same."""
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
        more: it learns from further sequences, too.
    """

    name: str
    train: tuple[str, ...]
    file: str
    seed_options: tuple[str, ...]
    device_options: tuple[str, ...]
    table: str
    row: str
    more: bool = False


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
        more=True,
    ),
)


class Plan:
    """The steps of every stage, for the given options."""

    def __init__(self, options: Options) -> None:
        self.options = options
        self.data = {split: options.out / "data" / split for split in ("train", "val", "test")}
        self.more = {split: options.out / "data" / f"{split}-more" for split in ("train", "val")}

    def steps(self, stage: str) -> list[Step]:
        """The commands of one stage, in order."""
        options = self.options
        if stage == "record":
            return [
                self._record("train", options.train_sequences, 10),
                self._record("val", options.val_sequences, 10),
                self._record("test", options.test_sequences, 20),
                self._record_more("train", options.train_sequences, options.more_train_sequences),
                self._record_more("val", options.val_sequences, options.more_val_sequences),
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
        if stage == "precompute":
            return [self._precompute(split) for split in self.data]
        if stage == "policies":
            return [self._train_policy(policy, seed) for seed in range(options.seeds) for policy in POLICIES]
        if stage == "frontier":
            return [self._frontier()]
        return []

    def trained(self, network: Network, seed: int) -> Path:
        """The weights that a training leaves."""
        return self.options.out / f"{network.name}-{seed}" / network.file

    def results(self, table: str) -> Path:
        """What a table leaves."""
        return self.options.out / table / "results.json"

    @property
    def frontier(self) -> Path:
        """Where the frontier is drawn."""
        return self.options.out / "frontier"

    def _record(self, split: str, sequences: int, seconds: int) -> Step:
        command = f"scripts/record.py --split {split} --sequences {sequences} --duration {seconds}"
        more = ("--depth-period-ms", "10", "--workers", str(self.options.jobs), "--resume")
        return Step(f"record-{split}", (*command.split(), "--out", str(self.data[split]), *more))

    def _record_more(self, split: str, start: int, sequences: int) -> Step:
        command = f"scripts/record.py --split {split} --start {start} --sequences {sequences} --duration 10"
        more = ("--workers", str(self.options.jobs), "--resume", "--out", str(self.more[split]))
        return Step(f"record-{split}-more", (*command.split(), *more))

    def _pair_options(self) -> tuple[str, ...]:
        folders = {"data": self.data["train"], "validation": self.data["val"]}
        folders["pairs"] = self.options.out / "pairs"
        given = [part for name, path in folders.items() for part in (f"--{name}", str(path))]
        return (*given, "--workers", str(self.options.jobs))

    def _train(self, network: Network, seed: int) -> Step:
        data: tuple[str, ...] = self._pair_options()
        if network.train[0] == KEYFRAME:
            parts = (self.data, self.more) if network.more else (self.data,)
            training, validation = ([str(part[split]) for part in parts] for split in ("train", "val"))
            data = ("--data", *training, "--validation", *validation)
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
        test = ["--data", str(self.data["test"])]
        detectors = ["--weights", *frames, "--temporal-weights", *temporal]
        tables = {
            "table-keyframe": [
                *test,
                *("--train", str(self.data["train"]), "--train-sequences", str(shown)),
                *detectors,
            ],
            "table-weather": ["--worlds", str(min(self.options.test_sequences, 24)), *detectors],
            "table-rates": [*test, "--weights", *ours, "--paper-weights", *paper],
            "table-end-to-end": [
                *test,
                *("--weights", ours[0], "--paper-weights", paper[0]),
                *("--keyframe-weights", frames[0], "--temporal-weights", temporal[0]),
            ],
        }
        if "ablations" in self.options.stages:
            trained = [str(self.options.out / name / NETWORKS[0].file) for name in ABLATIONS]
            variants = [*paper, *ours, *trained]
            tables["table-ablation"] = [*test, "--variants", *variants, "--weights", *ours]
        common = ["--workers", str(self.options.jobs), "--resume"]
        return [
            Step(name, ("scripts/reproduce.py", name, *given, *common, "--out", str(self.options.out / name)))
            for name, given in tables.items()
        ]

    @property
    def _extrapolator(self) -> str:
        """That of the traces; their folders have its name, and sources tell it by its content."""
        return str(self.options.weights / "unet.safetensors")

    def _traces(self, split: str) -> str:
        return str(placed(default_folder(ROOT / self.data[split], self._extrapolator)))

    def _precompute(self, split: str) -> Step:
        given = ("--data", str(self.data[split]), "--extrapolator", self._extrapolator)
        more = ("--workers", str(self.options.jobs), "--out", self._traces(split), "--resume")
        return Step(f"precompute-{split}", ("scripts/precompute.py", *given, *more))

    def _train_policy(self, policy: Trained, seed: int) -> Step:
        out = str(policy.weights(self.options.out, seed).parent)
        if policy.family == "rl":
            folders = {"recordings": str(self.data["train"]), "validation": str(self.data["val"])}
            more = ["--extrapolator", self._extrapolator, "--resume"]
        else:
            folders = {"data": self._traces("train"), "validation": self._traces("val")}
            more = ["--overwrite"]  # it takes a minute, and writes at its end
        given = [part for name, path in folders.items() for part in (f"--{name}", path)]
        command = (*policy.train, "--seed", str(seed), *given, *more, "--out", out)
        return Step(f"train-{policy.family}-{seed}", command)

    def _frontier(self) -> Step:
        names: list[str] = []
        learned = {policy.family: policy for policy in POLICIES}
        for row in ROWS:
            policy = learned.get(parse_policy(row).family)
            if policy is None:
                names.append(row)
                continue
            seeds = range(self.options.seeds)
            trained = (policy.weights(self.options.out, seed) for seed in seeds)
            names += [f"{policy.family}@{path}:{policy.row}" for path in trained]
        given = ("--policies", *names, "--every", "2", "--data", self._traces("test"))
        more = ("--player", str(self.data["test"]), "--workers", str(self.options.jobs), "--resume")
        return Step("frontier", ("scripts/frontier.py", *given, *more, "--out", str(self.frontier)))


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
        table = json.loads((ROOT / plan.results(network.table)).read_text(encoding="utf-8"))
        source = ROOT / plan.trained(network, 0)
        ship_weights(source, folder / f"{network.name}.safetensors", measured(table, network))


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
        plan, runner = Plan(options), Runner(ROOT / options.out / "train-all", ROOT)
        for stage in STAGES:
            if stage not in options.stages:
                continue
            # The others use all cores by themselves.
            runner.run(plan.steps(stage), options.jobs if stage in PARALLEL else 1)
            if stage == "ship":
                ship(plan)
            if stage == "ship-policies":
                runs, weights = ROOT / options.out, ROOT / options.weights
                ship_policies(shipping.Options(runs, ROOT / plan.frontier, weights, options.seeds))

    kept = "finished steps are kept"
    return run_command("train_all", work, arguments, kept=kept, again="", errors=(RuntimeError,))


if __name__ == "__main__":
    sys.exit(main())
