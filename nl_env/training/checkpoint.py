"""The last checkpoint of a training: model, average, optimiser and progress in one file, written whole."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from nl_env.runs import replacing
from nl_env.weight_files import load_strictly, serialise

STATE_KEY = "training_state"
"""Entry of the file's metadata that holds the progress as JSON."""


@dataclass
class Progress:
    """Where a training stands."""

    step: int = 0
    """Steps done."""
    best: float | None = None
    """Lowest criterion so far."""
    best_step: int = 0
    """After how many steps."""
    best_metrics: dict[str, float] = field(default_factory=dict)
    """Everything validation said then."""
    stale: int = 0
    """Validations since."""
    finished: bool = False
    """All steps are done, or patience ended."""
    seconds: float = 0.0
    """Time spent, interruptions left out."""


def save(
    path: Path,
    progress: Progress,
    settings: dict[str, Any],
    model: nn.Module,
    average: nn.Module | None,
    optimiser: torch.optim.Optimizer,
) -> None:
    """Write everything that the next step depends on to ``path``.

    Raises:
        OSError: it cannot be written, for example because the disk is full; the file that was there is kept.
    """
    tensors = {f"model.{name}": tensor for name, tensor in model.state_dict().items()}
    if average is not None:
        tensors |= {f"average.{name}": tensor for name, tensor in average.state_dict().items()}
    names = {id(parameter): name for name, parameter in model.named_parameters()}
    for parameter, entries in optimiser.state.items():
        tensors |= {f"optimiser.{key}.{names[id(parameter)]}": value for key, value in entries.items()}
    state = json.dumps({"progress": asdict(progress), "settings": settings})
    data = serialise(tensors, {STATE_KEY: state})
    try:
        with replacing(path) as temporary:
            temporary.write_bytes(data)
    except OSError as cause:
        kept = "the previous checkpoint is kept" if path.exists() else "there is no earlier checkpoint"
        raise OSError(
            cause.errno, f"checkpoint: cannot write {str(path)!r} ({cause.strerror}); {kept}"
        ) from cause


def load(
    path: Path,
    settings: dict[str, Any],
    model: nn.Module,
    average: nn.Module | None,
    optimiser: torch.optim.Optimizer,
) -> Progress:
    """Read what :func:`save` wrote into ``model``, ``average`` and ``optimiser``.

    Raises:
        ValueError: the file is damaged, no checkpoint, of a run with other settings, or of another model.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except SafetensorError as cause:
        raise ValueError(f"resume: found no safetensors data in {str(path)!r} ({cause})") from cause
    if STATE_KEY not in metadata:
        raise ValueError(f"resume: {str(path)!r} holds weights, expected a training checkpoint")
    state = json.loads(metadata[STATE_KEY])
    changed = list(_differences(state["settings"], settings))
    if changed:
        raise ValueError(f"resume: {str(path)!r} is of a run with other settings: {', '.join(changed)}")
    load_strictly(model, _under("model.", tensors), path)
    if average is not None:
        load_strictly(average, _under("average.", tensors), path)
    _restore_optimiser(optimiser, model, _under("optimiser.", tensors))
    return Progress(**state["progress"])


def _restore_optimiser(
    optimiser: torch.optim.Optimizer, model: nn.Module, tensors: dict[str, Tensor]
) -> None:
    parameters = dict(model.named_parameters())
    entries: dict[str, dict[str, Tensor]] = {}
    for key_and_name, value in tensors.items():
        key, name = key_and_name.split(".", 1)
        parameter = parameters[name]
        if value.shape == parameter.shape:
            # In the parameter's memory format: flat kernels walk both side by side.
            value = torch.empty_like(parameter, requires_grad=False).copy_(value)
        entries.setdefault(name, {})[key] = value
    trained = [name for name, parameter in parameters.items() if parameter.requires_grad]
    state = {place: entries[name] for place, name in enumerate(trained) if name in entries}
    optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})


def _under(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}


def _differences(found: dict[str, Any], asked: dict[str, Any], prefix: str = "") -> Iterator[str]:
    for key in sorted(found.keys() | asked.keys()):
        mine, theirs = found.get(key), asked.get(key)
        if isinstance(mine, dict) and isinstance(theirs, dict):
            yield from _differences(mine, theirs, f"{prefix}{key}.")
        elif mine != theirs:
            yield f"{prefix}{key} is {mine!r}, asked {theirs!r}"
