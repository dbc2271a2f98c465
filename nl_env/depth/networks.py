"""The networks behind any file of weights an extrapolator can be made of."""

from __future__ import annotations

from pathlib import Path

from nl_env.depth.learned_networks import ARCHITECTURE as OURS
from nl_env.depth.learned_networks import LearnedNetworks
from nl_env.depth.unet import ARCHITECTURE as PAPER
from nl_env.depth.unet import UNet, load_released, make_unet
from nl_env.weight_files import load_network, read_card


def load_networks(path: Path) -> LearnedNetworks | UNet:
    """Ours or one of the paper's family, as the card beside ``path`` says; the released one without a card.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no weights in it, of another architecture, or tensors that do not fit.
    """
    if read_card(path) is None:
        return load_released(path)
    network, _ = load_network(path, {OURS: LearnedNetworks, PAPER: make_unet})
    assert isinstance(network, (LearnedNetworks, UNet))
    return network
