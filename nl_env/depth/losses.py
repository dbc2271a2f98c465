"""The METER loss that the paper trains its extrapolation network with, at a fraction of the usual cost.

Four parts over whole images, in which a pixel without return counts as depth 0, as in the released code:
squared error, structural similarity (SSIM), differences of Sobel gradients, and angles between the normals
those gradients give. The same values and gradients as written out pixel by pixel with 2-D convolutions;
cheaper because the Gaussian window is a product of two banded matrices, Sobel's kernels are sums of shifted
images shared by two parts, and nothing is differentiated with respect to the target.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor
from torch.nn import functional

WINDOW, WINDOW_SIGMA = 11, 1.5
"""SSIM's Gaussian window, pixels."""


@dataclass(frozen=True)
class MeterWeights:
    """How much each part counts."""

    depth: float
    """Squared error, m^2 (METER itself: L1)."""
    ssim: float
    """1 - SSIM."""
    gradient: float
    """Mean absolute difference of Sobel gradients, horizontal plus vertical."""
    normal: float
    """Mean of 1 - cosine between surface normals."""


RELEASED_WEIGHTS = MeterWeights(depth=1.0, ssim=10.0, gradient=0.01, normal=1.0)
"""What the released code uses."""

PAPER_WEIGHTS = MeterWeights(depth=1.0, ssim=1.0, gradient=10.0, normal=0.01)
"""What the paper's text says: lambda_2 = 10, lambda_3 = .01, lambda_4 = 1 for gradient, normal and SSIM."""


def meter_loss(
    predicted: Tensor,
    target: Tensor,
    weights: MeterWeights = RELEASED_WEIGHTS,
    max_depth: float = 200.0,
) -> tuple[Tensor, dict[str, Tensor]]:
    """The weighted sum, and its four parts before weighting.

    Args:
        predicted: ``(N, 1, H, W)`` m, float32.
        target: the same shape; 0 = no return. Values above ``max_depth`` are read as no return too.
        weights: of the parts; a part of weight 0 is neither computed nor returned.
        max_depth: range of values that SSIM assumes, m.

    Raises:
        ValueError: shapes differ or are not one-channel images, or a tensor is not float32.
    """
    if predicted.shape != target.shape or predicted.dim() != 4 or predicted.shape[1] != 1:
        raise ValueError(
            f"predicted and target: found shapes {tuple(predicted.shape)} and {tuple(target.shape)}, "
            "expected (N, 1, H, W) twice"
        )
    if predicted.dtype != torch.float32 or target.dtype != torch.float32:
        raise ValueError(
            f"predicted and target: found {predicted.dtype} and {target.dtype}, expected float32: "
            "squares of depths do not fit in half precision"
        )
    with torch.autocast(predicted.device.type, enabled=False):
        target = torch.where(target > max_depth, 0.0, target.detach())
        parts: dict[str, Tensor] = {}
        if weights.depth:
            parts["depth"] = functional.mse_loss(predicted, target)
        if weights.ssim:
            parts["ssim"] = 1 - ssim(predicted, target, max_depth)
        if weights.gradient or weights.normal:
            slopes, true_slopes = sobel(predicted), sobel(target)
            if weights.gradient:
                x, y = (mine - true for mine, true in zip(slopes, true_slopes, strict=True))
                parts["gradient"] = x.abs().mean() + y.abs().mean()
            if weights.normal:
                parts["normal"] = _normal_difference(slopes, true_slopes)
        total = predicted.new_zeros(())
        for name, part in parts.items():
            total = total + getattr(weights, name) * part
    return total, parts


def ssim(image: Tensor, reference: Tensor, value_range: float) -> Tensor:
    """Mean structural similarity of ``(N, 1, H, W)`` images, 1 where they are equal.

    Windows lie wholly inside the image; one smaller than the window takes a window of its own size.
    ``reference`` gets no gradient.
    """
    height, width = image.shape[-2:]
    window = min(WINDOW, height, width)
    rows = _gaussian_band(height, window, image.device).T
    columns = _gaussian_band(width, window, image.device)

    def smooth(*images: Tensor) -> tuple[Tensor, ...]:
        return (rows @ (torch.cat(images) @ columns)).chunk(len(images))

    with torch.no_grad():
        mean_r, square_r = smooth(reference, reference * reference)
    mean_i, square_i, cross = smooth(image, image * image, image * reference)
    small, smaller = (0.03 * value_range) ** 2, (0.01 * value_range) ** 2
    means, squares = mean_i * mean_r, mean_i * mean_i + mean_r * mean_r
    contrast = (2 * (cross - means) + small) / (square_i + square_r - squares + small)
    return ((2 * means + smaller) / (squares + smaller) * contrast).mean()


def sobel(image: Tensor) -> tuple[Tensor, Tensor]:
    """Horizontal and vertical Sobel gradient of ``(N, 1, H, W)``, left minus right and top minus bottom.

    Beyond the image lie zeros.
    """
    padded = functional.pad(image, (1, 1, 1, 1))
    down = padded[..., :-2, :] + 2 * padded[..., 1:-1, :] + padded[..., 2:, :]
    across = padded[..., :-2] + 2 * padded[..., 1:-1] + padded[..., 2:]
    return down[..., :-2] - down[..., 2:], across[..., :-2, :] - across[..., 2:, :]


def _normal_difference(slopes: tuple[Tensor, Tensor], true_slopes: tuple[Tensor, Tensor]) -> Tensor:
    """Mean of 1 - cosine between the normals ``(-x, -y, 1)`` of two pairs of slopes."""
    (x, y), (true_x, true_y) = slopes, true_slopes
    with torch.no_grad():
        true_length = true_x * true_x + true_y * true_y + 1
    dot = x * true_x + y * true_y + 1
    return (1 - dot * torch.rsqrt((x * x + y * y + 1) * true_length)).abs().mean()


@lru_cache(maxsize=8)
def _gaussian_band(size: int, window: int, device: torch.device) -> Tensor:
    """``(size, size - window + 1)``: column ``i`` weighs the pixels ``i`` to ``i + window - 1``."""
    offsets = range(-(window // 2), window - window // 2)
    weights = torch.tensor([math.exp(-0.5 * (x / WINDOW_SIGMA) ** 2) for x in offsets])
    weights /= weights.sum()
    band = torch.zeros(size, size - window + 1)
    for start in range(band.shape[1]):
        band[start : start + window, start] = weights
    return band.to(device)
