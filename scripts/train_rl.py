"""Train a trigger policy by reinforcement on stored traces, and write its weights with a card.

python scripts/train_rl.py HYPERPARAMETERS, a file of agents/hyperparameters or its name without .yml:

  ppo-statistics    one small policy for all trigger costs, from event statistics
  dqn-statistics    the same with DQN
  qrdqn-statistics  the same with QR-DQN
  qrdqn-dict        one small CNN for all trigger costs, on the event frame, the sum of those since the held
                    depth frame, the state and the cost
  ppo-dict          the same with PPO
  ppo-image         a small CNN on event frames alone, for one trigger cost

Traces come from scripts/precompute.py. Killed at any time, the same command with --resume goes on.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # agents/ is used from the checkout, wherever the command is started

import torch
import tyro
from gymnasium.vector import AutoresetMode

import nl_env
from agents.rl_training.hyperparameters import FOLDER, Hyperparameters, read_hyperparameters
from agents.rl_training.training import LAST, Options, train
from agents.rl_training.validation import Validation
from agents.sb3_vec_env import ReplayVecEnv
from nl_env.batched_replay import BatchedReplayEnv
from nl_env.command_line import command_line, run_command
from nl_env.trace_files import default_folder, open_traces, read_source, trace_files
from nl_env.training.log import LOG_FILE
from nl_env.training.run import BEST
from nl_env.weight_files import Card


@dataclass(frozen=True)
class Arguments:
    """Train a trigger policy by reinforcement."""

    hyperparameters: tyro.conf.Positional[str]
    """A file in the format of RL Baselines3 Zoo, or the name of one in agents/hyperparameters."""
    algorithm: str = ""
    """ppo, dqn or qrdqn; by default the beginning of the file's name."""
    seed: int = 0
    """Of weights, environments and draws."""
    timesteps: int = 0
    """Environment steps, in place of the file's; 0 keeps them."""
    envs: int = 0
    """Environments side by side, in place of the file's; 0 keeps them."""
    trigger_cost: float | None = None
    """One cost in place of the file's range: a policy that is not told the cost."""
    target_rate: float | None = None
    """Effective frame rate to keep, Hz; the cost is then adapted while training, from --trigger-cost on."""
    stages: int = 20
    """Validations and checkpoints; fewer where a stage would not last for whole sequences."""
    end_at_lidar: bool = True
    """Episodes end at LiDAR frames, which no decision reaches across, and are not discounted."""
    cost_offset: float = 0.05
    """Rewards are divided by the trigger cost plus this; 0 leaves them as they are."""
    relative: bool = True
    """Rewards count from what a depth frame of every slice would earn, which no decision changes."""
    mirror: bool = True
    """Half of the environments show their events mirrored."""
    recordings: Path = Path("runs/data/train")
    """Recordings to learn from; their traces lie beside them."""
    validation: Path = Path("runs/data/val")
    """Recordings that choose the best weights."""
    extrapolator: str = "unet"
    """Of the traces."""
    sequences: int = 0
    """Learn from the first sequences only; 0 takes all that have traces."""
    threads: int = 1
    """Of PyTorch."""
    out: Path | None = None
    """Output folder, runs/rl-NAME-SEED by default: best.safetensors and its card best.json, last.pt, log."""
    overwrite: bool = False
    """Replace the run that is in the output folder."""
    resume: bool = False
    """Continue the run that is in the output folder, or begin it."""


def run(arguments: Arguments, command: str) -> Card:
    """Train, and return the card of the best weights."""
    path = Path(arguments.hyperparameters)
    if not path.suffix:
        path = FOLDER / f"{path.name}.yml"
    hyperparameters = _adapted(read_hyperparameters(path), arguments)
    options = Options(
        algorithm=arguments.algorithm or path.stem.split("-")[0],
        seed=arguments.seed,
        stages=arguments.stages,
        end_at_lidar=arguments.end_at_lidar,
        cost_offset=arguments.cost_offset or None,
        relative=arguments.relative,
        mirror=arguments.mirror,
        target_rate=arguments.target_rate,
    )
    tables = default_folder(arguments.recordings, arguments.extrapolator)
    seeds = list(trace_files(tables))[: arguments.sequences or None]
    validation_tables = default_folder(arguments.validation, arguments.extrapolator)
    validation = Validation.of(list(open_traces(validation_tables).values()))
    card = Card(
        what="Trigger policy trained by reinforcement: triggers where its output is above 0",
        architecture="trigger-network",
        data={
            "training": described(tables, seeds),
            "validation": described(validation_tables, [trace.seed for trace in validation.traces]),
        },
        training={
            "command": command,
            "nl_env": nl_env.__version__,
        },
    )

    def make_env(numbers: Hyperparameters) -> ReplayVecEnv:
        env = BatchedReplayEnv(
            numbers.envs,
            data=arguments.recordings,
            sequences=seeds,
            tables=tables,
            extrapolator=arguments.extrapolator,
            obs_mode=numbers.obs_mode,
            error=numbers.error,
            error_scale=numbers.error_scale,
            trigger_cost=numbers.trigger_cost,
            autoreset_mode=AutoresetMode.SAME_STEP,
        )
        return ReplayVecEnv(
            env,
            end_at_lidar=options.end_at_lidar,
            cost_offset=options.cost_offset,
            relative=options.relative,
            mirror=options.mirror,
            pictures=numbers.obs_mode in ("image", "dict"),
        )

    out = arguments.out or Path(f"runs/rl-{path.stem}-{arguments.seed}")
    claim(out, arguments.overwrite, arguments.resume)
    torch.set_num_threads(arguments.threads)
    resume = arguments.resume and (out / LAST).is_file()  # else nothing is done yet
    return train(options, hyperparameters, make_env, validation, out, card, resume=resume)


def _adapted(numbers: Hyperparameters, arguments: Arguments) -> Hyperparameters:
    """The file's numbers with those of the command line."""
    if arguments.target_rate is not None and arguments.trigger_cost is None:
        arguments = replace(arguments, trigger_cost=0.1)
    changes: dict[str, Any] = {}
    if arguments.timesteps:
        changes["timesteps"] = arguments.timesteps
    if arguments.envs:
        changes["envs"] = arguments.envs
    if arguments.trigger_cost is not None:
        changes["trigger_cost"] = arguments.trigger_cost
    return replace(numbers, **changes)


def claim(out: Path, overwrite: bool, resume: bool) -> None:
    """Make the output folder, or empty it, or find the run to go on with.

    Raises:
        FileExistsError: it holds something and neither flag was given.
        ValueError: both flags.
    """
    if overwrite and resume:
        raise ValueError("overwrite and resume: found both, expected at most one")
    if out.exists() and any(out.iterdir()) and not resume:
        if not overwrite or not (out / LOG_FILE).exists():
            raise FileExistsError(
                f"out: {out} already holds files; choose another folder, or --overwrite or --resume its run"
            )
        shutil.rmtree(out)
    out.mkdir(parents=True, exist_ok=True)


def described(tables: Path, seeds: Sequence[int]) -> dict[str, Any]:
    """What a card says of traces: their number, and a digest of what each was computed from."""
    files = trace_files(tables)
    sources = [asdict(read_source(files[seed])) for seed in seeds]
    text = json.dumps(sources, sort_keys=True)
    return {
        "sequences": len(seeds),
        "first_seed": seeds[0],
        "last_seed": seeds[-1],
        "weights": sources[0]["weights"],
        "sources_sha256": hashlib.sha256(text.encode("utf-8")).hexdigest(),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""

    def work(given: list[str]) -> None:
        card = run(tyro.cli(Arguments, args=given, description=__doc__), command_line("train_rl", given))
        print(json.dumps(card.metrics["validation"]))
        print(f"{BEST}: after {card.training['steps']} of {card.training['steps_in_all']} steps")

    return run_command("train_rl", work, arguments, kept="the last checkpoint is kept")


if __name__ == "__main__":
    sys.exit(main())
