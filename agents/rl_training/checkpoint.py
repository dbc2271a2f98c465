"""The last checkpoint of a run: model, optimiser, replay buffer and progress in one file.

It is written between stages, where the environments start anew from seeds, so neither they nor any generator
need to be stored. Nothing but tensors, numbers and text is read back.
"""

from __future__ import annotations

import pickle
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from nl_env.runs import replacing

COUNTERS = (
    "num_timesteps",
    "_n_updates",
    "_n_calls",
    "_episode_num",
    "_current_progress_remaining",
    "exploration_rate",
)
"""Attributes of models, as far as they have them, on which the next step depends."""
BUFFERED = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


@dataclass
class Progress:
    """Where a run stands.

    Attributes:
        stage: stages done.
        best: lowest criterion so far, None before the first validation.
        best_stage: after how many stages.
        seconds: time spent, interruptions left out.
        trigger_cost: what a constrained run has come to charge; None for the others.
    """

    stage: int = 0
    best: float | None = None
    best_stage: int = 0
    seconds: float = 0.0
    trigger_cost: float | None = None


def save(path: Path, model: BaseAlgorithm, progress: Progress, settings: dict[str, Any]) -> None:
    """Write everything to ``path``, whole or not at all."""
    policy: Any = model.policy
    state = {
        "settings": settings,
        "progress": asdict(progress),
        "policy": policy.state_dict(),
        "optimiser": policy.optimizer.state_dict(),
        "counters": {name: getattr(model, name) for name in COUNTERS if hasattr(model, name)},
        "buffer": _buffer_state(model),
    }
    with replacing(path) as temporary:
        torch.save(state, temporary)


def load(path: Path, model: BaseAlgorithm, settings: dict[str, Any]) -> Progress:
    """Read what :func:`save` wrote into ``model``.

    Raises:
        FileNotFoundError: no such file.
        ValueError: damaged, no checkpoint, or of a run with other settings.
    """
    if not path.is_file():
        raise FileNotFoundError(f"resume: found no {str(path)!r}; start anew with --overwrite")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        found, progress = state["settings"], Progress(**state["progress"])
    except (RuntimeError, pickle.UnpicklingError, EOFError, KeyError, TypeError) as cause:
        raise ValueError(f"resume: found no checkpoint in {str(path)!r} ({cause})") from cause
    changed = [
        f"{key} is {found.get(key)!r}, asked {settings.get(key)!r}"
        for key in sorted(found.keys() | settings.keys())
        if found.get(key) != settings.get(key)
    ]
    if changed:
        raise ValueError(f"resume: {str(path)!r} is of a run with other settings: {'; '.join(changed)}")
    policy: Any = model.policy
    policy.load_state_dict(state["policy"])
    policy.optimizer.load_state_dict(state["optimiser"])
    for name, value in state["counters"].items():
        setattr(model, name, value)
    _restore_buffer(model, state["buffer"])
    return progress


def _buffer_state(model: BaseAlgorithm) -> dict[str, Any]:
    if not isinstance(model, OffPolicyAlgorithm):
        return {}
    buffer = model.replay_buffer
    assert buffer is not None
    filled = buffer.buffer_size if buffer.full else buffer.pos
    state: dict[str, Any] = {"pos": buffer.pos, "full": buffer.full}
    for name in BUFFERED:
        stored = getattr(buffer, name)
        if isinstance(stored, dict):
            state[name] = {key: torch.from_numpy(array[:filled]) for key, array in stored.items()}
        else:
            state[name] = torch.from_numpy(stored[:filled])
    return state


def _restore_buffer(model: BaseAlgorithm, state: dict[str, Any]) -> None:
    if not isinstance(model, OffPolicyAlgorithm):
        return
    buffer = model.replay_buffer
    assert buffer is not None
    buffer.pos, buffer.full = state["pos"], state["full"]
    for name in BUFFERED:
        stored, kept = getattr(buffer, name), state[name]
        pairs = [(stored[key], kept[key]) for key in stored] if isinstance(stored, dict) else [(stored, kept)]
        for array, tensor in pairs:
            np.copyto(array[: len(tensor)], tensor.numpy())
