"""The depth extrapolators an environment can be given, and the factory that finds them by name.

Importing this module does not import PyTorch; only the networks do, when they are made.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nl_env.depth import baselines
from nl_env.depth.metrics import returns_from_depth
from nl_env.depth.motion import continued, estimate_motion
from nl_env.depth.warp import warp
from nl_env.representations import voxel_from_bins
from nl_env.types import DepthExtrapolator, Extrapolation, ExtrapolationInput

WEIGHTS = Path(__file__).parents[1] / "weights"
WEIGHT_SUFFIXES = (".safetensors", ".pth", ".pt")


class Repeat:
    """The last LiDAR frame again."""

    history = 1
    odometry = False

    def reset(self) -> None:
        """Nothing to forget."""

    def __call__(self, inputs: ExtrapolationInput) -> Extrapolation:
        return Extrapolation(baselines.repeat(inputs.lidar_frames[-1]))


class Linear:
    """A straight line through the last two LiDAR frames per pixel; repeats while there is only one."""

    history = 2
    odometry = False

    def reset(self) -> None:
        """Nothing to forget."""

    def __call__(self, inputs: ExtrapolationInput) -> Extrapolation:
        if len(inputs.lidar_frames) < 2:
            return Extrapolation(inputs.lidar_frames[-1])
        previous, last = inputs.lidar_frames[-2:]
        period, gap = _period_and_gap(inputs)
        return Extrapolation(baselines.linear(previous, last, period, gap, inputs.max_depth))


class Exponential:
    """The paper's exponential through the last two LiDAR frames; repeats while there is only one."""

    history = 2
    odometry = False

    def reset(self) -> None:
        """Nothing to forget."""

    def __call__(self, inputs: ExtrapolationInput) -> Extrapolation:
        if len(inputs.lidar_frames) < 2:
            return Extrapolation(inputs.lidar_frames[-1])
        previous, last = inputs.lidar_frames[-2:]
        return Extrapolation(
            baselines.exponential(previous, last, *_period_and_gap(inputs), inputs.max_depth)
        )


class Warp:
    """The last LiDAR frame, moved as the ego motion says; holes keep the frame's own value.

    The motion is estimated between the last two LiDAR frames, once per LiDAR frame, and continued at
    constant velocity; with one frame only, the vehicle is taken to stand still. The estimate depends
    on these two frames alone, never on when the extrapolator was triggered before.

    Args:
        odometry: use the true poses instead.
    """

    history = 2

    def __init__(self, odometry: bool = False) -> None:
        self.odometry = odometry
        self.reset()

    def reset(self) -> None:
        """Forget the estimated motion."""
        self._frames: tuple[NDArray[np.float32], ...] = ()
        self._motion = np.eye(4)

    def __call__(self, inputs: ExtrapolationInput) -> Extrapolation:
        last = inputs.lidar_frames[-1]
        if self.odometry:
            motion = np.linalg.inv(inputs.poses[-1]) @ inputs.poses[-2]
        elif len(inputs.lidar_frames) < 2:
            return Extrapolation(last)
        else:
            period, gap = _period_and_gap(inputs)
            motion = continued(self._estimated(inputs), gap / period)
        return Extrapolation(warp(last, inputs.camera, motion, inputs.max_depth))

    def _estimated(self, inputs: ExtrapolationInput) -> NDArray[np.float64]:
        """Motion between the last two LiDAR frames, kept until another frame arrives."""
        previous, last = inputs.lidar_frames[-2:]
        if not (self._frames and self._frames[0] is previous and self._frames[1] is last):
            self._motion = estimate_motion(previous, last, inputs.camera, inputs.max_depth)
            self._frames = (previous, last)
        return self._motion


class ReleasedUNet:
    """The paper's network with the weights at ``path`` (a state dict or ``.safetensors``).

    It has no return head: depths below ``min_return`` metres are read as "no return", and the depth
    as the network gave it is what the paper's metrics see.

    Raises:
        FileNotFoundError: no file at ``path``.
        ValueError: the file does not hold the released network's weights.
        ImportError: PyTorch is not installed (``pip install nl-env[torch]``).
    """

    history = 1
    odometry = False

    def __init__(self, path: str | os.PathLike[str], min_return: float = 1.0) -> None:
        try:
            from nl_env.depth.unet import load_released
        except ImportError as cause:
            raise ImportError("extrapolator: networks need PyTorch, pip install 'nl-env[torch]'") from cause

        self._network = load_released(Path(path))
        self._min_return = min_return

    def reset(self) -> None:
        """Nothing to forget."""

    def __call__(self, inputs: ExtrapolationInput) -> Extrapolation:
        import torch

        prior = inputs.lidar_frames[-1]
        prior = np.where(prior < inputs.max_depth, prior, np.float32(0))
        voxel = voxel_from_bins(inputs.bins)
        with torch.inference_mode():
            predicted = self._network(torch.from_numpy(prior)[None, None], torch.from_numpy(voxel)[None])
        depth = predicted[0, 0].numpy()
        return Extrapolation(returns_from_depth(depth, self._min_return), depth_if_return=depth)


NETWORKS = {"unet": "our motion warp and U-Net", "unet-paper": "the paper's network"}
NAMES = ("repeat", "linear", "exponential", "warp", *NETWORKS)


def make_extrapolator(
    spec: str | os.PathLike[str] | DepthExtrapolator, odometry: bool = False
) -> DepthExtrapolator:
    """The extrapolator behind a name, a path to weights, or an object that is one already.

    Args:
        spec: one of ``NAMES``; a path to the released network's weights (anything with a folder or
            one of ``WEIGHT_SUFFIXES`` in it); or an object following ``DepthExtrapolator``.
        odometry: let ``"warp"`` use true poses; the other names have no use for them.

    Raises:
        ValueError: unknown name (the valid ones are listed), or a file of other weights.
        FileNotFoundError: no such file, or the weights of a named network are not installed.
        TypeError: an object that does not follow ``DepthExtrapolator``.
    """
    if not isinstance(spec, (str, os.PathLike)):
        if isinstance(spec, type) or not isinstance(spec, DepthExtrapolator):
            raise TypeError(f"extrapolator: found {spec!r}, expected a name, a path or a DepthExtrapolator")
        return spec
    name = os.fspath(spec)
    if name == "repeat":
        return Repeat()
    if name == "linear":
        return Linear()
    if name == "exponential":
        return Exponential()
    if name == "warp":
        return Warp(odometry)
    if name in NETWORKS:
        path = WEIGHTS / f"{name}.safetensors"
        if not path.is_file():
            raise FileNotFoundError(
                f"extrapolator: {name!r} ({NETWORKS[name]}) needs its weights, nl_env/weights/{path.name}, "
                f"which are not shipped yet; give a path to weights or one of {', '.join(NAMES[:4])}"
            )
        return ReleasedUNet(path)
    if isinstance(spec, os.PathLike) or Path(name).suffix in WEIGHT_SUFFIXES or os.sep in name:
        return ReleasedUNet(name)
    raise ValueError(
        f"extrapolator: found {name!r}, expected one of {', '.join(NAMES)}, or a path to weights"
    )


def _period_and_gap(inputs: ExtrapolationInput) -> tuple[float, float]:
    """Seconds between the last two LiDAR frames, and from the last one to the wanted frame."""
    before, last = inputs.lidar_times[-2:]
    return (last - before) * 1e-6, (inputs.t - last) * 1e-6
