"""The paper's U-Net, ``SUNet2EnResConv``: as released, as its text has it, and in its ablation variants.

Two stems (events and depth), three encoder levels and a bottleneck of residual blocks, transposed
convolutions up again with skips, and SoftPlus at the end: depth in metres, without a return head.
Parameter names follow the released state dict, so that it loads as it is.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from nl_env.config import choice, number
from nl_env.types import BINS
from nl_env.weight_files import Card, load_network, load_strictly, read_card, read_tensors

ARCHITECTURE = "unet-paper"
"""Name of this family on cards."""

STRIDE = 8
"""Image sides must be multiples of this (three poolings)."""


@dataclass(frozen=True)
class UNetOptions:
    """Which of the family. The defaults are the released network. Invalid values raise ``ValueError``."""

    channels: int = 16
    """Of the stems and of the first level."""
    parallel_kernel: Literal[1, 3] = 3
    """Kernel of the residual blocks' parallel branch: 3 as released, 1 as the paper's text says."""
    inputs: Literal["voxel", "frame", "none"] = "voxel"
    """What it sees of the events: the voxel grid, the event frame (its sum over bins), or nothing."""
    fusion: Literal["stems", "concat"] = "stems"
    """A stem for each input, or both concatenated as they are."""
    skips: bool = True
    """The residual blocks' parallel branch, which the paper's table calls skip connection."""

    def __post_init__(self) -> None:
        number("channels", self.channels, 1, 1024)
        choice("parallel_kernel", self.parallel_kernel, (1, 3))
        choice("inputs", self.inputs, ("voxel", "frame", "none"))
        choice("fusion", self.fusion, ("stems", "concat"))
        choice("skips", self.skips, (True, False))

    @property
    def event_channels(self) -> int:
        """Planes of events that go in."""
        return {"voxel": BINS, "frame": 1, "none": 0}[self.inputs]


RELEASED = UNetOptions()
VARIANTS = {
    "released": RELEASED,
    "paper": UNetOptions(parallel_kernel=1),
    "without-events": UNetOptions(parallel_kernel=1, inputs="none"),
    "event-frame": UNetOptions(parallel_kernel=1, inputs="frame"),
    "data-concat": UNetOptions(parallel_kernel=1, fusion="concat"),
    "without-skip": UNetOptions(parallel_kernel=1, skips=False),
}
"""The released network, and the rows of the paper's ablation table after its text's architecture."""


class ConvBlock(nn.Module):
    """Convolution, batch norm; ReLU unless ``activate`` is False."""

    def __init__(self, inputs: int, outputs: int, activate: bool = True, kernel: int = 3) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, padding=kernel // 2, bias=False)
        self.bn = nn.BatchNorm2d(outputs)
        self.activate = activate

    def forward(self, x: Tensor) -> Tensor:
        x = self.bn(self.conv(x))
        return functional.relu(x) if self.activate else x


class SeparableBlock(nn.Module):
    """Depthwise 3x3 and pointwise convolution, a batch norm after each; ReLU unless ``activate`` is False."""

    def __init__(self, inputs: int, outputs: int, activate: bool = True) -> None:
        super().__init__()
        self.depthwise = nn.Conv2d(inputs, inputs, 3, padding=1, groups=inputs, bias=False)
        self.bn1 = nn.BatchNorm2d(inputs)
        self.pointwise = nn.Conv2d(inputs, outputs, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(outputs)
        self.activate = activate

    def forward(self, x: Tensor) -> Tensor:
        x = self.bn2(self.pointwise(self.bn1(self.depthwise(x))))
        return functional.relu(x) if self.activate else x


class ResidualBlock(nn.Module):
    """The paper's ResConv: convolution and separable convolution, plus a parallel convolution.

    Args:
        parallel_kernel: of the parallel convolution; 0 leaves it out.
    """

    def __init__(self, inputs: int, outputs: int, parallel_kernel: int) -> None:
        super().__init__()
        self.conv1 = ConvBlock(inputs, outputs)
        self.conv2 = SeparableBlock(outputs, outputs, activate=False)
        self.conv3 = (
            ConvBlock(inputs, outputs, activate=False, kernel=parallel_kernel) if parallel_kernel else None
        )

    def forward(self, x: Tensor) -> Tensor:
        deep = self.conv2(self.conv1(x))
        return functional.relu(deep if self.conv3 is None else deep + self.conv3(x))


class UpBlock(nn.Module):
    """Doubles the image, joins the encoder's features of that size, and mixes them."""

    def __init__(self, inputs: int, outputs: int, parallel_kernel: int) -> None:
        super().__init__()
        self.up = nn.ConvTranspose2d(inputs, outputs, 2, stride=2)
        self.conv = ResidualBlock(inputs, outputs, parallel_kernel)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        return self.conv(torch.cat([self.up(x), skip], dim=1))


class UNet(nn.Module):
    """Depth now from the last LiDAR frame and the voxel grid of the events since.

    Every variant takes the same inputs and uses what it has a use for.
    """

    def __init__(self, options: UNetOptions = RELEASED) -> None:
        super().__init__()
        self.options = options
        channels, events = options.channels, options.event_channels
        parallel = options.parallel_kernel if options.skips else 0
        if options.fusion == "concat":
            joined = events + 1
        else:
            if events:
                self.event_stem = SeparableBlock(events, channels)
            self.depth_stem = ConvBlock(1, channels)
            joined = 2 * channels if events else channels
        self.down1 = ResidualBlock(joined, channels, parallel)
        self.down2 = ResidualBlock(channels, 2 * channels, parallel)
        self.down3 = ResidualBlock(2 * channels, 4 * channels, parallel)
        self.bottleneck = ResidualBlock(4 * channels, 8 * channels, parallel)
        self.up1 = UpBlock(8 * channels, 4 * channels, parallel)
        self.up2 = UpBlock(4 * channels, 2 * channels, parallel)
        self.up3 = UpBlock(2 * channels, channels, parallel)
        self.head = nn.Conv2d(channels, 1, 1)

    def forward(self, depth: Tensor, voxel: Tensor) -> Tensor:
        """Depth ``(N, 1, H, W)`` m, above 0 everywhere.

        Args:
            depth: ``(N, 1, H, W)`` m, 0 = no return.
            voxel: ``(N, 5, H, W)`` signed event counts as they are (Eq. 2), not normalised.

        Raises:
            ValueError: shapes do not fit each other, or a side is no multiple of 8.
        """
        count, _, height, width = depth.shape
        if depth.shape[1] != 1 or height % STRIDE or width % STRIDE:
            raise ValueError(
                f"depth: found shape {tuple(depth.shape)}, "
                f"expected (N, 1, H, W) with H and W multiples of {STRIDE}"
            )
        if voxel.shape != (count, BINS, height, width):
            raise ValueError(
                f"voxel: found shape {tuple(voxel.shape)}, expected {(count, BINS, height, width)}"
            )
        full = self.down1(self._joined(depth, voxel))
        half = self.down2(functional.max_pool2d(full, 2))
        quarter = self.down3(functional.max_pool2d(half, 2))
        deepest = self.bottleneck(functional.max_pool2d(quarter, 2))
        x = self.up3(self.up2(self.up1(deepest, quarter), half), full)
        return functional.softplus(self.head(x))

    def _joined(self, depth: Tensor, voxel: Tensor) -> Tensor:
        """Both inputs as one stack of planes."""
        events = voxel.sum(1, keepdim=True) if self.options.inputs == "frame" else voxel
        if self.options.fusion == "concat":
            return depth if self.options.inputs == "none" else torch.cat([events, depth], dim=1)
        if self.options.inputs == "none":
            return self.depth_stem(depth)
        return torch.cat([self.event_stem(events), self.depth_stem(depth)], dim=1)


def make_unet(**options: Any) -> UNet:
    """The network of a card's options."""
    return UNet(UNetOptions(**options))


def unet_card(network: UNet, what: str, training: dict[str, Any] | None = None) -> Card:
    """A card from which :func:`load_unet` rebuilds ``network``."""
    return Card(what, ARCHITECTURE, options=asdict(network.options), training=training or {})


def load_unet(path: str | Path) -> UNet:
    """The network that the card beside ``path`` describes; without a card, the released one.

    Nothing is unpickled but tensors. The network comes in evaluation mode.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no weights in it, of another architecture, or tensors that do not fit.
    """
    path = Path(path)
    if read_card(path) is None:
        return load_released(path)
    network, _ = load_network(path, {ARCHITECTURE: make_unet})
    assert isinstance(network, UNet)
    return network


def load_released(path: str | Path) -> UNet:
    """The released network with the weights of a ``.safetensors`` file or a PyTorch state dict.

    Nothing is unpickled but tensors. The network comes in evaluation mode.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file holds no state dict, or its tensors are not those of this architecture;
            the message names the missing, unexpected and misshapen ones.
    """
    network = UNet()
    load_strictly(network, read_tensors(Path(path)), Path(path))
    return network.eval()


def batch_norms(network: nn.Module) -> Iterator[tuple[str, nn.BatchNorm2d]]:
    """Names and layers of every batch norm (31), in order, for hooks that compare statistics.

    Names that start with ``event_stem.`` and ``depth_stem.`` belong to the two inputs.
    """
    for name, module in network.named_modules():
        if isinstance(module, nn.BatchNorm2d):
            yield name, module
