"""The refinement network: from the warped frame, the prior and the events to depth, in three heads.

* *log depth*: the median over everything, "no return" being the range, as the full-image metrics want it;
* *return*: the logit that there is a return at all; it decides where the depth frame has one;
* *log depth if return*: depth under the condition that there is one, for the paper's masked metrics,
  whose squared errors ask for a mean rather than a median.

Both depths are gated changes of the warped frame, and start as that frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from nl_env.depth.features import CHANNELS
from nl_env.depth.layers import Residual, zeroed
from nl_env.depth.refine_blocks import AROUND, FOLD, LONELY, PARTS, RETURN, SOMEWHERE, SURE, WARPED

STRIDE = 8
"""Image sides must be multiples of this."""

_GAIN = 0.1
"""Of the head: Adam's first steps move every weight alike, and with hundreds of inputs per output they
would throw the outputs far off before the features have learnt anything."""


class RefineNetwork(nn.Module):
    """A U-Net over the stack of :func:`nl_env.depth.features.features`.

    Args:
        channels: features at 1/2, 1/4, ... of the resolution.
        fine: features of a last convolution at full resolution; 0 leaves it out.
        heads: 3; 1 leaves the depth alone to say everything (it then means "no return" from the range on).
    """

    def __init__(self, channels: Sequence[int] = (32, 64, 96), fine: int = 0, heads: int = 3) -> None:
        super().__init__()
        if heads not in (1, 3):
            raise ValueError(f"heads: found {heads!r}, expected 1 or 3")
        self.heads = heads
        steps = list(pairwise(channels))
        first, outputs = channels[0], sum(PARTS)
        self.stem = nn.Conv2d(len(CHANNELS) * FOLD**2, first, 3, padding=1)
        self.enter = Residual(first)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in steps)
        self.deep = nn.ModuleList(Residual(b) for _, b in steps)
        self.up = nn.ModuleList(nn.ConvTranspose2d(b, a, 2, stride=2) for a, b in steps)
        self.leave = nn.ModuleList(Residual(a) for a, _ in steps)
        self.fine = (
            nn.ModuleList(
                [nn.Conv2d(first, fine * FOLD**2, 1), nn.Conv2d(fine + len(CHANNELS), fine, 3, padding=1)]
            )
            if fine
            else None
        )
        self.head = zeroed(nn.Conv2d(fine or first, outputs if fine else outputs * FOLD**2, 3, padding=1))

    def forward(self, features: Tensor) -> Tensor:
        """``(N, 3, H, W)``: coded log depth, return logit, coded log depth if there is a return.

        While training four more, for a loss that teaches gates and changes apart: the coded log depth
        as it is with an open gate, the gate's logit, and the same two if there is a return.

        Args:
            features: ``(N, C, H, W)``.
        """
        x = self.mixed(functional.pixel_unshuffle(features, FOLD))
        if self.fine is None:
            outputs = functional.pixel_shuffle(_GAIN * self.head(x), FOLD)
        else:
            unfold, mix = self.fine
            x = torch.cat([functional.pixel_shuffle(unfold(x), FOLD), features], dim=1)
            outputs = _GAIN * self.head(functional.relu(mix(x)))
        change, change_if, logit = outputs.split(PARTS, dim=1)
        base, returned = features[:, WARPED : WARPED + 1], features[:, RETURN : RETURN + 1]
        depth, free, gate = _changed(base, change)
        if self.heads == 1:
            certain = torch.full_like(depth, SURE)
            answer, free_if, gate_if = torch.cat([depth, certain, depth], dim=1), free, gate
        else:
            depth_if, free_if, gate_if = _changed(_filled(base, returned), change_if)
            answer = torch.cat([depth, logit + SURE * (2 * returned - 1), depth_if], dim=1)
        return torch.cat([answer, free, gate, free_if, gate_if], dim=1) if self.training else answer

    def mixed(self, x: Tensor) -> Tensor:
        """Features ``(N, c, H/2, W/2)`` behind the U-Net from blocks of pixels ``(N, 4 C, H/2, W/2)``."""
        x = self.enter(functional.relu(self.stem(x)))
        skips = []
        for down, deep in zip(self.down, self.deep, strict=True):
            skips.append(x)
            x = deep(functional.relu(down(x)))
        for up, leave in zip(reversed(self.up), reversed(self.leave), strict=True):
            x = leave(up(x) + skips.pop())
        return x


class BlockConvolutions(nn.Module):
    """What :class:`nl_env.depth.refine_blocks.RefinementInBlocks` leaves to a network.

    Args:
        network: of three heads, without convolutions at full resolution.
    """

    def __init__(self, network: RefineNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, blocks: Tensor) -> Tensor:
        """``(N, H/2, W/2, 20)`` outputs of the head from blocks of features ``(N, H/2, W/2, 4 C)``."""
        x = self.network.mixed(blocks.permute(0, 3, 1, 2))
        return (_GAIN * self.network.head(x)).permute(0, 2, 3, 1)


def _filled(code: Tensor, returned: Tensor) -> Tensor:
    """Coded log depth with the mean of the returns around where there is none: a leaf hides beside leaves."""
    total, count = _means_around(torch.cat([code * returned, returned], dim=1)).split(1, dim=1)
    around = (total + LONELY * SOMEWHERE) / (count + LONELY)
    return returned * code + (1 - returned) * around


def _means_around(image: Tensor) -> Tensor:
    """Means over ``AROUND x AROUND`` pixels, zeros beyond the border.

    Sums of two, four and eight neighbours and the ninth: a third of the time of ``avg_pool2d``.
    """
    x = functional.pad(image, (AROUND // 2,) * 4)
    for dim in (2, 3):
        total = x
        for step in (1, 2, 4):
            length = total.shape[dim] - step
            total = total.narrow(dim, 0, length) + total.narrow(dim, step, length)
        length = x.shape[dim] - 8
        x = total.narrow(dim, 0, length) + x.narrow(dim, 8, length)
    return x * (1 / AROUND**2)


def _changed(base: Tensor, change: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """``base`` changed as far as the gate is open; changed freely; the gate's logit."""
    difference, gate = change.split(1, dim=1)
    free = base + difference
    return base + torch.sigmoid(gate) * difference, free, gate
