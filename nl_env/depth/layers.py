"""Layers that our networks share."""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional


def zeroed(convolution: nn.Conv2d) -> nn.Conv2d:
    """``convolution``, which answers 0 until it is trained."""
    nn.init.zeros_(convolution.weight)
    if convolution.bias is not None:
        nn.init.zeros_(convolution.bias)
    return convolution


class Residual(nn.Module):
    """Two 3x3 convolutions around a skip; the identity at first, which keeps deep networks stable."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = zeroed(nn.Conv2d(channels, channels, 3, padding=1))

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(x + self.second(functional.relu(self.first(x))))
