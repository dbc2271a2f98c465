"""Hyperparameter files in the format of RL Baselines3 Zoo: one YAML file, an entry for each environment id.

The Zoo and ``scripts/train_rl.py`` read the same file. Of the Zoo's format this reads what its files here
use: ``n_timesteps``, ``n_envs``, ``policy``, ``policy_kwargs``, ``env_kwargs``, and arguments of the
algorithm, with ``lin_X`` for a number that falls from X to 0. Nothing in a file is evaluated as Python.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nl_env.config import choice, number

FOLDER = Path(__file__).resolve().parents[1] / "hyperparameters"
ENV_ID = "nl_env/Replay-v0"
SCHEDULED = ("learning_rate", "clip_range")
"""Arguments that may fall linearly."""
_ENV_KEYS = ("obs_mode", "trigger_cost", "error", "error_scale", "errors", "data")


@dataclass(frozen=True)
class Hyperparameters:
    """One training's numbers.

    Attributes:
        timesteps: environment steps in all.
        envs: environments side by side.
        policy: Stable-Baselines3's name of it.
        obs_mode: what the agent sees.
        trigger_cost: a number, or the range of which episodes draw theirs.
        error, error_scale: of the reward, as for the environment.
        policy_kwargs: arguments of the policy, such as ``net_arch``.
        algorithm: arguments of the algorithm.
    """

    timesteps: int
    envs: int
    policy: str
    obs_mode: str
    trigger_cost: float | tuple[float, float]
    error: str
    error_scale: float
    policy_kwargs: Mapping[str, Any]
    algorithm: Mapping[str, Any]


def read_hyperparameters(path: Path) -> Hyperparameters:
    """The entry of :data:`ENV_ID` in the file at ``path``.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no YAML, no such entry, or an entry with missing or wrong values; the message names it.
    """
    import yaml

    try:
        entries = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as cause:
        raise ValueError(f"{path}: found no YAML ({cause})") from cause
    if not isinstance(entries, dict) or not isinstance(entries.get(ENV_ID), dict):
        found = sorted(entries) if isinstance(entries, dict) else type(entries).__name__
        raise ValueError(f"{path}: found entries {found}, expected one for {ENV_ID}")
    try:
        return _parse(dict(entries[ENV_ID]))
    except ValueError as cause:
        raise ValueError(f"{path}: {cause}") from cause


def _parse(entry: dict[str, Any]) -> Hyperparameters:
    missing = sorted({"n_timesteps", "n_envs", "policy", "env_kwargs"} - entry.keys())
    if missing:
        raise ValueError(f"found no {', '.join(missing)}, expected them")
    env, policy_kwargs = entry.pop("env_kwargs"), entry.pop("policy_kwargs", {})
    for name, mapping in (("env_kwargs", env), ("policy_kwargs", policy_kwargs)):
        if not isinstance(mapping, dict):
            raise ValueError(f"{name}: found {mapping!r}, expected a mapping (strings are not evaluated)")
    for key in env:
        choice("env_kwargs", key, _ENV_KEYS)
    timesteps, envs, policy = (entry.pop(name) for name in ("n_timesteps", "n_envs", "policy"))
    number("n_timesteps", timesteps, 1, 1e12)
    number("n_envs", envs, 1, 100_000)
    cost = env.get("trigger_cost", 0.1)
    return Hyperparameters(
        timesteps=int(timesteps),
        envs=int(envs),
        policy=policy,
        obs_mode=env.get("obs_mode", "image"),
        trigger_cost=(float(cost[0]), float(cost[1])) if isinstance(cost, list) else float(cost),
        error=env.get("error", "log_mae"),
        error_scale=float(env.get("error_scale", 0.05)),
        policy_kwargs=policy_kwargs,
        algorithm=entry,
    )


class Falling:
    """A number that falls linearly to 0 while a training proceeds."""

    def __init__(self, first: float) -> None:
        self.first = first

    def __call__(self, remaining: float) -> float:
        """The number when a share ``remaining`` of the training is left."""
        return remaining * self.first


def scheduled(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """``arguments`` with every ``"lin_X"`` as a :class:`Falling`; ``ValueError`` for other strings."""
    result = dict(arguments)
    for name in SCHEDULED:
        value = result.get(name)
        if isinstance(value, str):
            kind, _, first = value.partition("_")
            try:
                result[name] = Falling(float(first)) if kind == "lin" else None
            except ValueError:
                result[name] = None
            if result[name] is None:
                raise ValueError(f"{name}: found {value!r}, expected a number or lin_NUMBER")
    return result
