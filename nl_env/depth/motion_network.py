"""The motion network: which parts of the image tell how the camera moved, and how far to believe them.

What the events say about the flow that a guessed motion lacks is geometry (:mod:`nl_env.depth.twist`; here
once more for batches, with gradients). It is right on edges of what stands still, and wrong on moving
objects, on leaves, in the rain, and where bins differ for other reasons than motion. The network weighs it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from nl_env.depth.features import CHANNELS, GAP_UNIT, INVERSE_SCALE
from nl_env.depth.layers import Residual, zeroed
from nl_env.depth.twist import CELL, SPREAD, WARPED_INVERSE
from nl_env.types import Camera

STRIDE = 8
"""Image sides must be multiples of this."""

_FIRST_WEIGHT = 0.03
"""Of all cells, before training."""

_MOST = 5.0
"""Weights stay within ``_FIRST_WEIGHT`` times or divided by ``exp`` of this, which keeps solutions finite."""

_GAIN = 0.2
"""Of the head, against the coherent first steps of Adam."""


class MotionNetwork(nn.Module):
    """Weight and scale of the drift per 4x4 cell.

    Args:
        channels: features at 1/2, 1/4 and 1/8 of the resolution.
    """

    def __init__(self, channels: Sequence[int] = (16, 32, 48)) -> None:
        super().__init__()
        half, quarter, eighth = channels
        self.stem = nn.Conv2d(len(CHANNELS), half, 3, stride=2, padding=1)
        self.down = nn.Conv2d(half, quarter, 3, stride=2, padding=1)
        self.near = Residual(quarter)
        self.deeper = nn.Conv2d(quarter, eighth, 3, stride=2, padding=1)
        self.wide = nn.Sequential(Residual(eighth), Residual(eighth))
        self.up = nn.ConvTranspose2d(eighth, quarter, 2, stride=2)
        self.join = Residual(quarter)
        self.head = zeroed(nn.Conv2d(quarter, 2, 3, padding=1))

    def forward(self, features: Tensor) -> Tensor:
        """``(N, 2, H/4, W/4)``: weight of every cell and scale of its flow, both above 0.

        Args:
            features: ``(N, C, H, W)`` of :func:`nl_env.depth.features.features` for the guessed motion,
                with compensated events.
        """
        x = self.near(functional.relu(self.down(functional.relu(self.stem(features)))))
        x = self.join(x + self.up(self.wide(functional.relu(self.deeper(x)))))
        weight, scale = (_GAIN * self.head(x)).split(1, dim=1)
        weight = _FIRST_WEIGHT * torch.exp(_MOST * torch.tanh(weight / _MOST))
        return torch.cat([weight, torch.exp(torch.tanh(scale))], dim=1)


def cell_inverse(features: Tensor) -> Tensor:
    """``(N, H/4, W/4)`` mean inverse depth of the warped frame per cell, 1/m."""
    return functional.avg_pool2d(features[:, WARPED_INVERSE], CELL) / INVERSE_SCALE


def flow_jacobian(camera: Camera, inverse: Tensor) -> Tensor:
    """Flow in pixels per twist (m, rad; applied in the camera's frame), ``(N, H/4, W/4, 2, 6)``.

    Args:
        camera: intrinsics of the whole image.
        inverse: ``(N, H/4, W/4)`` inverse depth of the cells, 1/m.
    """
    _, rows, columns = inverse.shape
    column, row = (
        torch.arange(count, dtype=inverse.dtype, device=inverse.device) * CELL + (CELL - 1) / 2
        for count in (columns, rows)
    )
    x, y = ((column - camera.cx) / camera.fx)[None, None, :], ((row - camera.cy) / camera.fy)[None, :, None]
    x, y = x.expand_as(inverse), y.expand_as(inverse)
    zero = torch.zeros_like(inverse)
    across = torch.stack([inverse, zero, -x * inverse, -x * y, 1 + x * x, -y], dim=-1) * camera.fx
    down = torch.stack([zero, inverse, -y * inverse, -1 - y * y, x * y, x], dim=-1) * camera.fy
    return torch.stack([across, down], dim=-2)


def solve_twist(answer: Tensor, drifts: Tensor, jacobian: Tensor, gap: Tensor) -> Tensor:
    """The corrections ``(N, 6)`` that explain the drifts best, to be applied after the guessed motions.

    Args:
        answer: ``(N, 2, H/4, W/4)`` of the network.
        drifts: ``(N, 5, H/4, W/4)`` of :func:`nl_env.depth.twist.drift`.
        jacobian: of :func:`flow_jacobian`.
        gap: ``(N,)``, s.
    """
    weight, scale = answer.unbind(1)
    xx, xy, yy, xd, yd = (drifts * weight[:, None]).unbind(1)
    # In units of the spread, so that what holds the solution is the unit matrix.
    spread = jacobian.new_tensor(SPREAD) * (gap / GAP_UNIT).view(-1, 1)
    across, down = (jacobian * spread[:, None, None, None]).unbind(-2)
    pulled_across = xx[..., None] * across + xy[..., None] * down
    pulled_down = xy[..., None] * across + yy[..., None] * down
    normal = torch.einsum("nyxi,nyxj->nij", across, pulled_across)
    normal = normal + torch.einsum("nyxi,nyxj->nij", down, pulled_down)
    right = torch.einsum("nyxi,nyx->ni", across, xd * scale) + torch.einsum("nyxi,nyx->ni", down, yd * scale)
    unit = torch.eye(6, dtype=normal.dtype, device=normal.device)
    return torch.linalg.solve(normal + unit, right) * spread
