r"""Train depth extrapolators on recordings: ours (motion, warp, refinement) or the paper's U-Net.

    python scripts/record.py --split train --sequences 128 --duration 10 --depth-period-ms 10 \
        --out runs/data/train
    python scripts/record.py --split val --sequences 16 --duration 10 --depth-period-ms 10 \
        --out runs/data/val
    python scripts/train_extrapolator.py pairs
    python scripts/train_extrapolator.py ours --out runs/unet
    python scripts/train_extrapolator.py paper --out runs/unet-paper

Ours continues the motion of the last LiDAR interval unless it has a motion network (--estimate). The two
networks may also be trained apart:

    python scripts/train_extrapolator.py ours --out runs/refine
    python scripts/train_extrapolator.py ours --parts motion --out runs/motion
    python scripts/train_extrapolator.py join --motion runs/motion/extrapolator.safetensors \
        --refine runs/refine/extrapolator.safetensors --out runs/unet

Training and validation pairs are cut once, by "pairs" or by whoever needs them first. Interrupted or killed,
any of the commands goes on with --resume and ends with the same weights as if it had not been.
"""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # runs from a checkout, wherever the command is started

import numpy as np
import torch
import tyro
from tqdm import tqdm

from nl_env.config import choice
from nl_env.depth.examples import Augmentation
from nl_env.depth.learned_networks import ARCHITECTURE, LearnedNetworks, load_learned
from nl_env.depth.motion_network import MotionNetwork
from nl_env.depth.pairs import PAPER_GAPS, PairOptions, Pairs, build_pairs
from nl_env.depth.paper_training import PaperLoss, PaperTask
from nl_env.depth.refine import RefineNetwork
from nl_env.depth.training import (
    MotionMix,
    Motions,
    MotionTask,
    RefineLoss,
    RefineTask,
    estimated_motions,
)
from nl_env.depth.unet import VARIANTS, UNet, unet_card
from nl_env.runs import replacing
from nl_env.training import TrainingOptions, TrainingResult, seeded, train
from nl_env.weight_files import Card, read_card, read_tensors, write_weights

WEIGHTS = "extrapolator.safetensors"
"""What a training leaves in its folder, with a card; ``extrapolator=`` of an environment takes the path."""

MOTION = TrainingOptions(
    epochs=1, learning_rate=2e-3, warmup_steps=50, ema=0.99, clip_gradient=1.0, evaluate_every=160
)
REFINE = TrainingOptions(
    epochs=3,
    batch_size=8,
    learning_rate=1e-3,
    warmup_steps=100,
    ema=0.995,
    clip_gradient=1.0,
    evaluate_every=1000,
)
PAPER = TrainingOptions(epochs=2, learning_rate=1e-3, warmup_steps=50, ema=0.99, evaluate_every=400)
"""How each network is trained unless told otherwise."""


@dataclass(frozen=True)
class Data:
    """Recordings, and the pairs cut from them."""

    train: Path = Path("runs/data/train")
    """Recordings to learn from, with depth every 10 ms."""
    validation: Path = Path("runs/data/val")
    """Recordings to judge by."""
    pairs: Path = Path("runs/pairs")
    """Where the pairs are, or go."""
    instants: int = 16
    """LiDAR frames per sequence; each gives a pair per gap."""
    workers: int = os.cpu_count() or 1
    """Processes that cut pairs."""

    def open(self) -> tuple[Pairs, Pairs]:
        """Training and validation pairs, cut where they are missing."""
        return self._built(self.train, "train", PairOptions(self.instants)), self._built(
            self.validation, "val", PairOptions(self.instants, PAPER_GAPS)
        )

    def _built(self, recordings: Path, split: str, options: PairOptions) -> Pairs:
        with tqdm(desc=f"pairs {split}", unit="sequence", disable=None) as bar:
            return build_pairs(
                recordings, self.pairs / split, options, workers=self.workers, progress=bar.update
            )


@dataclass(frozen=True)
class PairsCommand:
    """Cut training and validation pairs from recordings."""

    data: Data = field(default_factory=Data)


@dataclass(frozen=True)
class Ours:
    """Train our extrapolator: the motion network, then the refinement network."""

    data: Data = field(default_factory=Data)
    out: Path = Path("runs/unet")
    """Output folder."""
    seed: int = 0
    """Of first weights, sample order and augmentation."""
    parts: Literal["both", "refine", "motion"] = "both"
    """What is learnt. refine: the prior is not warped; motion: the warped frame is not refined."""
    events: bool = True
    """False trains both networks blind to events."""
    odometry: bool = False
    """Warp by the true motion; no motion network."""
    estimate: bool = False
    """True also trains a motion network, which corrects the last LiDAR interval's motion by the events."""
    heads: int = 3
    """1: a single depth that has to say everything."""
    fine: int = 0
    """Features of the refinement network's last convolution at full resolution; 0 leaves it out."""
    channels: tuple[int, ...] = (32, 64, 96)
    """Features of the refinement network at 1/2, 1/4, ... of the resolution."""
    motion_channels: tuple[int, int, int] = (16, 32, 48)
    """Features of the motion network at 1/2, 1/4, 1/8."""
    motion: TrainingOptions = field(default_factory=lambda: MOTION)
    """Training of the motion network."""
    refine: TrainingOptions = field(default_factory=lambda: REFINE)
    """Training of the refinement network."""
    loss: RefineLoss = field(default_factory=RefineLoss)
    mix: MotionMix = field(default_factory=MotionMix)
    augmentation: Augmentation = field(default_factory=Augmentation)
    judge_every: int = 4
    """Validate by every so many validation pairs while training; by all of them at the end."""
    resume: bool = False
    """Go on with the training in the output folder; the settings must be the same."""
    overwrite: bool = False
    """Discard the training in the output folder."""

    def __post_init__(self) -> None:
        choice("parts", self.parts, ("both", "refine", "motion"))


@dataclass(frozen=True)
class Paper:
    """Train a network of the paper's family."""

    data: Data = field(default_factory=Data)
    out: Path = Path("runs/unet-paper")
    """Output folder."""
    seed: int = 0
    """Of first weights, sample order and augmentation."""
    variant: str = "released"
    """Which network: released, paper, without-events, event-frame, data-concat or without-skip."""
    loss: PaperLoss = field(default_factory=PaperLoss)
    training: TrainingOptions = field(default_factory=lambda: PAPER)
    augmentation: Augmentation = field(
        default_factory=lambda: Augmentation(noise=0.0, threshold=1.0, start=0.0, jitter=0.0)
    )
    judge_every: int = 4
    """Validate by every so many validation pairs."""
    resume: bool = False
    """Go on with the training in the output folder; the settings must be the same."""
    overwrite: bool = False
    """Discard the training in the output folder."""

    def __post_init__(self) -> None:
        choice("variant", self.variant, tuple(VARIANTS))


@dataclass(frozen=True)
class Join:
    """Put a motion network and a refinement that were trained apart into one file, and judge the pair."""

    motion: Path
    """Weights with the motion network to take (of "ours --parts motion")."""
    refine: Path
    """Weights with the refinement to take."""
    out: Path
    """Output folder."""
    data: Data = field(default_factory=Data)
    judge_every: int = 1
    """Validate by every so many validation pairs."""


def train_ours(options: Ours, command: str) -> Path:
    """Train, join both networks in one file, and return its path."""
    pairs, validation = options.data.open()
    data = {"train": pairs.summary, "validation": validation.summary}
    about = {"command": command, "seed": options.seed}
    motion: TrainingResult | None = None
    motions: Motions | None = None
    estimate = options.estimate or options.parts == "motion"
    if estimate and options.parts != "refine" and not options.odometry:
        motion = _train_motion(options, pairs, validation, Card("motion network", "motion", {}, data, about))
    refine: TrainingResult | None = None
    if options.parts != "motion":
        if motion is not None:
            motions = _estimates(options, motion, pairs, validation)
        refine = _train_refine(
            options, pairs, validation, motions, Card("refinement", "refine", {}, data, about)
        )
    return _join(options, motion, refine, data, about)


def _train_motion(options: Ours, pairs: Pairs, validation: Pairs, card: Card) -> TrainingResult:
    network_options = {"channels": list(options.motion_channels)}
    with seeded(options.seed):
        network = MotionNetwork(**network_options)
    task = MotionTask(pairs, validation, options.augmentation, options.events, options.judge_every)
    return train(
        network,
        task,
        replace(options.motion, seed=options.seed),
        options.out / "motion",
        replace(card, options=network_options),
        resume=options.resume and (options.out / "motion").is_dir(),
        overwrite=options.overwrite,
    )


def _train_refine(
    options: Ours, pairs: Pairs, validation: Pairs, motions: Motions | None, card: Card
) -> TrainingResult:
    network_options = {"channels": list(options.channels), "fine": options.fine, "heads": options.heads}
    with seeded(options.seed):
        network = RefineNetwork(**network_options)
    task = RefineTask(
        pairs,
        validation,
        motions,
        augmentation=options.augmentation,
        weights=options.loss,
        mix=options.mix,
        events=options.events,
        odometry=options.odometry,
        warped=options.parts != "refine",
        every=options.judge_every,
    )
    return train(
        network,
        task,
        replace(options.refine, seed=options.seed),
        options.out / "refine",
        replace(card, options=network_options),
        resume=options.resume and (options.out / "refine").is_dir(),
        overwrite=options.overwrite,
    )


def _estimates(options: Ours, motion: TrainingResult, pairs: Pairs, validation: Pairs) -> Motions:
    """What the motion network says about every pair, computed once per weights."""
    card = read_card(motion.weights)
    assert card is not None
    network = MotionNetwork(**card.options)
    network.load_state_dict(read_tensors(motion.weights))
    network.eval().to(memory_format=torch.channels_last)
    found = []
    for name, each in (("train", pairs), ("val", validation)):
        path = options.out / "motion" / f"motions-{name}-{card.sha256[:16]}.npy"
        if not path.is_file():
            motions = estimated_motions(network, each, options.events)
            with replacing(path) as temporary:
                np.save(temporary, motions, allow_pickle=False)
        found.append(np.load(path, allow_pickle=False))
    return Motions(*found)


def _join(
    options: Ours,
    motion: TrainingResult | None,
    refine: TrainingResult | None,
    data: dict[str, Any],
    about: dict[str, Any],
) -> Path:
    """One file of weights and one card from those of the two trainings."""
    tensors: dict[str, torch.Tensor] = {}
    parts: dict[str, Any] = {"motion": None, "refine": None}
    training, metrics = dict(about), {}
    for name, result in (("motion", motion), ("refine", refine)):
        if result is not None:
            card = read_card(result.weights)
            assert card is not None
            tensors |= {f"{name}.{key}": value for key, value in read_tensors(result.weights).items()}
            parts[name] = card.options
            training[name] = card.training
            metrics[name] = card.metrics
    network = {**parts, "warped": options.parts != "refine", "events": options.events}
    LearnedNetworks(**network).load_state_dict(tensors)
    settings = {"parts": options.parts, "odometry": options.odometry, "loss": asdict(options.loss)}
    settings |= {"mix": asdict(options.mix), "augmentation": asdict(options.augmentation)}
    card = Card(
        what=f"NeuroLiDAR's own depth extrapolator ({options.parts}, seed {options.seed})",
        architecture=ARCHITECTURE,
        options=network,
        data=data,
        training={**training, **settings},
        metrics=metrics,
    )
    write_weights(options.out / WEIGHTS, tensors, card)
    return options.out / WEIGHTS


def join(options: Join, command: str) -> Path:
    """Join, judge with and without the motion network, and return the path of the weights."""
    (motion, motion_card), (refine, refine_card) = (
        _part(options.motion, "motion"),
        _part(options.refine, "refine"),
    )
    settings = {**refine_card.options, "motion": motion_card.options["motion"]}
    joined = LearnedNetworks(**settings).eval()
    joined.motion, joined.refine = motion, refine
    _, validation = options.data.open()
    estimates = estimated_motions(motion, validation, joined.events)
    metrics = {}
    for name, motions in (("estimated", Motions(estimates, estimates)), ("continued", None)):
        task = RefineTask(validation, validation, motions, events=joined.events, every=options.judge_every)
        with torch.no_grad():
            metrics[name] = task.evaluate(refine)
        print(f"{name} motion: " + ", ".join(f"{key} {value:.4g}" for key, value in metrics[name].items()))
    training = {"command": command, "motion": motion_card.training, "refine": refine_card.training}
    card = replace(refine_card, options=settings, training=training, metrics={"validation": metrics})
    options.out.mkdir(parents=True, exist_ok=True)
    write_weights(options.out / WEIGHTS, joined.state_dict(), card)
    return options.out / WEIGHTS


def _part(path: Path, name: str) -> tuple[torch.nn.Module, Card]:
    """One of the networks in a file of weights, and the file's card."""
    network = getattr(load_learned(path), name)
    card = read_card(path)
    if network is None or card is None:
        raise ValueError(f"{name}: found no {name} network in {str(path)!r}")
    return network, card


def train_paper(options: Paper, command: str) -> Path:
    """Train a network of the paper's family and return the path of its weights."""
    pairs, validation = options.data.open()
    with seeded(options.seed):
        network = UNet(VARIANTS[options.variant])
    card = unet_card(
        network,
        f"The paper's depth extrapolation network ({options.variant}, seed {options.seed})",
        {"command": command, "seed": options.seed, "loss": asdict(options.loss)},
    )
    result = train(
        network,
        PaperTask(pairs, validation, options.augmentation, options.loss, options.judge_every),
        replace(options.training, seed=options.seed),
        options.out / "training",
        replace(card, data={"train": pairs.summary, "validation": validation.summary}),
        resume=options.resume,
        overwrite=options.overwrite,
    )
    weights = options.out / WEIGHTS
    final = read_card(result.weights)
    assert final is not None
    write_weights(weights, read_tensors(result.weights), final)
    return weights


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    again = [argument for argument in arguments if argument not in ("--overwrite", "--resume")]
    command = shlex.join(["python", "scripts/train_extrapolator.py", *again])
    try:
        options = tyro.cli(
            Annotated[PairsCommand, tyro.conf.subcommand("pairs")]
            | Annotated[Ours, tyro.conf.subcommand("ours")]
            | Annotated[Paper, tyro.conf.subcommand("paper")]
            | Annotated[Join, tyro.conf.subcommand("join")],
            args=arguments,
            description=__doc__,
        )
        if isinstance(options, PairsCommand):
            for pairs in options.data.open():
                print(f"{len(pairs)} pairs of {len(pairs.seeds)} sequences: {pairs.folder}")
        elif isinstance(options, Ours):
            print("weights:", train_ours(options, command))
        elif isinstance(options, Paper):
            print("weights:", train_paper(options, command))
        else:
            print("weights:", join(options, command))
    except (ValueError, OSError, FloatingPointError) as error:
        print(f"train_extrapolator: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"\ninterrupted; checkpoints are kept. Continue with: {command} --resume", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
