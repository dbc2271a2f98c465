"""Stored traces as the vector environment of Stable-Baselines3: many episodes in one process, as arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from nl_env.batched_replay import BatchedReplayEnv
from nl_env.observations import STATE_FIELDS, cost_coordinate
from nl_env.statistics import ACTIVITY_FIELDS, GRID
from nl_env.types import SLICE_US


class ReplayVecEnv(VecEnv):
    """A :class:`nl_env.batched_replay.BatchedReplayEnv` in Stable-Baselines3's terms.

    Two changes make learning easier and leave the best policy as it is:

    * Nothing that is done before a LiDAR frame matters after it. With ``end_at_lidar`` an episode ends there,
      so that returns are sums of at most one LiDAR interval and need no discount; the sequence goes on. Where
      costs are drawn from a range, each of these episodes draws its own.
    * With ``cost_offset`` rewards are divided by the trigger cost plus this, so that costs of 0.01 and of 1
      weigh alike in one batch. Within an episode that is a constant.

    Args:
        env: with autoreset ``SAME_STEP``; owned and closed by this one.
        end_at_lidar: see above.
        cost_offset: see above; None leaves rewards as they are.
        mirror: show every second environment's events mirrored left to right.

    Raises:
        ValueError: another autoreset mode, or a cost offset that is not positive.
    """

    def __init__(
        self,
        env: BatchedReplayEnv,
        *,
        end_at_lidar: bool = False,
        cost_offset: float | None = None,
        mirror: bool = False,
    ) -> None:
        mode = env.metadata["autoreset_mode"]
        if mode is not AutoresetMode.SAME_STEP:
            raise ValueError(f"env: found autoreset mode {mode}, expected {AutoresetMode.SAME_STEP}")
        if cost_offset is not None and not cost_offset > 0:
            raise ValueError(f"cost_offset: found {cost_offset!r}, expected a positive number or None")
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._end_at_lidar = end_at_lidar
        self._cost_offset = cost_offset
        self._drawn = end_at_lidar and _shows_cost(env)
        self._mirrored = np.arange(env.num_envs) % 2 == 1 if mirror else np.zeros(env.num_envs, np.bool_)
        self._returns = np.zeros(env.num_envs)
        self._lengths = np.zeros(env.num_envs, np.int64)
        self._steps = self._frames = 0

    def reset(self) -> Any:
        """Start a sequence everywhere, with the seeds that :meth:`seed` left."""
        observations, _ = self.env.reset(seed=self._seeds)
        self._reset_seeds()
        self._reset_options()
        self._returns[:] = 0.0
        self._lengths[:] = 0
        self._steps = self._frames = 0
        self._costs = self.env.trigger_costs
        return self._shown(observations)

    def step_async(self, actions: NDArray[np.int64]) -> None:
        """Keep the actions for :meth:`step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Act everywhere. Where an episode ended, the observation is the next one's first."""
        observations, rewards, _, truncated, found = self.env.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        # Where a sequence ended these columns are of the next one's start; what ended is in "final_info".
        lidar, triggered = found["lidar"].copy(), found["triggered"].copy()
        self._returns += rewards
        self._lengths += 1
        ended = np.flatnonzero(truncated)
        if len(ended):
            final = found["final_info"]
            lidar[ended], triggered[ended] = final["lidar"][ended], final["triggered"][ended]
            for i in ended.tolist():
                infos[i]["episode"] = {"r": float(self._returns[i]), "l": int(self._lengths[i]), "t": 0.0}
            self._returns[ended] = 0.0
            self._lengths[ended] = 0
        self._steps += self.num_envs
        self._frames += int(np.count_nonzero(lidar | triggered))
        shown = self._shown(observations)
        over = lidar if self._end_at_lidar else np.zeros_like(truncated)
        scale = None if self._cost_offset is None else self._costs + self._cost_offset
        for i in np.flatnonzero(truncated | over).tolist():
            last = self._shown_one(found["final_obs"][i], i) if truncated[i] else _row(shown, i)
            infos[i]["terminal_observation"] = last
            infos[i]["TimeLimit.truncated"] = bool(truncated[i] and not over[i])
        if scale is not None:
            rewards = rewards / scale
        if self._drawn and over.any():
            shown = self._redraw(shown, over & ~truncated)
        if len(ended) or self._drawn:
            self._costs = self.env.trigger_costs
        return shown, rewards.astype(np.float32), truncated | over, infos

    def _redraw(self, shown: Any, where: NDArray[np.bool_]) -> Any:
        """``shown`` with new costs in the environments of ``where``; the given arrays are left alone."""
        self.env.redraw_trigger_costs(where)
        coordinates = cost_coordinate(self.env.trigger_costs)
        if isinstance(shown, dict):
            return shown | {"trigger_cost": coordinates[:, None]}
        shown = shown.copy()  # terminal observations are rows of it
        shown[:, -1] = coordinates
        return shown

    def take_rate(self) -> float:
        """Effective frame rate over all environments since the last call or reset, Hz; nan without a step."""
        steps, frames = self._steps, self._frames
        self._steps = self._frames = 0
        return frames * 1e6 / (steps * SLICE_US) if steps else float("nan")

    def set_trigger_cost(self, cost: float) -> None:
        """As :meth:`nl_env.batched_replay.BatchedReplayEnv.set_trigger_cost`."""
        self.env.set_trigger_cost(cost)
        self._costs = self.env.trigger_costs

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """The attribute of the one object that stands for all environments."""
        return [getattr(self.env, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute for all environments; some of them alone cannot have their own."""
        self._require_all(indices)
        setattr(self.env, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method once, for all environments."""
        self._require_all(indices)
        target = self if hasattr(type(self), method_name) else self.env
        return [getattr(target, method_name)(*method_args, **method_kwargs)] * self.num_envs

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        """Nothing is wrapped."""
        return [False] * len(list(self._get_indices(indices)))

    def _require_all(self, indices: VecEnvIndices) -> None:
        if indices is not None and len(set(self._get_indices(indices))) != self.num_envs:
            raise ValueError(f"indices: found {indices!r}, expected None: all environments are one object")

    def _shown(self, observations: Any) -> Any:
        """Observations, mirrored where they are to be; may write into the given arrays, which are fresh."""
        if not self._mirrored.any():
            return observations
        if isinstance(observations, dict):
            return observations | {"event_frame": self._shown(observations["event_frame"])}
        observations[self._mirrored] = mirrored(observations[self._mirrored])
        return observations

    def _shown_one(self, observation: Any, place: int) -> Any:
        if not self._mirrored[place]:
            return observation
        if isinstance(observation, dict):
            return observation | {"event_frame": mirrored(observation["event_frame"])}
        return mirrored(observation)


def _shows_cost(env: BatchedReplayEnv) -> bool:
    space = env.single_observation_space
    if isinstance(space, spaces.Dict):
        return "trigger_cost" in space.spaces
    return space.shape == (len(STATE_FIELDS) + ACTIVITY_FIELDS + 1,)


def mirrored(observations: NDArray[Any]) -> NDArray[Any]:
    """Images ``(..., H, W)``, or float32 ``"statistics"`` ``(..., n)``, with left and right swapped."""
    if observations.dtype != np.float32:
        return observations[..., ::-1].copy()
    return observations[..., _mirror_order(observations.shape[-1])]


def _mirror_order(fields: int) -> NDArray[np.int64]:
    """Where every number of a mirrored observation comes from."""
    order = np.arange(fields)
    activity = order[len(STATE_FIELDS) : len(STATE_FIELDS) + ACTIVITY_FIELDS]
    activity[:] = activity.reshape(-1, *GRID)[..., ::-1].ravel()
    return order


def _row(observations: Any, place: int) -> Any:
    if isinstance(observations, dict):
        return {name: array[place] for name, array in observations.items()}
    return observations[place]
