"""The depth extrapolators an environment can be given, and the factory that finds them by name.

Importing this module does not import PyTorch; only the networks do, when they are made.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from nl_env.depth import baselines
from nl_env.depth.exported import load_parts, read_export
from nl_env.depth.learned import MotionWarpRefine
from nl_env.depth.metrics import returns_from_depth
from nl_env.depth.motion import IntervalMotion
from nl_env.depth.runtime import RUNTIMES, CompiledNetwork, NetworkRunner
from nl_env.depth.warp import warp
from nl_env.representations import voxel_from_bins
from nl_env.types import DepthExtrapolator, Extrapolation, ExtrapolationInput

if TYPE_CHECKING:
    from torch import nn

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
        self._interval = IntervalMotion()

    def __call__(self, inputs: ExtrapolationInput) -> Extrapolation:
        last = inputs.lidar_frames[-1]
        if self.odometry:
            motion = np.linalg.inv(inputs.poses[-1]) @ inputs.poses[-2]
        elif len(inputs.lidar_frames) < 2:
            return Extrapolation(last)
        else:
            period, gap = _period_and_gap(inputs)
            previous, last = inputs.lidar_frames[-2:]
            self._interval(previous, last, inputs.camera, inputs.max_depth)
            motion = self._interval.continued(gap / period)
        return Extrapolation(warp(last, inputs.camera, motion, inputs.max_depth))


class PaperUNet:
    """The paper's network, released or a variant: depth now from the last LiDAR frame and the events since.

    It has no return head: depths below ``min_return`` metres are read as "no return", and the depth
    as the network gave it is what the paper's metrics see.

    Args:
        network: ``(n, 1, H, W)`` m and ``(n, 5, H, W)`` counts to ``(n, 1, H, W)`` m, in some runtime.
        min_return: m.
    """

    history = 1
    odometry = False

    def __init__(
        self, network: Callable[..., tuple[NDArray[np.float32], ...]], min_return: float = 1.0
    ) -> None:
        self._network = network
        self._min_return = min_return

    def reset(self) -> None:
        """Nothing to forget."""

    def __call__(self, inputs: ExtrapolationInput) -> Extrapolation:
        return self.batch([inputs])[0]

    def batch(self, inputs: Sequence[ExtrapolationInput]) -> list[Extrapolation]:
        """As :class:`nl_env.types.BatchExtrapolator`: one run of the network for all of them."""
        priors = [
            np.where(one.lidar_frames[-1] < one.max_depth, one.lidar_frames[-1], np.float32(0))
            for one in inputs
        ]
        voxels = [voxel_from_bins(one.bins) for one in inputs]
        (predicted,) = self._network(np.stack(priors)[:, None], np.stack(voxels))
        return [
            Extrapolation(returns_from_depth(depth, self._min_return), depth_if_return=depth)
            for depth in predicted[:, 0]
        ]


NETWORKS = {"unet": "our motion warp and U-Net", "unet-paper": "the paper's network"}
NAMES = ("repeat", "linear", "exponential", "warp", *NETWORKS)


def make_extrapolator(
    spec: str | os.PathLike[str] | DepthExtrapolator,
    odometry: bool = False,
    runtime: str = "auto",
    precision: str | None = None,
) -> DepthExtrapolator:
    """The extrapolator behind a name, a path to weights, or an object that is one already.

    Args:
        spec: one of ``NAMES``; a path (anything with a folder or one of ``WEIGHT_SUFFIXES`` in it) to
            weights with their card, to the released network's weights without a card, or to a folder that
            ``scripts/export_onnx.py`` wrote; or an object following ``DepthExtrapolator``.
        odometry: let ``"warp"`` and ``"unet"`` use true poses; the other names have no use for them.
        runtime: what runs the networks, one of :data:`nl_env.depth.runtime.RUNTIMES`; for an exported
            folder ``"auto"`` is ONNX Runtime. Names without a network have no use for it.
        precision: of the networks, see :func:`nl_env.depth.runtime.compile_network`.

    Raises:
        ValueError: unknown name, runtime or precision (the valid ones are listed), or a file of other
            weights.
        FileNotFoundError: no such file, or the weights of a named network are not installed.
        TypeError: an object that does not follow ``DepthExtrapolator``.
        ImportError: a network without its runtime installed.
    """
    if runtime not in RUNTIMES:
        raise ValueError(f"runtime: found {runtime!r}, expected one of {', '.join(RUNTIMES)}")
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
                f"extrapolator: {name!r} ({NETWORKS[name]}) needs its weights, found no file "
                f"nl_env/weights/{path.name}; make them with scripts/train_all.py, give a path to weights, "
                f"or one of {', '.join(NAMES[:4])}"
            )
        return _from_weights(path, odometry, runtime, precision)
    path = Path(name)
    if path.is_dir():
        return _from_export(path, odometry, runtime, precision)
    if isinstance(spec, os.PathLike) or path.suffix in WEIGHT_SUFFIXES or os.sep in name:
        return _from_weights(path, odometry, runtime, precision)
    raise ValueError(
        f"extrapolator: found {name!r}, expected one of {', '.join(NAMES)}, or a path to weights"
    )


def _from_weights(path: Path, odometry: bool, runtime: str, precision: str | None) -> DepthExtrapolator:
    """Ours or the paper's, as the card says; without a card, the released network."""
    try:
        from nl_env.depth.learned_networks import run_refinement
        from nl_env.depth.networks import UNet, load_networks
    except ImportError as cause:
        raise ImportError("extrapolator: networks need PyTorch (pip install torch)") from cause

    network = load_networks(path)

    def running(part: nn.Module) -> NetworkRunner:
        return NetworkRunner(part, runtime, precision=precision)

    if isinstance(network, UNet):
        return PaperUNet(running(network))
    return MotionWarpRefine(
        None if network.motion is None else running(network.motion),
        None if network.refine is None else run_refinement(network.refine, runtime, precision=precision),
        threshold=network.threshold,
        warped=network.warped,
        events=network.events,
        odometry=odometry,
    )


def _from_export(folder: Path, odometry: bool, runtime: str, precision: str | None) -> DepthExtrapolator:
    """What an exported folder holds, without PyTorch."""
    export = read_export(folder)
    loaded = load_parts(folder, export, runtime, precision)
    parts = {name: _one_by_one(network) for name, network in loaded.items()}
    if "network" in parts:
        return PaperUNet(parts["network"])
    return MotionWarpRefine(parts.get("motion"), parts.get("refine"), odometry=odometry, **export.options)


def _one_by_one(network: CompiledNetwork) -> Callable[..., tuple[NDArray[np.float32], ...]]:
    """``network``, which takes one image at a time, for batches."""

    def run(*inputs: NDArray[np.float32]) -> tuple[NDArray[np.float32], ...]:
        outputs = [network(*(array[i : i + 1] for array in inputs)) for i in range(len(inputs[0]))]
        return tuple(np.concatenate(parts) for parts in zip(*outputs, strict=True))

    return run


def _period_and_gap(inputs: ExtrapolationInput) -> tuple[float, float]:
    """Seconds between the last two LiDAR frames, and from the last one to the wanted frame."""
    before, last = inputs.lidar_times[-2:]
    return (last - before) * 1e-6, (inputs.t - last) * 1e-6
