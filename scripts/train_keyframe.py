"""Train a keyframe detector, calibrate its thresholds, and write its weights with a card.

python scripts/train_keyframe.py RECIPE, one of

  cnn       the paper's network on polarity-split event frames, our recipe
  temporal  the detector with a memory of past frames
  paper     the paper's network and recipe as released

Recordings come from scripts/record.py. --data may also be a folder with ELiDAR's files: "cnn" and "paper"
learn from the slicing HDF5, the second half of "temporal" from the raw sequences. Killed at any time, the
same command with --resume goes on.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # agents/ is used from the checkout, wherever the command is started

import numpy as np
import tyro
from torch import nn
from tqdm import tqdm

import nl_env
from agents.elidar_frames import open_elidar_frames, open_elidar_sequences
from agents.keyframe_cnn import TEMPORAL_WEIGHTS
from agents.keyframe_data import FrameSource, JoinedSlices, MappedSlices, build_slices
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
from nl_env.command_line import command_line, run_command
from nl_env.elidar import elidar_in
from nl_env.evaluation import resample_sequences
from nl_env.training import Task, TrainingOptions, seeded, train
from nl_env.training.run import BEST
from nl_env.weight_files import Card, load_network, load_strictly, read_tensors, write_card, write_weights

TEMPORAL = "keyframe-cnn-temporal"
MEMORY_SAMPLING = SampleOptions(window=250, stride=25, new_weight=1.0)
MEMORY_TRAINING = TrainingOptions(
    steps=1200,
    batch_size=16,
    learning_rate=3e-3,
    weight_decay=0.02,
    warmup_steps=20,
    clip_gradient=1.0,
    ema=0.99,
    evaluate_every=200,
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
    data: tuple[Path, ...] = (Path("runs/data/train"),)
    """Recordings to learn from, one folder or several, or a folder with ELiDAR's files."""
    validation: tuple[Path, ...] = (Path("runs/data/val"),)
    """Recordings that choose the best weights and the thresholds. Of ELiDAR, frames are held out instead."""
    held_out: float = 0.1
    """ELiDAR only: share of the training frames or sequences that is held out."""
    on_error: str = "raise"
    """ELiDAR only: raise, or skip: raw sequences that cannot be opened are left out, each with a warning."""
    first_half: Path = TEMPORAL_WEIGHTS
    """ELiDAR only: a detector with a memory whose first half is kept, as ELiDAR has no maps of actors."""
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
            architecture=TEMPORAL,
            network={},
            sampling=SampleOptions(),
            training=TrainingOptions(
                steps=2500,
                batch_size=64,
                learning_rate=3e-3,
                weight_decay=0.02,
                warmup_steps=100,
                clip_gradient=1.0,
                ema=0.995,
                evaluate_every=500,
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


def slices_of(folders: Sequence[Path], workers: int) -> JoinedSlices:
    """The slices of folders of recordings, each cut into a folder beside it where they are missing."""
    parts = []
    for recordings in folders:
        folder = recordings.with_name(recordings.name + "-slices")
        with tqdm(desc=f"slices of {recordings.name}", unit="sequence", disable=None) as bar:
            parts.append(build_slices(recordings, folder, workers=workers, progress=bar.update))
    return JoinedSlices(parts)


def data_of(options: Options) -> tuple[FrameSource, FrameSource]:
    """What is learnt from, and what is judged by."""
    elidar = [files for folder in options.data if (files := elidar_in(folder)) is not None]
    if not elidar:
        return slices_of(options.data, options.workers), slices_of(options.validation, options.workers)
    if len(options.data) > 1:
        folders = ", ".join(map(str, options.data))
        raise ValueError(
            f"data: found {folders}, expected one folder with ELiDAR's files, or recordings alone"
        )
    if options.architecture == TEMPORAL:
        return open_elidar_sequences(elidar[0], options.held_out, options.on_error)
    return open_elidar_frames(elidar[0].require_slicing(), options.held_out)


def run(options: Options, command: str) -> Card:
    """Train, calibrate, and complete the card beside the weights."""
    training, validation = data_of(options)
    network, arguments = network_of(options, training)
    card = Card(
        what="Trigger policy: probability that a 20 ms event frame is a keyframe",
        architecture=options.architecture,
        options=arguments,
        data={"training": training.summary, "validation": validation.summary},
        training={
            "command": command,
            "sampling": asdict(options.sampling),
            "nl_env": nl_env.__version__,
        },
    )
    if isinstance(network, TemporalDetector):
        return train_temporal(network, training, validation, options, card)
    task = KeyframeTask(training, validation, options.sampling)
    result = train(
        network, task, options.training, options.out, card, resume=options.resume, overwrite=options.overwrite
    )
    return calibrated(result.weights, validation, options.training.threads)


def network_of(options: Options, training: FrameSource) -> tuple[nn.Module, dict[str, Any]]:
    """The network to train and its arguments.

    Without maps of actors a detector with a memory keeps a first half that was trained before.
    """
    if options.architecture == TEMPORAL and not isinstance(training, MappedSlices):
        network, card = load_network(options.first_half, ARCHITECTURES)
        if not isinstance(network, TemporalDetector):
            raise ValueError(
                f"first_half: found {card.architecture} in {options.first_half}, expected {TEMPORAL}"
            )
        return network, card.options
    height, width = training.shape
    arguments = {"height": height, "width": width, **options.network}
    with seeded(options.training.seed):
        return ARCHITECTURES[options.architecture](**arguments), arguments


def train_temporal(
    network: TemporalDetector,
    training: FrameSource,
    validation: FrameSource,
    options: Options,
    card: Card,
) -> Card:
    """Train the two halves one after the other, in folders of their own, and put them together.

    The first needs the maps of actors that recordings have; on other data the second is trained alone.
    """
    halves: list[tuple[str, nn.Module, Callable[[], Task], TrainingOptions]] = []
    if isinstance(training, MappedSlices) and isinstance(validation, MappedSlices):
        see = partial(PerceptionTask, training, validation, options.sampling)
        halves.append(("perception", Perception(network), see, options.training))
    remember = partial(RecallTask, network, training, validation, options.memory_sampling)
    halves.append(("recall", Recall(network), remember, options.memory_training))
    cards = {}
    for name, half, task, how in halves:
        part = replace(card, architecture=f"{options.architecture}/{name}")
        result = train(
            half, task(), how, options.out / name, part, resume=options.resume, overwrite=options.overwrite
        )
        load_strictly(half, read_tensors(result.weights), result.weights)
        cards[name] = result.card
    if "perception" not in cards:
        card = replace(card, training={**card.training, "first_half": str(options.first_half)})
    whole = replace(
        card,
        training={**card.training, **{name: made.training for name, made in cards.items()}},
        metrics={name: made.metrics for name, made in cards.items()},
    )
    weights = options.out / BEST
    write_weights(weights, network.state_dict(), whole)
    return calibrated(weights, validation, options.training.threads)


def calibrated(weights: Path, validation: FrameSource, threads: int) -> Card:
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""

    def work(given: list[str]) -> None:
        options = tyro.extras.overridable_config_cli(RECIPES, args=given, description=__doc__)
        print_result(options, run(options, command_line("train_keyframe", given)))

    kept = "the last checkpoint is kept"
    return run_command("train_keyframe", work, arguments, kept=kept, errors=(FloatingPointError,))


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
