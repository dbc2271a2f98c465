"""Training the paper's networks: METER loss on pairs, for the engine in :mod:`nl_env.training`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from nl_env.config import choice
from nl_env.depth.examples import Augmentation, PairSource, augmented
from nl_env.depth.losses import PAPER_WEIGHTS, RELEASED_WEIGHTS, meter_loss
from nl_env.depth.metrics import returns_from_depth
from nl_env.depth.training import Prediction, scores
from nl_env.training import Forward

WEIGHTS = {"released": RELEASED_WEIGHTS, "paper": PAPER_WEIGHTS}


@dataclass(frozen=True)
class PaperLoss:
    """The METER loss. Invalid values raise ``ValueError``."""

    weights: Literal["released", "paper"] = "released"
    """Of its parts: as the released code or as the paper's text has them."""

    def __post_init__(self) -> None:
        choice("weights", self.weights, tuple(WEIGHTS))


class PaperTask:
    """Training of a network of the paper's family.

    Args:
        pairs: to learn from.
        validation: to judge by.
        augmentation: flips and noise; the paper has none.
        loss: which weights.
        every: judge by every so many validation pairs.
    """

    criterion = "rmse"

    def __init__(
        self,
        pairs: PairSource,
        validation: PairSource,
        augmentation: Augmentation,
        loss: PaperLoss | None = None,
        every: int = 1,
    ) -> None:
        self.pairs, self.validation, self.every = pairs, validation, every
        self.augmentation, self.weights = augmentation, WEIGHTS[(loss or PaperLoss()).weights]

    @property
    def size(self) -> int:
        """Number of training pairs."""
        return len(self.pairs)

    def batch(self, indices: NDArray[np.int64], rng: np.random.Generator) -> tuple[NDArray[np.float32], ...]:
        """Prior ``(N, 1, H, W)`` m, voxel grid ``(N, 5, H, W)``, truth ``(N, 1, H, W)`` m."""
        chosen = [augmented(self.pairs.example(int(index)), self.augmentation, rng) for index in indices]
        return (
            np.stack([each.scene.prior[None] for each in chosen]),
            np.stack([each.scene.voxel.astype(np.float32, copy=False) for each in chosen]),
            np.stack([each.truth[None] for each in chosen]),
        )

    def loss(self, model: Forward, batch: tuple[Tensor, ...]) -> tuple[Tensor, dict[str, Tensor]]:
        """The METER loss and its parts."""
        prior, voxel, truth = batch
        return meter_loss(model(prior, voxel), truth, self.weights, self.pairs.max_depth)

    def evaluate(self, model: nn.Module) -> dict[str, float]:
        """Every metric as a share of Repeat's; the best weights have the lowest RMSE, as in the paper."""

        def predict(index: int) -> Prediction:
            scene = self.validation.example(index).scene
            voxel = torch.from_numpy(scene.voxel.astype(np.float32))
            depth = model(torch.from_numpy(scene.prior)[None, None], voxel[None])[0, 0].numpy()
            return returns_from_depth(depth), depth

        return scores(self.validation, predict, self.every)
