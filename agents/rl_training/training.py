"""One training in stages: each starts its environments from seeds and ends with a validation and checkpoint.

A killed run goes on from its last checkpoint with the same numbers as if it had never stopped.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.utils import set_random_seed

from agents.rl_training import checkpoint
from agents.rl_training.checkpoint import Progress
from agents.rl_training.constraint import RateConstraint
from agents.rl_training.hyperparameters import Hyperparameters
from agents.rl_training.judgement import ByCost, ByErrorAtRate, ByRegret, Judge
from agents.rl_training.models import decider, make_model, standardise
from agents.rl_training.validation import Validation
from agents.sb3_vec_env import ReplayVecEnv
from nl_env.config import number
from nl_env.training.log import Log
from nl_env.training.run import BEST
from nl_env.weight_files import Card, read_card, write_card, write_weights

LAST = "last.pt"
"""The checkpoint in a run's folder."""
PROBE_STEPS = 100
"""Steps of random actions from which the standardisation of observations is taken."""
LOG_EVERY = 50_000
"""Environment steps between lines of the training log."""

MakeEnv = Callable[[Hyperparameters], ReplayVecEnv]


@dataclass(frozen=True)
class Options:
    """How a policy is trained, besides its hyperparameters. Invalid values raise ``ValueError``.

    Attributes:
        algorithm: one of :data:`agents.rl_training.models.ALGORITHMS`.
        seed: of weights, environments and draws.
        stages: validations and checkpoints; fewer where a stage would not last for whole sequences.
        end_at_lidar, cost_offset, relative, mirror: of :class:`agents.sb3_vec_env.ReplayVecEnv`.
        target_rate: effective frame rate to keep, Hz; the trigger cost is then adapted.
    """

    algorithm: str = "ppo"
    seed: int = 0
    stages: int = 20
    end_at_lidar: bool = True
    cost_offset: float | None = 0.05
    relative: bool = True
    mirror: bool = True
    target_rate: float | None = None

    def __post_init__(self) -> None:
        number("seed", self.seed, 0, 2**31 - 1)
        number("stages", self.stages, 1, 10_000)
        if self.target_rate is not None:
            number("target_rate", self.target_rate, 1.0, 50.0)


def train(
    options: Options,
    hyperparameters: Hyperparameters,
    make_env: MakeEnv,
    validation: Validation,
    folder: Path,
    card: Card,
    *,
    resume: bool = False,
    quiet: bool = False,
) -> Card:
    """Train, and leave the weights that validated best in ``folder`` as ``best.safetensors`` with their card.

    Args:
        options, hyperparameters: how.
        make_env: makes the environments; they are closed afterwards.
        validation: what chooses among the stages' networks.
        folder: of the run; exists.
        card: what is known of the weights beforehand, data and command.
        resume: go on from the folder's checkpoint.
        quiet: print nothing.

    Raises:
        ValueError: a target rate together with a range of costs, hyperparameters that the algorithm does
            not take, or a checkpoint of other settings.
    """
    ranged = isinstance(hyperparameters.trigger_cost, tuple)
    if options.target_rate is not None and ranged:
        raise ValueError(
            f"target_rate: found {options.target_rate} together with the costs "
            f"{hyperparameters.trigger_cost}, expected a single trigger_cost to begin with"
        )
    env = make_env(hyperparameters)
    try:
        gamma = 1.0 if options.end_at_lidar else None
        model = make_model(options.algorithm, hyperparameters, env, options.seed, gamma)
        run = _Run(options, hyperparameters, model, env, validation, folder, card)
        if resume:
            run.restore()
        else:
            standardise(model, _probe(env, options.seed))
        return run.go(quiet)
    finally:
        env.close()


class _Run(BaseCallback):
    """The moving parts of one training; as a callback it stands between rollouts."""

    def __init__(
        self,
        options: Options,
        hyperparameters: Hyperparameters,
        model: BaseAlgorithm,
        env: ReplayVecEnv,
        validation: Validation,
        folder: Path,
        card: Card,
    ) -> None:
        super().__init__()
        self._options, self._hyperparameters = options, hyperparameters
        self._model, self._env, self._validation = model, env, validation
        self._folder, self._card = folder, card
        self._progress = Progress()
        self._judge, self._constraint = self._kind()
        # Whole sequences, because every stage starts with their beginnings.
        sequence = env.env.slices * env.num_envs
        self._stage_steps = -(-hyperparameters.timesteps // (options.stages * sequence)) * sequence
        self._began = time.monotonic()
        self._begun = -1

    def _kind(self) -> tuple[Judge, RateConstraint | None]:
        cost, target = self._hyperparameters.trigger_cost, self._options.target_rate
        if isinstance(cost, tuple):
            return ByRegret(), None
        if target is not None:
            return ByErrorAtRate(target), RateConstraint(self._env, target, cost)
        return ByCost(cost, self._hyperparameters.error_scale), None

    @property
    def settings(self) -> dict[str, Any]:
        """What a resumed run must share; as JSON would give it back."""
        return _plain(
            {"options": asdict(self._options), "hyperparameters": asdict(self._hyperparameters)}
            | {"data": self._card.data}
        )

    def restore(self) -> None:
        """Continue from the last checkpoint."""
        self._progress = checkpoint.load(self._folder / LAST, self._model, self.settings)
        if self._constraint is not None and self._progress.trigger_cost is not None:
            self._constraint.cost = self._progress.trigger_cost

    def go(self, quiet: bool) -> Card:
        """Take all steps that are left."""
        total = self._hyperparameters.timesteps
        first = self._model.num_timesteps
        self._log = Log(self._folder, first, total, True, quiet)
        try:
            self._model.set_logger(Logger(None, [_LogWriter(self._log)]))
            if first < total:
                callbacks: list[BaseCallback] = [self]
                if self._constraint is not None:
                    callbacks.append(self._constraint)
                # Lines of the log come at fixed steps, not at Stable-Baselines3's, which count from a resume.
                model: Any = self._model
                model.learn(
                    total - first, CallbackList(callbacks), log_interval=None, reset_num_timesteps=False
                )
                self._finish_stage()
        finally:
            self._log.close()
        card = read_card(self._folder / BEST)
        assert card is not None
        facts = {"steps_in_all": self._model.num_timesteps, "seconds": round(self._progress.seconds, 1)}
        card = replace(card, training={**card.training, **facts})
        write_card(self._folder / BEST, card)
        return card

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        stage = self._progress.stage
        if self._begun < 0:
            self._begin_stage()
        elif self.num_timesteps >= (stage + 1) * self._stage_steps:
            self._finish_stage()
            self._begin_stage()
        elif self.num_timesteps // LOG_EVERY > self._logged:
            self._write_line()

    def _begin_stage(self) -> None:
        """Seed everything from the number of the stage and start the environments anew."""
        self._begun = self._progress.stage
        self._logged = self.num_timesteps // LOG_EVERY
        draws = np.random.SeedSequence([self._options.seed, self._begun]).generate_state(2)
        set_random_seed(int(draws[0]))
        self._model.action_space.seed(int(draws[0]))
        self._env.seed(int(draws[1]) // 2)
        model: Any = self._model
        model._last_obs = self._env.reset()
        model._last_episode_starts = np.ones(self._env.num_envs, np.bool_)
        model.ep_info_buffer.clear()
        if self._constraint is not None:
            self._constraint.apply()

    def _finish_stage(self) -> None:
        """Validate, keep the network if it is the best, and write the checkpoint."""
        self._write_line()
        progress = self._progress
        network = decider(self._model, self._hyperparameters)
        verdict = self._judge(network, self._validation)
        self._log.scalars(self._model.num_timesteps, "validation", verdict.scalars)
        progress.stage = self._begun + 1
        if self._constraint is not None:
            progress.trigger_cost = self._constraint.cost
        now = time.monotonic()
        progress.seconds += now - self._began
        self._began = now
        if progress.best is None or verdict.criterion < progress.best:
            progress.best, progress.best_stage = verdict.criterion, progress.stage
            card = replace(
                self._card,
                options=network.options,
                training={**self._card.training, **self._facts()},
                metrics={**self._card.metrics, "validation": verdict.metrics},
            )
            write_weights(self._folder / BEST, network.state_dict(), card)
        checkpoint.save(self._folder / LAST, self._model, progress, self.settings)

    def _write_line(self) -> None:
        """Log what was learned since the last line."""
        self._logged = self._model.num_timesteps // LOG_EVERY
        returns = [episode["r"] for episode in self._model.ep_info_buffer or ()]
        if returns:
            self._model.logger.record("rollout/return", float(np.mean(returns)))
        self._model.logger.dump(self._model.num_timesteps)

    def _facts(self) -> dict[str, Any]:
        return {
            "options": asdict(self._options),
            "hyperparameters": _plain(asdict(self._hyperparameters)),
            "steps": self._model.num_timesteps,
            "seconds": round(self._progress.seconds, 1),
            "trigger_cost": self._progress.trigger_cost,
            "threads": torch.get_num_threads(),
            "stable_baselines3": stable_baselines3.__version__,
            "torch": torch.__version__,
            "python": platform.python_version(),
        }


def _probe(env: ReplayVecEnv, seed: int) -> Any:
    """Observations of random actions: ``(n, ...)`` or a dict of them."""
    rng = np.random.default_rng(seed)
    env.seed(seed)
    seen = [env.reset()]
    for _ in range(PROBE_STEPS):
        env.step_async(rng.integers(2, size=env.num_envs))
        seen.append(env.step_wait()[0])
    if isinstance(seen[0], dict):
        return {name: np.concatenate([part[name] for part in seen]) for name in seen[0]}
    return np.concatenate(seen)


def _plain(value: Any) -> Any:
    """``value`` with plain dicts and lists in place of other mappings and tuples."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, (list, tuple)) else value


class _LogWriter(KVWriter):
    """Stable-Baselines3's numbers into a run's log; times are left out, so that equal runs log alike."""

    def __init__(self, log: Log) -> None:
        self._log = log

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        """One line of what was learned since the last."""
        values = {
            key.removeprefix("train/"): float(value)
            for key, value in key_values.items()
            if isinstance(value, (int, float, np.number)) and not key.startswith("time/")
        }
        if "loss" in values:  # not before the first update
            self._log.scalars(step, "train", values)

    def close(self) -> None:
        """The log's owner closes it."""
