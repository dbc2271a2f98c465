"""Training of our extrapolator: motion network, refinement network, and both joined in one file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch
from torch import nn

from nl_env.config import choice
from nl_env.depth.examples import Augmentation, PairSource
from nl_env.depth.learned_networks import ARCHITECTURE, LearnedNetworks, load_learned
from nl_env.depth.motion_network import MotionNetwork
from nl_env.depth.refine import RefineNetwork
from nl_env.depth.training import (
    MotionMix,
    Motions,
    MotionTask,
    RefineLoss,
    RefineTask,
    estimated_motions,
)
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
"""How each network is trained unless told otherwise."""


@dataclass(frozen=True)
class OurRecipe:
    """What is learnt and how. Invalid values raise ``ValueError``."""

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

    def __post_init__(self) -> None:
        choice("parts", self.parts, ("both", "refine", "motion"))

    @property
    def estimates(self) -> bool:
        """Whether a motion network is trained."""
        return (self.estimate or self.parts == "motion") and self.parts != "refine" and not self.odometry

    def without_poses(self) -> OurRecipe:
        """The recipe for data that do not know the true motion.

        Raises:
            ValueError: what it trains needs true motions.
        """
        for name, wanted in (("odometry", self.odometry), ("estimate, parts", self.estimates)):
            if wanted:
                raise ValueError(f"{name}: found a training by true motions, which ELiDAR does not hold")
        return replace(self, mix=replace(self.mix, true=0.0))


@dataclass(frozen=True)
class OurTraining:
    """One training of ours.

    Attributes:
        recipe: what is learnt and how.
        pairs: to learn from.
        validation: to judge by.
        out: output folder.
        command: command line, for cards.
        resume: go on with what is in the output folder; the settings must be the same.
        overwrite: discard it.
    """

    recipe: OurRecipe
    pairs: PairSource
    validation: PairSource
    out: Path
    command: str
    resume: bool = False
    overwrite: bool = False

    def run(self) -> Path:
        """Train, join both networks in one file, and return its path."""
        motion = self._train_motion() if self.recipe.estimates else None
        refine = None
        if self.recipe.parts != "motion":
            refine = self._train_refine(None if motion is None else self._estimates(motion))
        return self._join(motion, refine)

    def _train_motion(self) -> TrainingResult:
        recipe = self.recipe
        options = {"channels": list(recipe.motion_channels)}
        with seeded(recipe.seed):
            network = MotionNetwork(**options)
        task = MotionTask(self.pairs, self.validation, recipe.augmentation, recipe.events, recipe.judge_every)
        return self._train("motion", network, task, recipe.motion, Card("motion network", "motion", options))

    def _train_refine(self, motions: Motions | None) -> TrainingResult:
        recipe = self.recipe
        options: dict[str, Any] = {
            "channels": list(recipe.channels),
            "fine": recipe.fine,
            "heads": recipe.heads,
        }
        with seeded(recipe.seed):
            network = RefineNetwork(**options)
        task = RefineTask(
            self.pairs,
            self.validation,
            motions,
            augmentation=recipe.augmentation,
            weights=recipe.loss,
            mix=recipe.mix,
            events=recipe.events,
            odometry=recipe.odometry,
            warped=recipe.parts != "refine",
            every=recipe.judge_every,
        )
        return self._train("refine", network, task, recipe.refine, Card("refinement", "refine", options))

    def _train(
        self, name: str, network: nn.Module, task: Any, options: TrainingOptions, card: Card
    ) -> TrainingResult:
        folder = self.out / name
        return train(
            network,
            task,
            replace(options, seed=self.recipe.seed),
            folder,
            replace(card, data=self._data, training=self._about),
            resume=self.resume and folder.is_dir(),
            overwrite=self.overwrite,
        )

    @property
    def _data(self) -> dict[str, Any]:
        return {"train": self.pairs.summary, "validation": self.validation.summary}

    @property
    def _about(self) -> dict[str, Any]:
        return {"command": self.command, "seed": self.recipe.seed}

    def _estimates(self, motion: TrainingResult) -> Motions:
        """What the motion network says about every pair, computed once per weights."""
        card = read_card(motion.weights)
        assert card is not None
        network = MotionNetwork(**card.options)
        network.load_state_dict(read_tensors(motion.weights))
        network.eval()
        found = []
        for name, each in (("train", self.pairs), ("val", self.validation)):
            path = self.out / "motion" / f"motions-{name}-{card.sha256[:16]}.npy"
            if not path.is_file():
                motions = estimated_motions(network, each, self.recipe.events)
                with replacing(path) as temporary:
                    np.save(temporary, motions, allow_pickle=False)
            found.append(np.load(path, allow_pickle=False))
        return Motions(*found)

    def _join(self, motion: TrainingResult | None, refine: TrainingResult | None) -> Path:
        """One file of weights and one card from those of the two trainings."""
        recipe = self.recipe
        tensors: dict[str, torch.Tensor] = {}
        parts: dict[str, Any] = {"motion": None, "refine": None}
        training, metrics = dict(self._about), {}
        for name, result in (("motion", motion), ("refine", refine)):
            if result is not None:
                card = read_card(result.weights)
                assert card is not None
                tensors |= {f"{name}.{key}": value for key, value in read_tensors(result.weights).items()}
                parts[name] = card.options
                training[name] = card.training
                metrics[name] = card.metrics
        network = {**parts, "warped": recipe.parts != "refine", "events": recipe.events}
        LearnedNetworks(**network).load_state_dict(tensors)
        settings = {"parts": recipe.parts, "odometry": recipe.odometry, "loss": asdict(recipe.loss)}
        settings |= {"mix": asdict(recipe.mix), "augmentation": asdict(recipe.augmentation)}
        card = Card(
            what=f"NeuroLiDAR's own depth extrapolator ({recipe.parts}, seed {recipe.seed})",
            architecture=ARCHITECTURE,
            options=network,
            data=self._data,
            training={**training, **settings},
            metrics=metrics,
        )
        write_weights(self.out / WEIGHTS, tensors, card)
        return self.out / WEIGHTS


def join(
    motion: Path, refine: Path, out: Path, validation: PairSource, command: str, judge_every: int = 1
) -> tuple[Path, Mapping[str, Mapping[str, float]]]:
    """Put a motion network and a refinement that were trained apart into one file.

    Args:
        motion, refine: weights with the network to take.
        out: output folder.
        validation: judges the pair, with the motion network and without.
        command: command line, for the card.
        judge_every: judge by every so many pairs.

    Returns:
        Path of the weights, and what the judgement says by where the motion is from.

    Raises:
        ValueError: a file without the network.
    """
    (motion_network, motion_card), (refine_network, card) = _part(motion, "motion"), _part(refine, "refine")
    settings = {**card.options, "motion": motion_card.options["motion"]}
    joined = LearnedNetworks(**settings).eval()
    joined.motion = cast(MotionNetwork, motion_network)
    joined.refine = cast(RefineNetwork, refine_network)
    estimates = estimated_motions(motion_network, validation, joined.events)
    metrics = {}
    for name, motions in (("estimated", Motions(estimates, estimates)), ("continued", None)):
        task = RefineTask(validation, validation, motions, events=joined.events, every=judge_every)
        with torch.no_grad():
            metrics[name] = task.evaluate(refine_network)
    training = {"command": command, "motion": motion_card.training, "refine": card.training}
    card = replace(card, options=settings, training=training, metrics={"validation": metrics})
    out.mkdir(parents=True, exist_ok=True)
    write_weights(out / WEIGHTS, joined.state_dict(), card)
    return out / WEIGHTS, metrics


def _part(path: Path, name: str) -> tuple[nn.Module, Card]:
    """One of the networks in a file of weights, and the file's card."""
    network = getattr(load_learned(path), name)
    card = read_card(path)
    if network is None or card is None:
        raise ValueError(f"{name}: found no {name} network in {str(path)!r}")
    return network, card
