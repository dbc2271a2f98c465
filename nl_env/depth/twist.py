"""The camera's motion over a gap from what its events say about a first guess, without PyTorch.

Events are compensated: every temporal bin is moved along the flow of the guess, so that with the right
motion all bins show the same edges at the same places. How the bins drift against each other is the flow
that the guess lacks, as far as there are edges across it (the optical flow equation, summed over cells of
the image). The flow that a small motion induces is linear in its twist, given inverse depth, so all cells
together are one least squares problem with six unknowns, held towards zero by how far guesses are off as
a rule. The motion network (:mod:`nl_env.depth.motion_network`) says which cells to believe, and how much.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from nl_env.depth.features import CHANNELS, EVENTS, GAP_UNIT, INVERSE_SCALE
from nl_env.depth.motion import se3_exp
from nl_env.types import Camera

CELL = 4
"""Side of a cell, pixels."""

SPREAD = (0.004, 0.004, 0.05, 1e-3, 2e-4, 6e-4)
"""How far the continued motion is off over ``GAP_UNIT``, per component of the twist: m, then rad."""

WARPED_INVERSE = CHANNELS.index("warped inverse depth")


def drift(stack: NDArray[np.float32]) -> NDArray[np.float32]:
    """What the compensated bins of features ``(C, H, W)`` say about the missing flow, per cell.

    Returns:
        ``(5, H/4, W/4)``: sums over the cell of ``gx gx``, ``gx gy``, ``gy gy``, ``-gx d``, ``-gy d``, where
        ``g`` is the gradient of the bins' mean and ``d`` their change over the gap: the first three times
        the missing flow (px over the gap) should be the last two.
    """
    _, height, width = stack.shape
    sums = np.empty((5, height // CELL, width // CELL), np.float32)
    _add_drift(stack[EVENTS], sums)
    return sums


def cell_inverse(stack: NDArray[np.float32]) -> NDArray[np.float64]:
    """``(H/4, W/4)`` mean inverse depth of the warped frame per cell, 1/m, of features ``(C, H, W)``."""
    image = stack[WARPED_INVERSE]
    height, width = image.shape
    blocks = image.reshape(height // CELL, CELL, width // CELL, CELL)
    return blocks.mean((1, 3), dtype=np.float64) / INVERSE_SCALE


def flow_jacobian(camera: Camera, inverse: NDArray[np.float64]) -> NDArray[np.float64]:
    """Flow in pixels per twist (m, rad; applied in the camera's frame), ``(H/4, W/4, 2, 6)``.

    Args:
        camera: intrinsics of the whole image.
        inverse: ``(H/4, W/4)`` inverse depth of the cells, 1/m.
    """
    rows, columns = inverse.shape
    x = ((np.arange(columns) * CELL + (CELL - 1) / 2 - camera.cx) / camera.fx)[None, :] + 0 * inverse
    y = ((np.arange(rows) * CELL + (CELL - 1) / 2 - camera.cy) / camera.fy)[:, None] + 0 * inverse
    zero = np.zeros_like(inverse)
    across = np.stack([inverse, zero, -x * inverse, -x * y, 1 + x * x, -y], axis=-1) * camera.fx
    down = np.stack([zero, inverse, -y * inverse, -1 - y * y, x * y, x], axis=-1) * camera.fy
    return np.stack([across, down], axis=-2)


def solve_twist(
    answer: NDArray[np.float32], drifts: NDArray[np.float32], jacobian: NDArray[np.float64], gap: float
) -> NDArray[np.float64]:
    """The correction ``(6,)`` that explains the drift best, to be applied after the guess.

    Args:
        answer: ``(2, H/4, W/4)`` of the motion network: weight of a cell, and how far its flow is to be
            scaled (noise in the gradients makes it look smaller than it is).
        drifts: of :func:`drift`.
        jacobian: of :func:`flow_jacobian`.
        gap: s.
    """
    weight, scale = answer.astype(np.float64)
    xx, xy, yy, xd, yd = drifts.astype(np.float64) * weight
    spread = np.array(SPREAD) * gap / GAP_UNIT
    across, down = jacobian[..., 0, :] * spread, jacobian[..., 1, :] * spread
    pulled_across = xx[..., None] * across + xy[..., None] * down
    pulled_down = xy[..., None] * across + yy[..., None] * down
    normal = np.einsum("yxi,yxj->ij", across, pulled_across) + np.einsum("yxi,yxj->ij", down, pulled_down)
    right = np.einsum("yxi,yx->i", across, xd * scale) + np.einsum("yxi,yx->i", down, yd * scale)
    return np.linalg.solve(normal + np.eye(6), right) * spread


def corrected(
    motion: NDArray[np.float64],
    answer: NDArray[np.float32],
    stack: NDArray[np.float32],
    camera: Camera,
    gap: float,
) -> NDArray[np.float64]:
    """``motion`` (4x4) with the correction that the motion network gives.

    Args:
        motion: the guess, with which ``stack`` was made.
        answer: ``(2, H/4, W/4)`` of the network.
        stack: ``(C, H, W)``, the features it saw, with compensated events.
        camera: intrinsics of the image.
        gap: s.
    """
    jacobian = flow_jacobian(camera, cell_inverse(stack))
    return se3_exp(solve_twist(answer, drift(stack), jacobian, gap)) @ motion


@njit(cache=True, error_model="numpy")
def _add_drift(bins, sums):  # type: ignore[no-untyped-def]
    """Sums of products per cell, of bins blurred by a 3x3 binomial; the image's border has no say."""
    count, height, width = bins.shape
    mean = np.zeros((height, width), np.float32)
    change = np.zeros((height, width), np.float32)
    steps = np.float32(0)
    for k in range(count):
        steps += np.float32(((k + 0.5) / count - 0.5) ** 2)
    for k in range(count):
        place = np.float32((k + 0.5) / count - 0.5) / steps
        for y in range(height):
            for x in range(width):
                mean[y, x] += bins[k, y, x] / np.float32(count)
                change[y, x] += place * bins[k, y, x]
    mean, change = _blurred(mean), _blurred(change)
    sums[:] = 0
    half = np.float32(0.5)
    for y in range(2, height - 2):
        for x in range(2, width - 2):
            gx = half * (mean[y, x + 1] - mean[y, x - 1])
            gy = half * (mean[y + 1, x] - mean[y - 1, x])
            d = change[y, x]
            cell = sums[:, y // CELL, x // CELL]
            cell[0] += gx * gx
            cell[1] += gx * gy
            cell[2] += gy * gy
            cell[3] -= gx * d
            cell[4] -= gy * d


@njit(cache=True, error_model="numpy")
def _blurred(image):  # type: ignore[no-untyped-def]
    height, width = image.shape
    out = np.zeros_like(image)
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            above = image[y - 1, x - 1] + 2 * image[y - 1, x] + image[y - 1, x + 1]
            here = image[y, x - 1] + 2 * image[y, x] + image[y, x + 1]
            below = image[y + 1, x - 1] + 2 * image[y + 1, x] + image[y + 1, x + 1]
            out[y, x] = (above + 2 * here + below) / np.float32(16)
    return out
