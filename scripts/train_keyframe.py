"""Train a keyframe detector on recordings, calibrate its thresholds, and write its weights with a card.

python scripts/train_keyframe.py RECIPE, one of

  cnn       the paper's network on polarity-split event frames, our recipe
  temporal  the detector with a memory of past frames
  paper     the paper's network and recipe as released

Recordings come from scripts/record.py. Killed at any time, the same command with --resume goes on.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # agents/ is used from the checkout, wherever the command is started

import numpy as np
import tyro
from torch import nn
from tqdm import tqdm

import nl_env
from agents.keyframe_data import Slices, build_slices
from agents.keyframe_networks import ARCHITECTURES, Detector, Perception, Recall, TemporalDetector
from agents.keyframe_training import (
    KeyframeTask,
    PerceptionTask,
    RecallTask,
    SampleOptions,
    calibrate,
    detect,
)
from nl_env.classification import summarise_detector
from nl_env.evaluation import resample_sequences
from nl_env.training import Task, TrainingOptions, seeded, train
from nl_env.training.run import BEST
from nl_env.weight_files import Card, load_network, load_strictly, read_tensors, write_card, write_weights

MEMORY_SAMPLING = SampleOptions(window=250, stride=25, new_weight=1.0)
MEMORY_TRAINING = TrainingOptions(
    steps=300,
    batch_size=16,
    learning_rate=3e-3,
    weight_decay=0.02,
    warmup_steps=20,
    clip_gradient=1.0,
    ema=0.99,
    evaluate_every=50,
    amp="off",
    threads=1,
)


@dataclass(frozen=True)
class Options:
    """Train a keyframe detector."""

    architecture: tyro.conf.Fixed[str]
    """keyframe-cnn or keyframe-cnn-temporal."""
    network: tyro.conf.Fixed[dict[str, Any]]
    """Arguments of the network besides the size of its frames, which is the recordings'."""
    sampling: SampleOptions
    """Which slices are learnt from."""
    training: TrainingOptions
    """How; of a detector with a memory, how its first half learns to see."""
    memory_sampling: SampleOptions = MEMORY_SAMPLING
    """Which windows of slices its second half learns from."""
    memory_training: TrainingOptions = MEMORY_TRAINING
    """How its second half learns to remember."""
    recordings: Path = Path("runs/data/train")
    """Recordings to learn from."""
    validation: Path = Path("runs/data/val")
    """Recordings that choose the best weights and the thresholds."""
    workers: int = 1
    """Processes that cut slices out of the recordings, once."""
    out: Path = Path("runs/keyframe")
    """Output folder: best.safetensors and its card best.json, last.safetensors, log."""
    overwrite: bool = False
    """Replace the run that is in the output folder."""
    resume: bool = False
    """Continue the run that is in the output folder."""


RECIPES: dict[str, tuple[str, Options]] = {
    "cnn": (
        "The paper's network on polarity-split event frames, our recipe.",
        Options(
            architecture="keyframe-cnn",
            network={"pool": 2, "inputs": "polarity"},
            sampling=SampleOptions(),
            training=TrainingOptions(
                steps=2400,
                batch_size=64,
                learning_rate=2e-3,
                weight_decay=0.01,
                optimiser="adamw",
                warmup_steps=100,
                clip_gradient=1.0,
                ema=0.995,
                evaluate_every=300,
                threads=1,
            ),
            out=Path("runs/keyframe-cnn"),
        ),
    ),
    "temporal": (
        "The detector with a memory of past frames.",
        Options(
            architecture="keyframe-cnn-temporal",
            network={},
            sampling=SampleOptions(),
            training=TrainingOptions(
                steps=3000,
                batch_size=64,
                learning_rate=3e-3,
                weight_decay=0.02,
                warmup_steps=100,
                clip_gradient=1.0,
                ema=0.995,
                evaluate_every=300,
                threads=1,
            ),
            out=Path("runs/keyframe-cnn-temporal"),
        ),
    ),
    "paper": (
        "The paper's network and recipe as released: signed sums, no augmentation, NAdam at a constant rate.",
        Options(
            architecture="keyframe-cnn",
            network={"pool": 1, "inputs": "raw"},
            sampling=SampleOptions(stride=3, new_weight=1.0, flip=False, invert=False, noise=0.0),
            training=TrainingOptions(
                epochs=20,
                batch_size=64,
                learning_rate=1e-4,
                weight_decay=0.01,
                optimiser="nadam",
                schedule="constant",
                clip_gradient=1.0,
                evaluate_every=500,
                amp="off",
                threads=1,
            ),
            out=Path("runs/keyframe-cnn-paper"),
        ),
    ),
}


def slices_of(recordings: Path, workers: int) -> Slices:
    """The slices of a folder of recordings, cut into a folder beside it where they are missing."""
    folder = recordings.with_name(recordings.name + "-slices")
    with tqdm(desc=f"slices of {recordings.name}", unit="sequence", disable=None) as bar:
        return build_slices(recordings, folder, workers=workers, progress=bar.update)


def run(options: Options) -> Card:
    """Train, calibrate, and complete the card beside the weights."""
    training = slices_of(options.recordings, options.workers)
    validation = slices_of(options.validation, options.workers)
    height, width = training.shape
    arguments = {"height": height, "width": width, **options.network}
    card = Card(
        what="Trigger policy: probability that a 20 ms event frame is a keyframe",
        architecture=options.architecture,
        options=arguments,
        data={"training": described(training), "validation": described(validation)},
        training={
            "command": shlex.join(["python", "scripts/train_keyframe.py", *sys.argv[1:]]),
            "sampling": asdict(options.sampling),
            "nl_env": nl_env.__version__,
        },
    )
    with seeded(options.training.seed):
        network = ARCHITECTURES[options.architecture](**arguments)
    if isinstance(network, TemporalDetector):
        return train_temporal(network, training, validation, options, card)
    task = KeyframeTask(training, validation, options.sampling)
    result = train(
        network, task, options.training, options.out, card, resume=options.resume, overwrite=options.overwrite
    )
    return calibrated(result.weights, validation, options.training.threads)


def train_temporal(
    network: TemporalDetector, training: Slices, validation: Slices, options: Options, card: Card
) -> Card:
    """Train the two halves one after the other, in folders of their own, and put them together."""
    halves: tuple[tuple[str, nn.Module], ...] = (
        ("perception", Perception(network)),
        ("recall", Recall(network)),
    )
    cards = {}
    for name, half in halves:
        task: Task
        if name == "perception":
            task = PerceptionTask(training, validation, options.sampling)
            how = options.training
        else:
            task = RecallTask(network, training, validation, options.memory_sampling)
            how = options.memory_training
        part = replace(card, architecture=f"{options.architecture}/{name}")
        result = train(
            half, task, how, options.out / name, part, resume=options.resume, overwrite=options.overwrite
        )
        load_strictly(half, read_tensors(result.weights), result.weights)
        cards[name] = result.card
    whole = replace(
        card,
        training={**card.training, **{name: made.training for name, made in cards.items()}},
        metrics={name: made.metrics for name, made in cards.items()},
    )
    weights = options.out / BEST
    write_weights(weights, network.state_dict(), whole)
    return calibrated(weights, validation, options.training.threads)


def calibrated(weights: Path, validation: Slices, threads: int) -> Card:
    """Choose thresholds on the validation sequences and add them and what they reach to the card."""
    network, card = load_network(weights, ARCHITECTURES)
    assert isinstance(network, Detector)
    detections = detect(network, validation, threads)
    thresholds = calibrate(detections)
    resamples = resample_sequences(len(detections), np.random.default_rng(0))
    summaries = {
        name: asdict(summarise_detector(detections, threshold, resamples))
        for name, threshold in thresholds.items()
        if name != "default"  # one of the others
    }
    metrics = {**card.metrics, "thresholds": thresholds, "at_thresholds": summaries}
    card = replace(card, metrics=metrics)
    write_card(weights, card)
    return card


def described(data: Slices) -> dict[str, Any]:
    """What a card says of the data."""
    identity = data.identity
    return {
        "split": identity["split"],
        "sequences": len(data),
        "slices": data.length,
        "first_seed": data.seeds[0],
        "manifest_sha256": identity["manifest_sha256"],
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        options = tyro.extras.overridable_config_cli(RECIPES, args=arguments, description=__doc__)
        card = run(options)
    except (ValueError, OSError, FloatingPointError) as error:
        print(f"train_keyframe: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        again = [argument for argument in arguments if argument not in ("--overwrite", "--resume")]
        command = shlex.join(["python", "scripts/train_keyframe.py", *again, "--resume"])
        print(f"\ninterrupted; the last checkpoint is kept. Continue with: {command}", file=sys.stderr)
        return 130
    print_result(options, card)
    return 0


def print_result(options: Options, card: Card) -> None:
    """What was reached on the validation sequences."""
    for name, at in card.metrics["at_thresholds"].items():
        print(
            f"{name}: threshold {at['threshold']:.3f}, F1 {at['f1']['mean']:.3f} "
            f"(always {at['always_f1']['mean']:.3f}), "
            f"balanced accuracy {at['balanced_accuracy']['mean']:.3f}, "
            f"AUROC {at['auroc']['mean']:.3f}, rate {at['rate']['mean']:.1f} Hz"
        )
    print(f"weights: {options.out / 'best.safetensors'}")


if __name__ == "__main__":
    sys.exit(main())
