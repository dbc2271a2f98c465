"""Convert a checkpoint of the released network to safetensors with a card.

    python -m nl_env.depth.import_weights CHECKPOINT OUT.safetensors

Nothing but tensors is unpickled, every tensor must be one of the architecture's, and the file written is
read back and must give the same depth.
"""

from __future__ import annotations

import argparse
import hashlib
from pathlib import Path

import torch

from nl_env.depth.unet import load_released, load_unet, unet_card
from nl_env.types import BINS
from nl_env.weight_files import write_weights

TOLERANCE = 1e-5
"""Largest difference in depth, m, between the network as imported and as written."""


def import_weights(checkpoint: Path, out: Path) -> float:
    """Write the weights of ``checkpoint`` to ``out`` and a card beside it; returns the largest difference, m.

    Raises:
        FileNotFoundError: no such checkpoint.
        FileExistsError: there is a file ``out``.
        ValueError: ``checkpoint`` holds other weights, or ``out`` is not named ``.safetensors``.
    """
    network = load_released(checkpoint)
    if out.exists():
        raise FileExistsError(f"out: {str(out)!r} is there already; choose another name or remove it")
    digest = hashlib.sha256(checkpoint.read_bytes()).hexdigest()
    card = unet_card(
        network,
        "The released network, weights of its authors",
        training={"imported_from": {"name": checkpoint.name, "sha256": digest}},
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    write_weights(out, network.state_dict(), card)
    difference = _largest_difference(network, load_unet(out))
    if difference > TOLERANCE:
        raise ValueError(
            f"out: found depths {difference} m apart in {str(out)!r}, expected at most {TOLERANCE}"
        )
    return difference


def _largest_difference(first: torch.nn.Module, second: torch.nn.Module) -> float:
    """Of the depths of two networks on one random input, m."""
    generator = torch.Generator().manual_seed(0)
    depth = 100 * torch.rand(1, 1, 64, 80, generator=generator)
    voxel = torch.randn(1, BINS, 64, 80, generator=generator).round()
    with torch.inference_mode():
        return float((first(depth, voxel) - second(depth, voxel)).abs().max())


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoint", type=Path, help="state dict, .pth or .safetensors")
    parser.add_argument("out", type=Path, help="file to write, .safetensors; its card gets .json")
    arguments = parser.parse_args()
    try:
        difference = import_weights(arguments.checkpoint, arguments.out)
    except (OSError, ValueError) as error:
        parser.exit(1, f"{error}\n")
    print(f"wrote {arguments.out}; largest difference in depth {difference:.1e} m")


if __name__ == "__main__":
    main()
