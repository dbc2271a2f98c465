"""The authors' checkpoint as a probe: its error, falsification controls, and the input of its batch norms."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor

CONTROLS = ("network", "no events", "time reversed", "sky at 200 m")
"""The checkpoint as it is, and three ways of feeding it wrongly that must destroy its gain."""
SKY_CONTROL = 200.0
"""Prior depth of the sky in the last control, m; the network was trained with 0."""

Moments = NDArray[np.float64]
"""``(gaps, layers, channels, 2)`` mean and mean square at each batch norm, zero beyond a layer's channels."""


class ReleasedProbe:
    """The released network, counting what arrives at its batch norms.

    Args:
        checkpoint: its state dict.
        gaps: number of gaps whose statistics are kept apart.

    Attributes:
        moments: sums of mean and mean square over the predictions so far.
    """

    def __init__(self, checkpoint: str, gaps: int) -> None:
        import torch

        from nl_env.depth.unet import batch_norms, load_released

        # One thread, so that results do not depend on how worlds are spread over processes.
        torch.set_num_threads(1)
        self._network = load_released(checkpoint)
        self._network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        layers = [layer for _, layer in batch_norms(self._network)]
        widest = max(layer.num_features for layer in layers)
        self.moments: Moments = np.zeros((gaps, len(layers), widest, 2))
        self._gap: int | None = None
        for index, layer in enumerate(layers):
            layer.register_forward_pre_hook(lambda _, inputs, index=index: self._count(index, inputs[0]))

    def predict(
        self,
        prior: NDArray[np.float32],
        voxel: NDArray[np.float32],
        gap: int,
        controls: Sequence[str] = CONTROLS,
    ) -> list[NDArray[np.float32]]:
        """Depth ``(H, W)`` m under each of ``controls``; only the unaltered inputs are counted.

        Args:
            prior: ``(H, W)`` m, 0 = no return.
            voxel: ``(5, H, W)`` signed event counts.
            gap: index under which the statistics are kept.
            controls: names out of ``CONTROLS``.
        """
        inputs = {
            "network": (prior, voxel),
            "no events": (prior, np.zeros_like(voxel)),
            "time reversed": (prior, voxel[::-1].copy()),
            "sky at 200 m": (np.where(prior == 0, np.float32(SKY_CONTROL), prior), voxel),
        }
        return [self._run(*inputs[name], gap if name == "network" else None) for name in controls]

    def _run(
        self, prior: NDArray[np.float32], voxel: NDArray[np.float32], gap: int | None
    ) -> NDArray[np.float32]:
        import torch

        self._gap = gap
        with torch.inference_mode():
            depth: NDArray[np.float32] = self._network(
                torch.from_numpy(prior)[None, None], torch.from_numpy(voxel)[None]
            )[0, 0].numpy()
        return depth

    def _count(self, layer: int, x: Tensor) -> None:
        """Add the moments of the input ``(1, C, H, W)`` of a batch norm."""
        if self._gap is not None:
            sums = self.moments[self._gap, layer, : x.shape[1]]
            sums[:, 0] += x.mean((0, 2, 3)).numpy()
            sums[:, 1] += (x * x).mean((0, 2, 3)).numpy()


def batch_norm_distance(checkpoint: str, moments: Moments, probed: int) -> list[tuple[str, float]]:
    """How far what arrives at each batch norm is from what it saw in training.

    Per channel the symmetric Kullback-Leibler divergence (the sum of both directions) of two Gaussians: one
    with the mean and variance of our samples, the five gaps mixed evenly, one with the running mean and
    variance. Per layer the median over channels, because channels that are always zero have no variance and
    explode.

    Args:
        checkpoint: the released state dict.
        moments: :attr:`ReleasedProbe.moments`, summed over worlds.
        probed: number of pairs in ``moments``, at least 1.

    Returns:
        ``(layer name, distance)`` of each of the 31 layers.
    """
    from nl_env.depth.unet import batch_norms, load_released

    if probed < 1:
        raise ValueError(f"probed: found {probed}, expected at least one pair")
    rows = []
    for index, (name, layer) in enumerate(batch_norms(load_released(checkpoint))):
        if layer.running_mean is None or layer.running_var is None:
            raise ValueError(f"checkpoint: found batch norm {name} without running statistics")
        mean, square = (moments[:, index, : layer.num_features] / probed).mean(axis=0).T
        distance = symmetric_divergence(
            mean, square - mean**2, layer.running_mean.double().numpy(), layer.running_var.double().numpy()
        )
        rows.append((name, float(np.median(distance))))
    return rows


def symmetric_divergence(
    mean: NDArray[np.float64],
    variance: NDArray[np.float64],
    other_mean: NDArray[np.float64],
    other_variance: NDArray[np.float64],
) -> NDArray[np.float64]:
    """KL(p, q) + KL(q, p) of Gaussians, element by element; variances below 1e-12 are read as 1e-12."""
    a, b = np.maximum(variance, 1e-12), np.maximum(other_variance, 1e-12)
    return np.asarray(0.5 * (a / b + b / a - 2 + (mean - other_mean) ** 2 * (1 / a + 1 / b)), np.float64)
