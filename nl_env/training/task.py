"""What a training needs to know of its network's purpose: data, loss, validation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from torch import Tensor, nn

from nl_env.training.batches import Source

Forward = Callable[..., Any]
"""The model as a loss calls it: in bf16 where asked for, its outputs in float32 either way."""


class Task(Source, Protocol):
    """What is learnt. Pickles when ``loader_workers`` > 0; files are best opened lazily.

    Attributes:
        criterion: entry of ``evaluate`` that decides which weights are best; lower is better.
    """

    criterion: str

    def loss(self, model: Forward, batch: tuple[Tensor, ...]) -> tuple[Tensor, dict[str, Tensor]]:
        """The scalar to descend, and named parts of it for the log.

        Args:
            model: the network in training mode; outputs are float32.
            batch: what ``batch`` made, as tensors on the device; 4-D float tensors in NHWC order.
        """
        ...

    def evaluate(self, model: nn.Module) -> dict[str, float]:
        """Metrics on validation data. ``model`` is in evaluation mode, in float32, without gradients."""
        ...
