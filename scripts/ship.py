"""Ship the best training of every learned trigger policy, with what the frontier measured on its card.

The trainings are those of scripts/train_value.py and scripts/train_rl.py; validation drives choose among
their seeds. The figures of the test drives come from scripts/frontier.py, in which all seeds must have taken
part.
"""

from __future__ import annotations

import json
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # runs from a checkout, wherever the command is started

import tyro

from nl_env.command_line import run_command
from nl_env.config import choice, number
from nl_env.depth.extrapolators import WEIGHTS
from nl_env.runs import SETTINGS_FILE
from nl_env.trace_source import file_digest
from nl_env.weight_files import Card, card_path, read_card, read_tensors, write_weights

MAX_BYTES = 4_000_000
"""Of one shipped file of weights."""


@dataclass(frozen=True)
class Trained:
    """The trainings of one learned family of trigger policies.

    Attributes:
        family: as ``agents.catalogue`` names it; also the name of the shipped weights.
        train: script and arguments of a training, without its seed.
        folder: of a training, without its seed.
        file: what it leaves there.
        criterion: where on a card the number is by which the best seed is chosen, the lower the better.
        row: the number with which the frontier's tables show it.
    """

    family: str
    train: tuple[str, ...]
    folder: str
    file: str
    criterion: tuple[str, ...]
    row: str

    def weights(self, runs: Path, seed: int) -> Path:
        """The weights of one training."""
        return runs / f"{self.folder}-{seed}" / self.file


def _value(objective: str, row: str) -> Trained:
    train = ("scripts/train_value.py", "--objective", objective)
    family = f"value-{objective}"
    return Trained(family, train, family, "value.safetensors", ("validation_excess_log_mae",), row)


POLICIES = (
    _value("reduction", "0.005"),
    _value("advantage", "0.3"),
    _value("clone", "0.3"),
    _value("planned", "0.3"),
    Trained(
        "rl",
        ("scripts/train_rl.py", "qrdqn-statistics"),
        "rl-qrdqn-statistics",
        "best.safetensors",
        ("validation", "regret"),
        "0.3",
    ),
)
FAMILIES = tuple(policy.family for policy in POLICIES)


@dataclass(frozen=True)
class Options:
    """Ship the best training of every learned trigger policy."""

    runs: Path = Path("runs")
    """Where the trainings are: value-OBJECTIVE-SEED/ and rl-qrdqn-statistics-SEED/."""
    frontier: Path = Path("runs/frontier")
    """Output folder of scripts/frontier.py."""
    weights: Path = WEIGHTS
    """Where to ship to."""
    seeds: int = 3
    """Trainings of each policy: seeds from 0 on."""
    families: tuple[str, ...] = FAMILIES
    """Which policies to ship."""

    def validate(self) -> None:
        """Raise ``ValueError`` naming the option, what was found and what was expected."""
        number("seeds", self.seeds, 1, 100)
        for family in self.families:
            choice("families", family, FAMILIES)


def ship_policies(options: Options) -> list[Path]:
    """Ship every family; all are looked at before the first is written. Returns the files.

    Raises:
        FileNotFoundError: a training, its card or the frontier is missing.
        ValueError: bad options, a training that did not take part in the frontier or was repeated since,
            or weights too large to ship.
    """
    options.validate()
    results = json.loads((options.frontier / "results.json").read_text(encoding="utf-8"))
    settings = json.loads((options.frontier / SETTINGS_FILE).read_text(encoding="utf-8"))
    measured = {(ROOT / path).resolve(): digest for path, digest in settings["weights"].items()}
    chosen = []
    for policy in POLICIES:
        if policy.family not in options.families:
            continue
        trainings = [policy.weights(options.runs, seed) for seed in range(options.seeds)]
        for path in trainings:
            _check_measured(path, measured, options.frontier)
        best = best_of(trainings, policy.criterion)
        chosen.append((policy, best, frontier_figures(results, policy.family)))
    options.weights.mkdir(parents=True, exist_ok=True)
    targets = []
    for policy, best, figures in chosen:
        targets.append(options.weights / f"{policy.family}.safetensors")
        ship_weights(best, targets[-1], figures)
    return targets


def _check_measured(path: Path, measured: Mapping[Path, str], frontier: Path) -> None:
    if not path.is_file():
        raise FileNotFoundError(f"weights: found no file {str(path)!r}; train it first")
    if path.resolve() not in measured:
        raise ValueError(f"frontier: found no {path} among the policies of {frontier}, expected all seeds")
    if measured[path.resolve()] != file_digest(path):
        raise ValueError(f"frontier: {path} changed after {frontier} was drawn; draw it again")


def best_of(trainings: Sequence[Path], criterion: Sequence[str]) -> Path:
    """The weights with the lowest number on their card; the first of equal ones.

    Raises:
        ValueError: a card without that number.
    """

    def judged(path: Path) -> float:
        found: Any = _card(path).metrics
        for name in criterion:
            found = found.get(name) if isinstance(found, dict) else None
        if not isinstance(found, (int, float)):
            raise ValueError(
                f"card: found {found!r} for {'.'.join(criterion)} beside {path}, expected a number"
            )
        return found

    return min(trainings, key=judged)


def frontier_figures(results: Mapping[str, Any], family: str) -> dict[str, Any]:
    """What a card says of the test drives; ``results`` are those of ``scripts/frontier.py``.

    Raises:
        ValueError: the family has no curve in them.
    """
    settings = results["settings"]
    curve = next((curve for curve in results["frontier"] or () if curve["family"] == family), None)
    if curve is None:
        raise ValueError(f"frontier: found no curve of {family!r} in its results, expected one")
    error = results["deciding_metric"]
    command = ["python", "scripts/frontier.py", "--policies", *settings["policies"]]
    command += ["--every", str(settings["every"]), "--seed", str(settings["seed"])]
    if settings["sequences"] is not None:
        command += ["--sequences", str(settings["sequences"])]
    return {
        "command": shlex.join(command),
        "data": settings["data"],
        "figures": {
            **{name: curve[name] for name in ("runs", "regret", "regret_low", "regret_high")},
            "matched": [{"rate": point["rate"], error: point["error"]} for point in curve["matched"]],
        },
        "note": f"means over {curve['runs']} trainings, intervals over {len(results['sequences'])} sequences",
    }


def ship_weights(source: Path, target: Path, measured: Mapping[str, Any]) -> None:
    """Copy weights, with what was measured on the test split on their card.

    Raises:
        FileNotFoundError: no weights, or no card beside them.
        ValueError: weights too large to ship, or not those of their card.
    """
    if source.stat().st_size > MAX_BYTES:
        raise ValueError(
            f"weights: found {source.stat().st_size} bytes in {source}, expected at most {MAX_BYTES}"
        )
    card = _card(source)
    card = replace(card, metrics={**card.metrics, "test": dict(measured)})
    write_weights(target, read_tensors(source), Card(**from_checkout(asdict(card))))
    print(f"shipped: {source} as {target} ({target.stat().st_size / 1e6:.2f} MB)")


def _card(weights: Path) -> Card:
    card = read_card(weights)
    if card is None:
        raise FileNotFoundError(f"card: found no {card_path(weights)}")
    return card


def from_checkout(value: Any) -> Any:
    """JSON-ready ``value`` with every path inside the checkout relative to it."""
    if isinstance(value, dict):
        return {key: from_checkout(item) for key, item in value.items()}
    if isinstance(value, list):
        return [from_checkout(item) for item in value]
    return value.replace(f"{ROOT}{os.sep}", "") if isinstance(value, str) else value


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""

    def work(given: list[str]) -> None:
        ship_policies(tyro.cli(Options, args=given, description=__doc__))

    return run_command("ship", work, arguments)


if __name__ == "__main__":
    sys.exit(main())
