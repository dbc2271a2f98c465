"""Stored traces as the vector environment of Stable-Baselines3: many episodes in one process, as arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from agents.pictures import MOST, PictureMemory, memory_size, picture, picture_shape
from nl_env.batched_replay import BatchedReplayEnv
from nl_env.observations import STATE_FIELDS, cost_coordinate
from nl_env.statistics import ACTIVITY_FIELDS, GRID
from nl_env.types import SLICE_US


class ReplayVecEnv(VecEnv):
    """A :class:`nl_env.batched_replay.BatchedReplayEnv` in Stable-Baselines3's terms.

    Three changes make learning easier and leave the best policy as it is:

    * Nothing that is done before a LiDAR frame matters after it. With ``end_at_lidar`` an episode ends there,
      so that returns are sums of at most one LiDAR interval and need no discount; the sequence goes on. Where
      costs are drawn from a range, each of these episodes draws its own.
    * With ``cost_offset`` rewards are divided by the trigger cost plus this, so that costs of 0.01 and of 1
      weigh alike in one batch. Within an episode that is a constant.
    * With ``relative`` rewards count from what a frame of every slice would earn, triggers left out. No
      decision changes that sum, which otherwise drowns what decisions do: some scenes are hard for all.

    Args:
        env: with autoreset ``SAME_STEP``; owned and closed by this one.
        end_at_lidar: see above.
        cost_offset: see above; None leaves rewards as they are.
        relative: see above.
        mirror: show every second environment's events mirrored left to right.
        pictures: show event frames as pictures (:mod:`agents.pictures`), in mode ``"dict"`` with a memory.

    Raises:
        ValueError: another autoreset mode, a cost offset that is not positive, or pictures in a mode that has
            none.
    """

    def __init__(
        self,
        env: BatchedReplayEnv,
        *,
        end_at_lidar: bool = False,
        cost_offset: float | None = None,
        relative: bool = False,
        mirror: bool = False,
        pictures: bool = False,
    ) -> None:
        mode = env.metadata["autoreset_mode"]
        if mode is not AutoresetMode.SAME_STEP:
            raise ValueError(f"env: found autoreset mode {mode}, expected {AutoresetMode.SAME_STEP}")
        if cost_offset is not None and not cost_offset > 0:
            raise ValueError(f"cost_offset: found {cost_offset!r}, expected a positive number or None")
        self.env = env
        space = env.single_observation_space
        self._pictures = _Pictures(space, env.num_envs) if pictures else None
        if self._pictures is not None:
            space = self._pictures.space
        super().__init__(env.num_envs, space, env.single_action_space)
        self._end_at_lidar = end_at_lidar
        self._cost_offset = cost_offset
        self._relative = relative
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
        return self._shown(observations, np.ones(self.num_envs, np.bool_))

    def step_async(self, actions: NDArray[np.int64]) -> None:
        """Keep the actions for :meth:`step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Act everywhere. Where an episode ended, the observation is the next one's first."""
        fresh = self.env.fresh_rewards if self._relative else 0.0
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
        finals = {i: self._shown_last(found["final_obs"][i], i) for i in ended.tolist()}
        shown = self._shown(observations, truncated)
        over = lidar if self._end_at_lidar else np.zeros_like(truncated)
        scale = None if self._cost_offset is None else self._costs + self._cost_offset
        for i in np.flatnonzero(truncated | over).tolist():
            infos[i]["terminal_observation"] = finals[i] if truncated[i] else _row(shown, i)
            infos[i]["TimeLimit.truncated"] = bool(truncated[i] and not over[i])
        rewards = rewards - fresh  # returns are told as they are
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

    def _shown(self, observations: Any, started: NDArray[np.bool_]) -> Any:
        """Observations, mirrored and as pictures where they are to be.

        May write into the given arrays, which are fresh. A sequence starts in environments of ``started``.
        """
        if self._mirrored.any():
            if isinstance(observations, dict):
                frames = observations["event_frame"]
                frames[self._mirrored] = mirrored(frames[self._mirrored])
            else:
                observations[self._mirrored] = mirrored(observations[self._mirrored])
        return observations if self._pictures is None else self._pictures.see(observations, started)

    def _shown_last(self, observation: Any, place: int) -> Any:
        """A sequence's last observation, of the slice that was seen last, as that was shown."""
        if self._pictures is not None:
            return self._pictures.again(observation, place)
        if not self._mirrored[place]:
            return observation
        if isinstance(observation, dict):
            return observation | {"event_frame": mirrored(observation["event_frame"])}
        return mirrored(observation)


class _Pictures:
    """Observations of modes ``"image"`` and ``"dict"`` with pictures in place of event frames.

    Args:
        space: of one environment.
        count: of environments.

    Attributes:
        space: with pictures.
    """

    def __init__(self, space: spaces.Space[Any], count: int) -> None:
        dictionary = isinstance(space, spaces.Dict)
        frames = space["event_frame"] if isinstance(space, spaces.Dict) else space
        if frames.dtype != np.uint8 or frames.shape is None:
            raise ValueError(f"pictures: found observations {space}, expected obs_mode 'image' or 'dict'")
        shape = picture_shape(*frames.shape[1:])
        boxes = spaces.Box(-MOST, MOST, (3 if dictionary else 2, *shape), np.int8)
        self.space = (
            spaces.Dict({**space.spaces, "event_frame": boxes}) if isinstance(space, spaces.Dict) else boxes
        )
        self._memory = np.zeros((count, memory_size(shape)), np.float32)
        self._shape = shape

    def see(self, observations: Any, started: NDArray[np.bool_]) -> Any:
        """The next observations of all environments; fresh."""
        if not isinstance(observations, dict):
            self._shown = picture(observations[:, 0])
            return self._shown.copy()
        self._memory[started] = 0.0
        since_depth = observations["state"][:, STATE_FIELDS.index("since_depth")]
        shown = picture(observations["event_frame"][:, 0])
        self._shown = PictureMemory(self._memory, self._shape).see(shown, since_depth)
        return observations | {"event_frame": self._shown.copy()}

    def again(self, observation: Any, place: int) -> Any:
        """One environment's observation of the slice that :meth:`see` took in last."""
        shown = self._shown[place].copy()
        return observation | {"event_frame": shown} if isinstance(observation, dict) else shown


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
