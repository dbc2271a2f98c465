"""Export an extrapolator's networks to ONNX, for ONNX Runtime without PyTorch, and for TensorRT.

    python scripts/export_onnx.py nl_env/weights/unet.safetensors runs/unet-onnx
    python scripts/export_onnx.py unet-paper runs/paper-onnx --resolution full --fp16

Writes a folder of .onnx files for one image size and checks each against PyTorch in ONNX Runtime.
``extrapolator="runs/unet-onnx"`` then runs it in an environment, without PyTorch.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from numpy.typing import NDArray
from torch import nn

from nl_env.config import DrivingConfig
from nl_env.depth.exported import DESCRIPTION, PARTS, Export, write_export
from nl_env.depth.extrapolators import NETWORKS, WEIGHTS, PaperUNet
from nl_env.depth.learned import MotionWarpRefine
from nl_env.depth.networks import UNet, load_networks
from nl_env.depth.runtime import CompiledNetwork, compile_network
from nl_env.depth.runtime.onnx_export import export_onnx
from nl_env.depth.runtime.onnx_file import OnnxNetwork
from nl_env.types import BINS, ExtrapolationInput

TOLERANCES = {"fp32": 1e-4, "fp16": 2e-2}
"""Largest difference from PyTorch that passes, as a share of the largest output."""


@dataclass(frozen=True)
class Args:
    """What to export and where to."""

    weights: Annotated[str, tyro.conf.Positional]
    """A file of weights, or unet or unet-paper for the shipped ones."""
    out: Annotated[Path, tyro.conf.Positional]
    """Folder to write; it must not hold an export yet."""
    resolution: Literal["full", "half", "quarter"] = "quarter"
    """480x640, 240x320 or 120x160."""
    fp16: bool = False
    """Half precision inside; inputs and outputs stay float32."""
    overwrite: bool = False
    """Replace the export that is there."""


class Witness:
    """A network in PyTorch that keeps what it was shown, to know the sizes it is used with."""

    def __init__(self, module: nn.Module) -> None:
        self.module = module
        self.inputs: tuple[NDArray[np.float32], ...] = ()
        self._compiled: CompiledNetwork | None = None

    def __call__(self, *inputs: NDArray[np.float32]) -> tuple[NDArray[np.float32], ...]:
        self.inputs = inputs
        self._compiled = self._compiled or compile_network(self.module, inputs, "torch")
        return self._compiled(*inputs)


def example(resolution: str) -> ExtrapolationInput:
    """Two LiDAR frames of a road that comes closer, and random events; what a network may be shown."""
    config = DrivingConfig(resolution=resolution)
    camera, far = config.camera, config.lidar.max_depth
    rows = np.arange(camera.height, dtype=np.float32)[:, None] - camera.cy
    road = np.minimum(2.4 * camera.fy / np.maximum(rows, 1), far) * np.ones((1, camera.width))
    frame = np.where(rows > 4, road, 0).astype(np.float32)
    nearer = np.where(frame > 3, frame - 1, frame).astype(np.float32)
    rng = np.random.default_rng(0)
    bins = [rng.integers(-2, 3, (BINS, *camera.shape)).astype(np.int16) for _ in range(2)]
    return ExtrapolationInput(140_000, camera, far, (frame, nearer), (0, 100_000), bins)


def witnesses(network: nn.Module, shown: ExtrapolationInput) -> dict[str, Witness]:
    """Every part of the networks, shown what it sees of ``shown`` in use."""
    run: Callable[[ExtrapolationInput], object]
    if isinstance(network, UNet):
        parts = {"network": Witness(network)}
        run = PaperUNet(parts["network"])
    else:
        modules = {name: getattr(network, name) for name in PARTS["motion-warp-refine"]}
        parts = {name: Witness(module) for name, module in modules.items() if module is not None}
        run = MotionWarpRefine(parts.get("motion"), parts.get("refine"), **options(network))
    run(shown)
    return parts


def options(network: nn.Module) -> dict[str, Any]:
    """What :class:`MotionWarpRefine` has to know besides the networks; nothing for the paper's."""
    names = () if isinstance(network, UNet) else ("threshold", "warped", "events")
    return {name: getattr(network, name) for name in names}


def difference(model: bytes, part: Witness) -> tuple[float, float]:
    """Largest difference of the exported network's outputs from PyTorch's, and their largest value."""
    names = [f"input_{k}" for k in range(len(part.inputs))]
    found = OnnxNetwork(model, 1, names)(part.inputs)
    expected = part(*part.inputs)
    largest = max(float(np.abs(a - b).max()) for a, b in zip(found, expected, strict=True))
    return largest, max(float(np.abs(b).max()) for b in expected)


def main(args: Args) -> None:
    """Export, check and write."""
    if (args.out / DESCRIPTION).exists() and not args.overwrite:
        raise FileExistsError(
            f"out: {args.out} holds an export already; choose another folder or --overwrite"
        )
    path = WEIGHTS / f"{args.weights}.safetensors" if args.weights in NETWORKS else Path(args.weights)
    network = load_networks(path)
    precision = "fp16" if args.fp16 else "fp32"
    shown = example(args.resolution)
    models = {}
    for name, part in witnesses(network, shown).items():
        models[name] = export_onnx(part.module, part.inputs, half=args.fp16)
        largest, scale = difference(models[name], part)
        shapes = ", ".join("x".join(map(str, array.shape)) for array in part.inputs)
        print(
            f"{name}: inputs {shapes}, {len(models[name]) / 1e6:.2f} MB, "
            f"largest difference from PyTorch {largest:.2g} (outputs up to {scale:.3g})"
        )
        if not largest <= TOLERANCES[precision] * max(scale, 1.0):
            raise ValueError(
                f"{name}: found outputs {largest} from PyTorch's, expected at most "
                f"{TOLERANCES[precision]} of {scale}"
            )
    if not models:
        raise ValueError(f"weights: {str(path)!r} holds no network, so there is nothing to export")
    architecture = "unet-paper" if isinstance(network, UNet) else "motion-warp-refine"
    export = Export(architecture, options(network), list(shown.camera.shape), precision, {}, path.name)
    write_export(args.out, export, models)
    print(f"wrote {args.out}")


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except (OSError, ValueError, ImportError) as error:
        sys.exit(f"export_onnx: {error}")
