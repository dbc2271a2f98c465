"""Rows of the ablation table: how the network in a file of weights differs, by its card."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from nl_env.depth import learned_networks, unet
from nl_env.weight_files import Card, read_card

OURS = "ours"
PAPER = "paper's network"

_PUBLISHED = {
    "released": "as published",
    "paper": "as published",
    "without-events": "without events",
    "event-frame": "event frame",
    "data-concat": "data concat",
    "without-skip": "without skip",
}
"""Keys of ``published.ABLATION`` by variant of the paper's family."""


@dataclass(frozen=True)
class Variant:
    """One trained variant.

    Attributes:
        row: of the table.
        odometry: it was trained with the true motion and is run with it.
        published: its key in ``published.ABLATION``, if the paper has it.
    """

    row: str
    odometry: bool = False
    published: str | None = None


def read_variant(weights: Path) -> Variant:
    """The variant that the card beside ``weights`` describes.

    Raises:
        FileNotFoundError: no card.
        ValueError: a card of another kind of network.
    """
    card = read_card(weights)
    if card is None:
        raise FileNotFoundError(f"card: found none beside {weights}, expected one that names the variant")
    if card.architecture == unet.ARCHITECTURE:
        return _of_paper(card)
    if card.architecture == learned_networks.ARCHITECTURE:
        return _of_ours(card)
    raise ValueError(
        f"card: found architecture {card.architecture!r} beside {weights}, "
        f"expected {unet.ARCHITECTURE!r} or {learned_networks.ARCHITECTURE!r}"
    )


def _of_paper(card: Card) -> Variant:
    names = [name for name, options in unet.VARIANTS.items() if asdict(options) == card.options]
    name = names[0] if names else ", ".join(f"{key} {value}" for key, value in card.options.items())
    loss = card.training.get("loss", {}).get("weights", "released")
    suffix = "" if loss == "released" else f", {loss} loss weights"
    return Variant(f"{PAPER}: {name}{suffix}", published=None if suffix else _PUBLISHED.get(name))


def _of_ours(card: Card) -> Variant:
    refine, odometry = card.options["refine"], bool(card.training.get("odometry", False))
    warped = card.options.get("warped", True)
    differences = {
        "motion and warp only": refine is None,
        "refinement only": not warped,
        "true motion": odometry,
        "motion network": refine is not None and card.options["motion"] is not None,
        "without events": not card.options.get("events", True),
        "one head": refine is not None and refine.get("heads") == 1,
        "without neighbours": refine is not None and not refine.get("neighbours", True),
    }
    told = [name for name, differs in differences.items() if differs]
    return Variant(OURS + (f": {', '.join(told)}" if told else ""), odometry)
