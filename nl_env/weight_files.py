"""Files of weights: safetensors with a JSON card beside them, and state dicts of others, read strictly.

A card says what the weights are and how to build the module they belong to, so a network is loaded from
its file alone. Nothing but tensors is ever unpickled. Importing this module does not import PyTorch.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nl_env.runs import replacing, write_text

if TYPE_CHECKING:
    from torch import Tensor, nn


@dataclass(frozen=True)
class Card:
    """What a file of weights holds. Every field is JSON-ready."""

    what: str
    """One sentence for readers."""
    architecture: str
    """Name under which the loader finds the module's factory."""
    options: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of that factory."""
    data: dict[str, Any] = field(default_factory=dict)
    """What it was trained on: manifest, splits, seeds."""
    training: dict[str, Any] = field(default_factory=dict)
    """How: command, options, steps, time, versions."""
    metrics: dict[str, Any] = field(default_factory=dict)
    """What was measured, and on what."""
    sha256: str = ""
    """Of the weights' file; filled in when both are written."""


def card_path(weights: Path) -> Path:
    """Where the card of ``weights`` lies: beside it, ``.json``."""
    return weights.with_suffix(".json")


def write_weights(path: Path, tensors: Mapping[str, Tensor], card: Card) -> Card:
    """Write ``tensors`` to ``path`` and ``card`` beside it, each whole or not at all. Returns that card.

    Same tensors, same bytes. A crash between the two files leaves a card that :func:`read_card` refuses.

    Raises:
        ValueError: ``path`` does not end in ``.safetensors``.
        OSError: the files cannot be written; what was there before is kept.
    """
    if path.suffix != ".safetensors":
        raise ValueError(f"weights: found file name {path.name!r}, expected one that ends in .safetensors")
    data = serialise(tensors)
    with replacing(path) as temporary:
        temporary.write_bytes(data)
    card = replace(card, sha256=hashlib.sha256(data).hexdigest())
    write_card(path, card)
    return card


def write_card(weights: Path, card: Card) -> None:
    """Write ``card`` beside ``weights``, for example with more metrics than it was read with."""
    write_text(card_path(weights), json.dumps(asdict(card), indent=2) + "\n")


def serialise(tensors: Mapping[str, Tensor], metadata: dict[str, str] | None = None) -> bytes:
    """``tensors`` in safetensors format, in the order of their names."""
    from safetensors.torch import save

    ordered = {name: tensors[name].detach().cpu().contiguous() for name in sorted(tensors)}
    return save(ordered, metadata)


def read_card(weights: Path) -> Card | None:
    """The card beside ``weights``, or None where there is none.

    Raises:
        ValueError: the card is no JSON, has other fields, or belongs to other weights.
    """
    path = card_path(weights)
    if not path.is_file():
        return None
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as cause:
        raise ValueError(f"card: found no JSON in {str(path)!r} ({cause})") from cause
    expected = {entry.name: str if entry.type == "str" else dict for entry in fields(Card)}
    if not isinstance(values, dict) or values.keys() != expected.keys():
        found = sorted(values) if isinstance(values, dict) else type(values).__name__
        raise ValueError(f"card: found {found} in {str(path)!r}, expected the fields {sorted(expected)}")
    for name, kind in expected.items():
        if not isinstance(values[name], kind):
            raise ValueError(
                f"card: found {name} {values[name]!r} in {str(path)!r}, expected a {kind.__name__}"
            )
    card = Card(**values)
    if weights.is_file() and card.sha256 != hashlib.sha256(weights.read_bytes()).hexdigest():
        raise ValueError(
            f"card: {str(path)!r} was written for other weights than {weights.name}, expected the pair "
            "as it was made; copy both files again"
        )
    return card


def read_tensors(path: Path) -> dict[str, Tensor]:
    """The tensors of a ``.safetensors`` file, or of a PyTorch state dict under any other suffix.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file holds anything but tensors by name, is truncated or damaged.
    """
    if not path.is_file():
        raise FileNotFoundError(f"weights: found no file {str(path)!r}")
    if path.suffix == ".safetensors":
        from safetensors import SafetensorError
        from safetensors.torch import load_file

        try:
            return load_file(path)
        except SafetensorError as cause:
            raise ValueError(f"weights: found no safetensors data in {str(path)!r} ({cause})") from cause
    import torch

    try:
        tensors = torch.load(path, map_location="cpu", weights_only=True)
    except OSError:
        raise
    except Exception as cause:  # damaged data makes the unpickler raise nearly anything
        raise ValueError(
            f"weights: found no plain state dict in {str(path)!r}, expected .safetensors or a state dict"
        ) from cause
    named = isinstance(tensors, Mapping) and all(
        isinstance(name, str) and isinstance(value, torch.Tensor) for name, value in tensors.items()
    )
    if not named:
        raise ValueError(f"weights: found {type(tensors).__name__} in {str(path)!r}, expected a state dict")
    return dict(tensors)


def load_strictly(module: nn.Module, tensors: Mapping[str, Tensor], path: Path) -> None:
    """Copy ``tensors``, read from ``path``, into ``module``: every name, every shape, nothing else.

    Raises:
        ValueError: lists the missing, unexpected and misshapen tensors, and those that are not finite.
    """
    expected = module.state_dict()
    problems = {
        "missing": sorted(expected.keys() - tensors.keys()),
        "unexpected": sorted(tensors.keys() - expected.keys()),
        "of another shape": sorted(
            f"{name} {tuple(tensors[name].shape)} instead of {tuple(expected[name].shape)}"
            for name in expected.keys() & tensors.keys()
            if tensors[name].shape != expected[name].shape
        ),
        "not finite": sorted(name for name, tensor in tensors.items() if not tensor.isfinite().all()),
    }
    listed = "; ".join(f"{kind}: {_shortened(names)}" for kind, names in problems.items() if names)
    if listed:
        raise ValueError(f"weights: {str(path)!r} does not fit {type(module).__name__}, {listed}")
    module.load_state_dict(dict(tensors))


def load_network(path: Path, architectures: Mapping[str, Callable[..., nn.Module]]) -> tuple[nn.Module, Card]:
    """Build the module that the card of ``path`` describes and load its weights; in evaluation mode.

    Args:
        path: weights with a card beside them.
        architectures: factories by the name cards use.

    Raises:
        FileNotFoundError: no weights, or no card beside them.
        ValueError: another architecture, options its factory does not take, or tensors that do not fit.
    """
    tensors = read_tensors(path)
    card = read_card(path)
    if card is None:
        raise FileNotFoundError(f"card: found no {card_path(path).name!r} beside {str(path)!r}")
    if card.architecture not in architectures:
        raise ValueError(
            f"card: found architecture {card.architecture!r} beside {str(path)!r}, "
            f"expected one of {', '.join(sorted(architectures))}"
        )
    try:
        module = architectures[card.architecture](**card.options)
    except (TypeError, ValueError) as cause:
        raise ValueError(
            f"card: found options {card.options} beside {str(path)!r} that {card.architecture!r} "
            f"does not take ({cause})"
        ) from cause
    load_strictly(module, tensors, path)
    return module.eval(), card


def _shortened(names: list[str], most: int = 8) -> str:
    """``names`` in one line, cut where there are many."""
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")
