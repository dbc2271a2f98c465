"""Grey-level textures, made once per process from fixed noise.

Surface textures are mip-mapped, and each texel carries its 2x2 neighbourhood in one ``uint32``: a
bilinear look-up is then a single memory gather, which is what keeps the shading loops in SIMD. Cut-out
textures (leaves, mesh) hold one byte per texel: 0 is a hole, otherwise the grey level.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

SIZE = 256
LEVELS = 7
ROUGH, WINDOW, BRICK, DETAIL, CAR, PLANK, SKY = range(7)
"""Surface textures."""
LEAVES_NEAR, LEAVES_FAR, MESH, TWIGS = (0, 1), (2, 3), 4, 5
"""Cut-out textures; leaves come in two clumps for near and two with coarser holes for far trees."""
UNIT = 128.0
"""Texel value that stands for a factor of 1."""
GAMMA = 1 / 1.05
"""Grey levels are coded as linear ** GAMMA; a product of coded levels is the coded product."""


class Textures(NamedTuple):
    """All textures.

    Attributes:
        packed: ``(sum of level sizes,)`` uint32, every level of every surface texture, see ``offsets``.
        offsets: ``(textures, LEVELS)`` int64 start of each level in ``packed``.
        cutouts: ``(cut-outs * SIZE * SIZE + 3,)`` uint8, one after the other; ``lanes.gather`` reads words.
    """

    packed: NDArray[np.uint32]
    offsets: NDArray[np.int64]
    cutouts: NDArray[np.uint8]


def halve(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Box-filtered half size of an even-sized image."""
    return (image[::2, ::2] + image[1::2, ::2] + image[::2, 1::2] + image[1::2, 1::2]) * np.float32(0.25)


def pack(image: NDArray[np.float32], wrap: bool) -> NDArray[np.uint32]:
    """Four neighbouring texels (right, below, both) beside each texel, one byte each, row-major and flat."""
    texel = np.clip(np.rint(image), 0, 255).astype(np.uint32)
    mode = "wrap" if wrap else "edge"
    padded = np.pad(texel, ((0, 1), (0, 1)), mode=mode)  # type: ignore[call-overload]
    here, right = padded[:-1, :-1], padded[:-1, 1:]
    below, both = padded[1:, :-1], padded[1:, 1:]
    return np.ascontiguousarray(here | right << 8 | below << 16 | both << 24).ravel()


def noise(rng: np.random.Generator, size: int, slope: float) -> NDArray[np.float32]:
    """Periodic Gaussian noise with amplitude spectrum ``1 / f**slope``, zero mean, unit variance."""
    f = np.fft.fftfreq(size)
    radius = np.hypot(*np.meshgrid(f, f))
    radius[0, 0] = 1
    image = np.fft.ifft2(np.fft.fft2(rng.standard_normal((size, size))) / radius**slope).real
    return ((image - image.mean()) / image.std()).astype(np.float32)


def _grain(
    rng: np.random.Generator, contrast: float, slope: float, low: float, high: float
) -> NDArray[np.float32]:
    return np.clip(1 + contrast * noise(rng, SIZE, slope), low, high)


def _surfaces(rng: np.random.Generator) -> list[NDArray[np.float32]]:
    rough = _grain(rng, 0.19, 0.6, 0.35, 1.75)

    window = _grain(rng, 0.08, 0.8, 0.5, 1.5)
    window[60:200, 60:196] = 0.22
    window[60:130, 60:124] = 0.32
    window[60:200, 124:132] = 0.8
    window[56:60, 52:204] = window[200:206, 52:204] = 1.25

    brick = _grain(rng, 0.15, 0.5, 0.4, 1.6)
    for row in range(0, SIZE, 16):
        brick[row : row + 2] *= 1.35
        for column in range(16 * (row // 16 % 2), SIZE, 32):
            brick[row : row + 16, column : column + 2] *= 1.35

    detail = _grain(rng, 0.22, 0.45, 0.35, 1.8)

    car = _grain(rng, 0.05, 0.8, 0.6, 1.4)
    car[40:120, 20:236] = 0.18
    car[40:120, 124:132] = 0.9
    car[180:184] = 0.5

    plank = _grain(rng, 0.3, 1.0, 0.3, 1.9)
    plank[:, ::32] *= 0.6

    sky = _grain(rng, 0.12, 1.5, 0.6, 1.4)
    return [rough, window, brick, detail, car, plank, sky]


def _crown(rng: np.random.Generator, fine: float, coarse: float, filled: float) -> NDArray[np.bool_]:
    """A ragged round clump of leaves: noise at two scales (texels), thinning out towards the rim."""
    layers = [gaussian_filter(rng.standard_normal((SIZE, SIZE)), s, mode="wrap") for s in (fine, coarse)]
    mixed = layers[0] / layers[0].std() + 0.8 * layers[1] / layers[1].std()
    yy, xx = np.mgrid[:SIZE, :SIZE] * (2.0 / SIZE) - 1.0
    radius = np.hypot(xx, yy)
    mixed -= 3.0 * np.clip(radius - 0.55, 0, None)
    inside = radius < 0.97
    return inside & (mixed > np.quantile(mixed[inside], 1 - filled))


def _twigs(rng: np.random.Generator) -> NDArray[np.bool_]:
    mask = np.zeros((SIZE, SIZE), bool)
    for _ in range(60):
        point, direction = np.array([SIZE / 2, SIZE - 1.0]), -np.pi / 2 + rng.normal() * 0.3
        for step in range(14):
            width = max(1, 6 - step)
            for _ in range(28):
                point = point + 0.5 * np.array([np.cos(direction), np.sin(direction)])
                x, y = int(point[0]), int(point[1])
                if 0 <= x < SIZE and 0 <= y < SIZE:
                    mask[
                        max(0, y - width // 2) : y + width // 2 + 1,
                        max(0, x - width // 2) : x + width // 2 + 1,
                    ] = True
            direction += rng.normal() * 0.5
    return mask


@lru_cache(maxsize=1)
def load() -> Textures:
    """Make the textures; the same bytes in every process."""
    rng = np.random.default_rng(5)
    packed: list[NDArray[np.uint32]] = []
    offsets: list[list[int]] = []
    start = 0
    for surface in _surfaces(rng):
        image = surface ** np.float32(GAMMA) * np.float32(UNIT)
        row = []
        for _ in range(LEVELS):
            row.append(start)
            packed.append(pack(image, wrap=True))
            start += packed[-1].size
            image = halve(image)
        offsets.append(row)
    leaf = np.clip(_grain(rng, 0.44, 0.35, 0.2, 1.95) ** GAMMA * UNIT, 1, 255)
    yy, xx = np.mgrid[:SIZE, :SIZE]
    mesh = ((xx + yy) % 32 < 5) | ((xx - yy) % 32 < 5)
    masks = [
        *(_crown(rng, 5, 24, 0.72) for _ in LEAVES_NEAR),
        *(_crown(rng, 9, 40, 0.75) for _ in LEAVES_FAR),
        mesh,
        _twigs(rng),
    ]
    plain = np.full_like(leaf, UNIT)
    shades = [leaf] * 4 + [plain] * 2
    cutouts = [np.where(m, s, 0).astype(np.uint8).ravel() for m, s in zip(masks, shades, strict=True)]
    spare = np.zeros(3, np.uint8)
    return Textures(np.concatenate(packed), np.array(offsets, np.int64), np.concatenate([*cutouts, spare]))
