"""The fast loss against the same one written out with 2-D convolutions, and against cases known by hand."""

import pytest
import torch
from torch.nn import functional

from nl_env.depth.losses import (
    PAPER_WEIGHTS,
    RELEASED_WEIGHTS,
    MeterWeights,
    meter_loss,
    sobel,
    ssim,
)

SOBEL = torch.tensor([[1.0, 0, -1], [2, 0, -2], [1, 0, -1]])


def written_out(predicted, target, weights, max_depth=200.0):
    """One convolution per quantity, every operand spelt out."""
    window = min(11, *predicted.shape[-2:])
    x = torch.arange(window, dtype=predicted.dtype) - window // 2
    gaussian = torch.exp(-(x**2) / (2 * 1.5**2))
    gaussian = gaussian / gaussian.sum()
    kernel = torch.outer(gaussian, gaussian)[None, None]
    mean_p, mean_t = functional.conv2d(predicted, kernel), functional.conv2d(target, kernel)
    var_p = functional.conv2d(predicted**2, kernel) - mean_p**2
    var_t = functional.conv2d(target**2, kernel) - mean_t**2
    covariance = functional.conv2d(predicted * target, kernel) - mean_p * mean_t
    c1, c2 = (0.01 * max_depth) ** 2, (0.03 * max_depth) ** 2
    luminance = (2 * mean_p * mean_t + c1) / (mean_p**2 + mean_t**2 + c1)
    similarity = (luminance * (2 * covariance + c2) / (var_p + var_t + c2)).mean()

    kernels = torch.stack([SOBEL, SOBEL.T])[:, None].to(predicted.dtype)
    edges_p = functional.conv2d(predicted, kernels, padding=1)
    edges_t = functional.conv2d(target, kernels, padding=1)
    differences = (edges_p - edges_t).abs()
    gradient = differences[:, 0].mean() + differences[:, 1].mean()
    ones = torch.ones_like(target)
    cosine = functional.cosine_similarity(
        torch.cat([-edges_p, ones], 1), torch.cat([-edges_t, ones], 1), dim=1
    )
    parts = {
        "depth": ((predicted - target) ** 2).mean(),
        "ssim": 1 - similarity,
        "gradient": gradient,
        "normal": (1 - cosine).abs().mean(),
    }
    return sum(getattr(weights, name) * part for name, part in parts.items()), parts


def depths(seed, shape=(2, 1, 24, 33)):
    """Blocky scenes with sky, and a guess that is off."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(shape[0], 1, 4, 5, generator=generator) * 80
    coarse[:, :, 0] = 0
    target = functional.interpolate(coarse, shape[-2:])
    predicted = (target + 4 * torch.randn(shape, generator=generator)).clamp(min=0.01)
    return predicted, target


@pytest.mark.parametrize("weights", [RELEASED_WEIGHTS, PAPER_WEIGHTS])
@pytest.mark.parametrize("shape", [(2, 1, 24, 33), (1, 1, 8, 16)])
def test_value_and_gradient_are_those_of_the_loss_written_out(weights, shape):
    predicted, target = depths(0, shape)
    fast, exact = predicted.clone().requires_grad_(), predicted.double().requires_grad_()
    total, parts = meter_loss(fast, target, weights)
    expected, expected_parts = written_out(exact, target.double(), weights)
    total.backward()
    expected.backward()
    assert total.item() == pytest.approx(expected.item(), rel=1e-5)
    assert parts.keys() == expected_parts.keys()
    for name, part in parts.items():
        assert part.item() == pytest.approx(expected_parts[name].item(), rel=1e-4)
    error = (fast.grad - exact.grad).norm() / exact.grad.norm()
    assert error < 1e-5


def test_a_perfect_answer_costs_nothing_and_a_worse_one_more():
    _, target = depths(1)
    perfect, _ = meter_loss(target, target)
    near, _ = meter_loss(target + 0.5, target)
    far, _ = meter_loss(target + 5, target)
    assert float(perfect) == pytest.approx(0, abs=1e-4)
    assert perfect < near < far


def test_parts_of_a_known_case():
    # A ramp of 1 m a pixel against a plane: horizontal Sobel -8 inside, so the cosine is 1/sqrt(65).
    target = torch.full((1, 1, 40, 40), 30.0)
    ramp = (10 + torch.arange(40.0)).expand(1, 1, 40, 40).contiguous()
    horizontal, vertical = (edges[..., 1:-1, 1:-1] for edges in sobel(ramp))
    assert (horizontal == -8).all() and (vertical == 0).all()
    _, parts = meter_loss(ramp, target, MeterWeights(depth=0, ssim=0, gradient=0, normal=1))
    inside = (38 / 40) ** 2  # beyond the border lie zeros, which slope either image
    assert float(parts["normal"]) == pytest.approx((1 - 65**-0.5) * inside, abs=1 - inside)
    assert parts.keys() == {"normal"}
    shift, parts = meter_loss(target + 3, target, MeterWeights(depth=1, ssim=0, gradient=0, normal=0))
    assert float(shift) == float(parts["depth"]) == pytest.approx(9)


def test_ssim_of_constants():
    # Without contrast only the means count: (2 a b + c) / (a^2 + b^2 + c), c = (0.01 * 200)^2.
    a, b = torch.full((1, 1, 16, 16), 3.0), torch.full((1, 1, 16, 16), 5.0)
    assert float(ssim(a, b, 200.0)) == pytest.approx(34 / 38, rel=1e-5)
    assert float(ssim(a, a, 200.0)) == pytest.approx(1, rel=1e-6)


def test_no_return_is_zero_and_so_is_beyond_range():
    predicted, target = depths(2)
    beyond = torch.where(target == 0, 250.0, target)
    assert (target == 0).any()
    assert meter_loss(predicted, beyond)[0] == meter_loss(predicted, target)[0]


def test_autocast_does_not_reach_inside():
    predicted, target = depths(3)
    expected, _ = meter_loss(predicted, target)
    with torch.autocast("cpu", torch.bfloat16):
        assert meter_loss(predicted, target)[0] == expected


def test_bad_input():
    predicted, target = depths(4)
    with pytest.raises(ValueError, match=r"found shapes \(2, 1, 24, 33\) and \(2, 1, 24, 32\)"):
        meter_loss(predicted, target[..., :-1])
    with pytest.raises(ValueError, match=r"expected \(N, 1, H, W\) twice"):
        meter_loss(predicted[:, 0], target[:, 0])
    with pytest.raises(ValueError, match=r"found torch\.bfloat16 and torch\.float32"):
        meter_loss(predicted.bfloat16(), target)
