"""A target frame rate as a constraint: the trigger cost is its Lagrange multiplier, adapted in training."""

from __future__ import annotations

import math

from stable_baselines3.common.callbacks import BaseCallback

from agents.sb3_vec_env import ReplayVecEnv
from nl_env.costs import COST_RANGE

REFERENCE_HZ = 10.0
REFERENCE_STEPS = 1e5


class RateConstraint(BaseCallback):
    """Raises the cost of triggers while there are too many of them, and lowers it while there are too few.

    Dual ascent on the logarithm of the cost, after every rollout.

    Args:
        env: whose cost is set.
        rate_hz: effective frame rate to keep.
        cost: to begin with.
        speed: a rate 10 Hz too high multiplies the cost by ``exp(speed)`` in 100,000 steps.
    """

    def __init__(self, env: ReplayVecEnv, rate_hz: float, cost: float, speed: float = 2.0) -> None:
        super().__init__()
        self._env = env
        self._rate_hz = rate_hz
        self._speed = speed
        self._seen = 0
        self.cost = cost

    def apply(self) -> None:
        """Charge the present cost."""
        self._env.set_trigger_cost(self.cost)

    def _on_training_start(self) -> None:
        self._seen = self.num_timesteps
        self.apply()

    def _on_rollout_end(self) -> None:
        rate = self._env.take_rate()
        steps = self.num_timesteps - self._seen
        self._seen = self.num_timesteps
        if not steps:
            return
        change = self._speed * (rate - self._rate_hz) / REFERENCE_HZ * steps / REFERENCE_STEPS
        low, high = COST_RANGE
        self.cost = min(max(self.cost * math.exp(change), low), high)
        self.apply()
        self.logger.record("rollout/rate_hz", rate)
        self.logger.record("rollout/trigger_cost", self.cost)

    def _on_step(self) -> bool:
        return True
