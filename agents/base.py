"""What every trigger policy shares: Stable-Baselines3's ``predict``, for one observation or a batch.

A policy keeps no memory of its own between calls. What it must remember travels in ``state``, one row
for each environment of the batch, and ``episode_start`` resets rows, as SB3's recurrent policies do it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from nl_env.depth.metrics import full_metrics
from nl_env.env import AdaptiveDepthEnv
from nl_env.keyframes import label_keyframe
from nl_env.observations import event_frames

Actions = NDArray[np.int64]
Memory = NDArray[Any]


class Policy(ABC):
    """Decides at every slice whether to trigger.

    Attributes:
        privileged: True if the policy looks at more than the observation.
        obs_mode: the environment's mode that evaluation shows it; :meth:`read` may accept others.
        trigger_cost: what to tell policies that want to know what a trigger costs; None for the others.
    """

    privileged = False
    obs_mode = "image"
    trigger_cost: float | None = None

    def predict(
        self,
        observation: Any,
        state: Memory | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Any, Memory]:
        """Stable-Baselines3's signature.

        Args:
            observation: single or a batch of n, of a mode that :meth:`read` accepts.
            state: the second return value of the previous call; None starts anew.
            episode_start: ``(n,)`` bool, True where an environment has just been reset.
            deterministic: no effect; the policies here have no second, noisier behaviour.

        Returns:
            ``(action, state)``: an ``np.int64`` for a single observation, ``(n,)`` int64 for a batch.
        """
        seen, batched = self.read(observation)
        count = len(seen)
        memory = self.initial_memory(count) if state is None else state.copy()
        if episode_start is not None:
            started = np.broadcast_to(np.asarray(episode_start, dtype=bool), count)
            memory[started] = self.initial_memory(count)[started]
        actions = self.decide(seen, memory)
        return (actions if batched else actions[0]), memory

    def read(self, observation: Any) -> tuple[NDArray[Any], bool]:
        """What :meth:`decide` sees, ``(n, ...)``, and whether the observation was a batch.

        Event frames ``(n, H, W)`` int16 here, from every mode that holds them.
        """
        frames = event_frames(observation)
        return (frames, True) if frames.ndim == 3 else (frames[None], False)

    def initial_memory(self, count: int) -> Memory:
        """``(count, ...)`` memory at the start of an episode, of any dtype; by default nothing."""
        return np.zeros((count, 0), dtype=np.int64)

    @abstractmethod
    def decide(self, seen: NDArray[Any], memory: Memory) -> Actions:
        """Actions ``(n,)`` for what :meth:`read` gives; updates ``memory`` in place."""


class Trace(Protocol):
    """The part of a precomputed sequence that privileged policies read (``nl_env.traces.SequenceTrace``).

    Attributes:
        keyframe: ``(K+1,)`` bool, the keyframe label of every slice, t = 0 first.
        lidar: ``(K+1,)`` bool, slices with a LiDAR frame.
        ego_speed: ``(K+1,)`` m/s.
        errors: for each metric ``(K+1, P)`` float64: the error at slice k of the depth frame produced
            at slice k - a of the same LiDAR interval, NaN where there is none.
    """

    @property
    def keyframe(self) -> NDArray[np.bool_]: ...
    @property
    def lidar(self) -> NDArray[np.bool_]: ...
    @property
    def ego_speed(self) -> NDArray[np.float64]: ...
    @property
    def errors(self) -> Any: ...


class Truth(Protocol):
    """What a privileged policy may ask about the slice it acts on."""

    def keyframe(self, index: int) -> bool:
        """The keyframe label of slice ``index``."""
        ...

    def lidar(self, index: int) -> bool:
        """Whether a LiDAR frame arrives at slice ``index``."""
        ...

    def ego_speed(self, index: int) -> float:
        """Speed of the vehicle at slice ``index``, m/s."""
        ...

    def holding_error(self, index: int, age: int) -> float:
        """``log_mae`` at slice ``index`` of the held depth frame, made ``age`` slices before."""
        ...


class LiveTruth:
    """:class:`Truth` of a running environment; indices are implied by where it stands."""

    def __init__(self, env: Any) -> None:
        if not isinstance(env.unwrapped, AdaptiveDepthEnv):
            raise TypeError(f"env: found {type(env.unwrapped).__name__}, expected an AdaptiveDepthEnv")
        self._env = env.unwrapped

    def keyframe(self, index: int) -> bool:
        return label_keyframe(self._env.sample.state).label

    def lidar(self, index: int) -> bool:
        return self._env.sample.lidar is not None

    def ego_speed(self, index: int) -> float:
        return float(self._env.sample.state.speed)

    def holding_error(self, index: int, age: int) -> float:
        return full_metrics(self._env.depth, self._env.sample.depth, self._env.stream.max_depth).log_mae


class TraceTruth:
    """:class:`Truth` of a precomputed sequence."""

    def __init__(self, trace: Trace) -> None:
        self._trace = trace

    def keyframe(self, index: int) -> bool:
        return bool(self._trace.keyframe[index])

    def lidar(self, index: int) -> bool:
        return bool(self._trace.lidar[index])

    def ego_speed(self, index: int) -> float:
        return float(self._trace.ego_speed[index])

    def holding_error(self, index: int, age: int) -> float:
        return float(self._trace.errors["log_mae"][index, age])


class PrivilegedPolicy(Policy):
    """A policy that knows the truth of one sequence at a time, so batches hold one observation.

    ``bind(env)`` connects it to a running environment, ``begin(trace)`` to a precomputed sequence. The
    first row of its memory counts slices; column 0 is the slice acted on last.
    """

    privileged = True

    def __init__(self) -> None:
        self._truth: Truth | None = None

    def bind(self, env: Any) -> None:
        """Read the truth from ``env.unwrapped``, an :class:`nl_env.env.AdaptiveDepthEnv`."""
        self._truth = LiveTruth(env)

    def begin(self, trace: Trace) -> None:
        """Read the truth from ``trace``; the next prediction is for its slice 1."""
        self._truth = TraceTruth(trace)

    def initial_memory(self, count: int) -> Memory:
        return np.zeros((count, 1), dtype=np.int64)

    def decide(self, frames: NDArray[np.int16], memory: Memory) -> Actions:
        if self._truth is None:
            raise RuntimeError(
                f"{type(self).__name__} is privileged: call bind(env) or begin(trace) before predict"
            )
        if len(memory) != 1:
            raise ValueError(
                f"observation: found a batch of {len(memory)}, "
                "expected one: a privileged policy follows one sequence"
            )
        memory[0, 0] += 1
        return np.array([self.choose(self._truth, memory[0])], dtype=np.int64)

    @abstractmethod
    def choose(self, truth: Truth, memory: Memory) -> bool:
        """Whether to trigger at slice ``memory[0]``; may update the rest of ``memory``."""
