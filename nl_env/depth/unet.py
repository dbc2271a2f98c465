"""The released network of the paper: ``SUNet2EnResConv``, 16 channels, ReLU, and a loader for its weights.

Two stems (events and depth), three encoder levels and a bottleneck of residual blocks, transposed
convolutions up again with skips, and SoftPlus at the end: depth in metres, without a return head.
The released code's parallel branch is 3x3 where the paper's text says 1x1; this is the released one.
Parameter names follow the released state dict, so that it loads as it is.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterator, Mapping
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from nl_env.types import BINS

CHANNELS = 16
STRIDE = 8
"""Image sides must be multiples of this (three poolings)."""


class ConvBlock(nn.Module):
    """3x3 convolution, batch norm; ReLU unless ``activate`` is False."""

    def __init__(self, inputs: int, outputs: int, activate: bool = True) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)
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
    """The paper's ResConv: convolution and separable convolution, plus a parallel convolution."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv1 = ConvBlock(inputs, outputs)
        self.conv2 = SeparableBlock(outputs, outputs, activate=False)
        self.conv3 = ConvBlock(inputs, outputs, activate=False)

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(self.conv2(self.conv1(x)) + self.conv3(x))


class UpBlock(nn.Module):
    """Doubles the image, joins the encoder's features of that size, and mixes them."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.up = nn.ConvTranspose2d(inputs, outputs, 2, stride=2)
        self.conv = ResidualBlock(inputs, outputs)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        return self.conv(torch.cat([self.up(x), skip], dim=1))


class ReleasedNetwork(nn.Module):
    """Depth now from the last LiDAR frame and the voxel grid of the events since."""

    def __init__(self, channels: int = CHANNELS) -> None:
        super().__init__()
        self.event_stem = SeparableBlock(BINS, channels)
        self.depth_stem = ConvBlock(1, channels)
        self.down1 = ResidualBlock(2 * channels, channels)
        self.down2 = ResidualBlock(channels, 2 * channels)
        self.down3 = ResidualBlock(2 * channels, 4 * channels)
        self.bottleneck = ResidualBlock(4 * channels, 8 * channels)
        self.up1 = UpBlock(8 * channels, 4 * channels)
        self.up2 = UpBlock(4 * channels, 2 * channels)
        self.up3 = UpBlock(2 * channels, channels)
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
        fused = torch.cat([self.event_stem(voxel), self.depth_stem(depth)], dim=1)
        full = self.down1(fused)
        half = self.down2(functional.max_pool2d(full, 2))
        quarter = self.down3(functional.max_pool2d(half, 2))
        deepest = self.bottleneck(functional.max_pool2d(quarter, 2))
        x = self.up3(self.up2(self.up1(deepest, quarter), half), full)
        return functional.softplus(self.head(x))


def load_released(path: str | Path) -> ReleasedNetwork:
    """The released network with the weights of a ``.safetensors`` file or a PyTorch state dict.

    Nothing is unpickled but tensors. The network comes in evaluation mode.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file holds no state dict, or its tensors are not those of this architecture;
            the message names the missing, unexpected and misshapen ones.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"weights: found no file {str(path)!r}")
    network = ReleasedNetwork()
    tensors = _read_tensors(path)
    _check_tensors(path, tensors, network.state_dict())
    network.load_state_dict(tensors)
    return network.eval()


def batch_norms(network: nn.Module) -> Iterator[tuple[str, nn.BatchNorm2d]]:
    """Names and layers of every batch norm (31), in order, for hooks that compare statistics.

    Names that start with ``event_stem.`` and ``depth_stem.`` belong to the two inputs.
    """
    for name, module in network.named_modules():
        if isinstance(module, nn.BatchNorm2d):
            yield name, module


def _read_tensors(path: Path) -> dict[str, Tensor]:
    if path.suffix == ".safetensors":
        from safetensors import SafetensorError
        from safetensors.torch import load_file

        try:
            return load_file(path)
        except SafetensorError as cause:
            raise ValueError(f"weights: found no safetensors data in {str(path)!r} ({cause})") from cause
    try:
        tensors = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError) as cause:
        raise ValueError(
            f"weights: found no plain state dict in {str(path)!r}, expected .safetensors or a state dict"
        ) from cause
    if not isinstance(tensors, Mapping) or not all(isinstance(value, Tensor) for value in tensors.values()):
        raise ValueError(f"weights: found {type(tensors).__name__} in {str(path)!r}, expected a state dict")
    return dict(tensors)


def _check_tensors(path: Path, found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    problems = {
        "missing": sorted(expected.keys() - found.keys()),
        "unexpected": sorted(found.keys() - expected.keys()),
        "of another shape": sorted(
            f"{name} {tuple(found[name].shape)} instead of {tuple(expected[name].shape)}"
            for name in expected.keys() & found.keys()
            if found[name].shape != expected[name].shape
        ),
    }
    listed = "; ".join(f"{kind}: {', '.join(names)}" for kind, names in problems.items() if names)
    if listed:
        raise ValueError(f"weights: {str(path)!r} does not fit the released network, {listed}")
