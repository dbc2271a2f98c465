"""Collect an offline data set in Minari's format from nl_env/Replay-v0, one for each behaviour.

python scripts/collect_minari.py --data runs/data/train --behaviour oracle:30 keyframe-cnn random:0.5

Behaviours are policies by name (agents/catalogue.py), privileged ones included. Each decides on the stored
traces of scripts/precompute.py; the environment then plays its decisions, so that a data set's observations
are of one mode whatever the behaviour looked at. Minari keeps data sets in MINARI_DATASETS_PATH or in --root.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # agents/ is used from the checkout, wherever the command is started

import gymnasium as gym
import numpy as np
import tyro
from numpy.typing import NDArray

import nl_env
from agents.catalogue import make_policy
from nl_env.command_line import run_command
from nl_env.evaluation import play
from nl_env.trace_files import default_folder, open_traces
from nl_env.traces import SequenceTrace

KEPT_INFO = ("log_mae", "effective_rate", "lidar", "triggered", "depth_age", "ego_speed", "keyframe")
"""Entries of ``info`` that a data set keeps, from the reset to the last step."""


@dataclass(frozen=True)
class Arguments:
    """Collect offline data sets in Minari's format."""

    behaviour: tuple[str, ...] = ("oracle:30", "keyframe-cnn", "random:0.5")
    """Policies by name; one data set each."""
    data: Path = Path("runs/data/train")
    """Recordings with stored traces beside them."""
    extrapolator: str = "unet"
    """Of the traces."""
    obs_mode: str = "statistics"
    """What the data sets' observations are: image, signed, dict or statistics."""
    trigger_cost: float = 0.1
    """Of the rewards."""
    sequences: int = 0
    """The first sequences only; 0 takes all."""
    namespace: str = "nl-env"
    """Of the data sets' names, NAMESPACE/replay/BEHAVIOUR-OBS_MODE-v0."""
    root: Path | None = None
    """Minari's folder of data sets; by default where Minari keeps them."""


def dataset_id(arguments: Arguments, behaviour: str) -> str:
    """Name of the data set of ``behaviour``."""
    name = re.sub(r"[^a-z0-9]+", "-", behaviour.lower()).strip("-")
    return f"{arguments.namespace}/replay/{name}-{arguments.obs_mode}-v0"


def decisions(behaviour: str, trace: SequenceTrace) -> NDArray[np.int64]:
    """``(K,)`` actions of ``behaviour`` at slices 1..K; 0 where a LiDAR frame makes them moot."""
    actions = np.zeros(trace.slices, np.int64)
    record = play(make_policy(behaviour, trace.seed), trace, behaviour)
    actions[np.array(record.triggers, np.int64) - 1] = 1
    return actions


def episode(env: gym.Env[Any, Any], seed: int, actions: NDArray[np.int64]) -> dict[str, Any]:
    """What Minari's ``EpisodeBuffer`` holds of one sequence."""
    observation, info = env.reset(seed=seed, options={"sequence": seed})
    observations, infos = [observation], [info]
    rewards, terminations, truncations = [], [], []
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(int(action))
        observations.append(observation)
        infos.append(info)
        rewards.append(reward)
        terminations.append(terminated)
        truncations.append(truncated)
    if isinstance(observations[0], dict):
        joined: Any = {name: np.stack([seen[name] for seen in observations]) for name in observations[0]}
    else:
        joined = np.stack(observations)
    return {
        "seed": seed,
        "observations": joined,
        "actions": actions,
        "rewards": rewards,
        "terminations": terminations,
        "truncations": truncations,
        "infos": {name: np.array([entry[name] for entry in infos]) for name in KEPT_INFO},
    }


def collect(arguments: Arguments) -> list[str]:
    """Collect all behaviours; returns the data sets' names.

    Raises:
        ImportError: Minari is not installed.
        FileNotFoundError: no recordings or no traces.
        ValueError: an unknown behaviour or mode, or a data set of that name exists.
    """
    if arguments.root is not None:
        os.environ["MINARI_DATASETS_PATH"] = str(arguments.root)
    try:
        import minari
        from minari.data_collector import EpisodeBuffer
    except ImportError as error:
        raise ImportError(f"{error}; pip install 'nl-env[minari]'") from error

    tables = default_folder(arguments.data, arguments.extrapolator)
    traces = open_traces(tables)
    chosen = dict(list(traces.items())[: arguments.sequences or None])
    names = [dataset_id(arguments, behaviour) for behaviour in arguments.behaviour]
    taken = sorted(set(names) & set(minari.list_local_datasets()))
    if taken:
        raise ValueError(f"found the data set {taken[0]!r} already, expected a new name: delete it first")
    env = gym.make(
        "nl_env/Replay-v0",
        data=str(arguments.data),
        sequences=list(chosen),
        errors="table",
        extrapolator=arguments.extrapolator,
        obs_mode=arguments.obs_mode,
        trigger_cost=arguments.trigger_cost,
    )
    try:
        for name, behaviour in zip(names, arguments.behaviour, strict=True):
            buffer = [
                EpisodeBuffer(id=i, **episode(env, seed, decisions(behaviour, trace)))
                for i, (seed, trace) in enumerate(chosen.items())
            ]
            minari.create_dataset_from_buffers(
                name,
                buffer,
                env=env,
                algorithm_name=behaviour,
                description=(
                    f"{behaviour} on {len(chosen)} sequences of nl_env/Replay-v0, "
                    f"trigger cost {arguments.trigger_cost:g}"
                ),
                requirements=[f"nl-env=={nl_env.__version__}"],
                data_format="hdf5",
                jpeg_encoding=False,
            )
    finally:
        env.close()
    return names


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""

    def work(given: list[str]) -> None:
        print("\n".join(collect(tyro.cli(Arguments, args=given, description=__doc__))))

    return run_command("collect_minari", work, arguments, errors=(ImportError,))


if __name__ == "__main__":
    sys.exit(main())
