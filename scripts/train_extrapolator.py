r"""Train depth extrapolators: ours (motion, warp, refinement) or the paper's U-Net.

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

With --data FOLDER of ELiDAR's files instead of recordings, either network learns from its pairs.

Training and validation pairs are cut once, by "pairs" or by whoever needs them first. Interrupted or killed,
any of the commands goes on with --resume and ends with the same weights as if it had not been.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # runs from a checkout, wherever the command is started

import tyro
from tqdm import tqdm

from nl_env.command_line import command_line, run_command
from nl_env.config import choice
from nl_env.depth.elidar_pairs import ElidarOptions, open_elidar_pairs
from nl_env.depth.examples import Augmentation, PairSource
from nl_env.depth.learned_training import WEIGHTS, OurRecipe, OurTraining, join
from nl_env.depth.pairs import PAPER_GAPS, PairOptions, Pairs, build_pairs
from nl_env.depth.paper_training import PaperLoss, PaperTask
from nl_env.depth.unet import VARIANTS, UNet, unet_card
from nl_env.elidar import elidar_in
from nl_env.training import TrainingOptions, seeded, train
from nl_env.weight_files import read_card, read_tensors, write_weights

PAPER = TrainingOptions(
    epochs=1, batch_size=8, learning_rate=5e-3, warmup_steps=50, ema=0.99, evaluate_every=325
)
"""How a network of the paper's family is trained unless told otherwise. At the authors' rate of 1e-3 its
last layer takes an epoch to grow to metres."""


@dataclass(frozen=True)
class Data:
    """What is learnt from."""

    data: Path = Path("runs/data/train")
    """Recordings to learn from, with depth every 10 ms, or a folder with ELiDAR's files."""
    validation: Path = Path("runs/data/val")
    """Recordings to judge by. Of ELiDAR, training sequences are held out instead (--elidar.held-out)."""
    pairs: Path = Path("runs/pairs")
    """Where the pairs cut from recordings, and the motions found in ELiDAR, are or go."""
    instants: int = 16
    """LiDAR frames per recording; each gives a pair per gap."""
    workers: int = os.cpu_count() or 1
    """Processes that cut pairs."""

    def open(self, elidar: ElidarOptions, previous: bool = True) -> tuple[PairSource, PairSource]:
        """Training and validation pairs, cut where they are missing.

        Of ELiDAR, ``previous`` asks for LiDAR frames before the prior and the motions since.
        """
        files = elidar_in(self.data)
        if files is not None:
            with tqdm(desc="motions", unit="sequence", disable=None) as bar:
                folder = self.pairs / "elidar" if previous else None
                return open_elidar_pairs(files, elidar, folder, workers=self.workers, progress=bar.update)
        return self._built(self.data, "train", PairOptions(self.instants)), self._built(
            self.validation, "val", PairOptions(self.instants, PAPER_GAPS)
        )

    def _built(self, recordings: Path, split: str, options: PairOptions) -> Pairs:
        with tqdm(desc=f"pairs {split}", unit="sequence", disable=None) as bar:
            return build_pairs(
                recordings, self.pairs / split, options, workers=self.workers, progress=bar.update
            )


@dataclass(frozen=True)
class PairsCommand:
    """Cut training and validation pairs from recordings, or find the motions in ELiDAR."""

    source: Annotated[Data, tyro.conf.OmitArgPrefixes] = field(default_factory=Data)
    elidar: ElidarOptions = field(default_factory=ElidarOptions)

    def run(self, command: str) -> str:
        """Cut; what there is."""
        training, validation = self.source.open(self.elidar)
        return f"{len(training)} training and {len(validation)} validation pairs: {self.source.pairs}"


@dataclass(frozen=True)
class Ours(OurRecipe):
    """Train our extrapolator: the motion network, then the refinement network."""

    source: Annotated[Data, tyro.conf.OmitArgPrefixes] = field(default_factory=Data)
    elidar: ElidarOptions = field(default_factory=ElidarOptions)
    out: Path = Path("runs/unet")
    """Output folder."""
    resume: bool = False
    """Go on with the training in the output folder; the settings must be the same."""
    overwrite: bool = False
    """Discard the training in the output folder."""

    def run(self, command: str) -> str:
        """Train; where the weights are."""
        pairs, validation = self.source.open(self.elidar)
        recipe = self if pairs.poses else self.without_poses()
        training = OurTraining(recipe, pairs, validation, self.out, command, self.resume, self.overwrite)
        return f"weights: {training.run()}"


@dataclass(frozen=True)
class Paper:
    """Train a network of the paper's family."""

    source: Annotated[Data, tyro.conf.OmitArgPrefixes] = field(default_factory=Data)
    elidar: ElidarOptions = field(default_factory=ElidarOptions)
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

    def run(self, command: str) -> str:
        """Train; where the weights are."""
        pairs, validation = self.source.open(self.elidar, previous=False)
        with seeded(self.seed):
            network = UNet(VARIANTS[self.variant])
        card = unet_card(
            network,
            f"The paper's depth extrapolation network ({self.variant}, seed {self.seed})",
            {"command": command, "seed": self.seed, "loss": asdict(self.loss)},
        )
        result = train(
            network,
            PaperTask(pairs, validation, self.augmentation, self.loss, self.judge_every),
            replace(self.training, seed=self.seed),
            self.out / "training",
            replace(card, data={"train": pairs.summary, "validation": validation.summary}),
            resume=self.resume,
            overwrite=self.overwrite,
        )
        weights = self.out / WEIGHTS
        final = read_card(result.weights)
        assert final is not None
        write_weights(weights, read_tensors(result.weights), final)
        return f"weights: {weights}"


@dataclass(frozen=True)
class Join:
    """Put a motion network and a refinement that were trained apart into one file, and judge the pair."""

    motion: Path
    """Weights with the motion network to take (of "ours --parts motion")."""
    refine: Path
    """Weights with the refinement to take."""
    out: Path
    """Output folder."""
    source: Annotated[Data, tyro.conf.OmitArgPrefixes] = field(default_factory=Data)
    elidar: ElidarOptions = field(default_factory=ElidarOptions)
    judge_every: int = 1
    """Validate by every so many validation pairs."""

    def run(self, command: str) -> str:
        """Join; where the weights are and what they reach."""
        _, validation = self.source.open(self.elidar)
        weights, metrics = join(self.motion, self.refine, self.out, validation, command, self.judge_every)
        lines = [
            f"{name} motion: " + ", ".join(f"{key} {value:.4g}" for key, value in reached.items())
            for name, reached in metrics.items()
        ]
        return "\n".join([*lines, f"weights: {weights}"])


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""

    def work(given: list[str]) -> None:
        options = tyro.cli(
            Annotated[PairsCommand, tyro.conf.subcommand("pairs")]
            | Annotated[Ours, tyro.conf.subcommand("ours")]
            | Annotated[Paper, tyro.conf.subcommand("paper")]
            | Annotated[Join, tyro.conf.subcommand("join")],
            args=given,
            description=__doc__,
        )
        print(options.run(command_line("train_extrapolator", given)))

    kept = "the last checkpoint is kept"
    return run_command("train_extrapolator", work, arguments, kept=kept, errors=(FloatingPointError,))


if __name__ == "__main__":
    sys.exit(main())
