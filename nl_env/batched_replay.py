"""Many environments of ``nl_env/Replay-v0`` with ``errors="table"`` in one process, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from nl_env.batched_ledger import BatchedLedger
from nl_env.config import choice, number
from nl_env.costs import ANY_COST, TriggerCost, check_trigger_cost, draw_trigger_cost, episode_cost
from nl_env.depth.metrics import LOWER_IS_BETTER, METRIC_NAMES
from nl_env.env import INFO_METRICS, AdaptiveDepthEnv, checked_options
from nl_env.ledger import EXTRAPOLATED, LIDAR
from nl_env.observations import (
    cost_coordinate,
    observation_space,
    signed_from_image,
    state_vector,
    statistics_observation,
)
from nl_env.replay import choose_sequence, find_recordings, recording_stream, trace_stream
from nl_env.statistics import ActivityMemory
from nl_env.trace_files import COLUMNS
from nl_env.trace_stack import TraceStack
from nl_env.trace_stream import no_frames
from nl_env.types import SLICE_US


class BatchedReplayEnv(VectorEnv[Any, Any, Any]):
    """The vector environment of ``nl_env/Replay-v0``: stored traces, no networks; arrays, no loops.

    Step by step it equals a ``SyncVectorEnv`` of ``nl_env/Replay-v0`` with ``errors="table"``, seeds and
    autoreset included. ``gymnasium.make_vec("nl_env/Replay-v0", num_envs=64, data=...)`` makes one.

    Args:
        num_envs: number of environments.
        data, split, sequences, lidar_hz, beams: recordings, as for ``nl_env/Replay-v0``.
        errors: ``"table"``; the full computation has no batched form.
        tables, extrapolator, odometry: which stored traces, as for ``nl_env/Replay-v0``.
        obs_mode, error, error_scale, trigger_cost: as for ``nl_env/Replay-v0``.
        render_mode: None; traces hold no depth frames to draw.
        autoreset_mode: ``"NextStep"``, ``"SameStep"`` or ``"Disabled"``, or the member of
            :class:`gymnasium.vector.AutoresetMode`.

    Raises:
        FileNotFoundError: no recordings, or no traces of them.
        ValueError: an argument out of range, or traces of something else.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        data: str | Path,
        split: str | None = None,
        sequences: Sequence[int] | None = None,
        lidar_hz: int | None = None,
        beams: int | None = None,
        errors: str = "table",
        tables: str | Path | None = None,
        extrapolator: str = "unet",
        odometry: bool = False,
        obs_mode: str = "image",
        error: str = "log_mae",
        error_scale: float = 0.05,
        trigger_cost: TriggerCost = 0.1,
        render_mode: str | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    ) -> None:
        number("num_envs", num_envs, 1, 1_000_000)
        choice("error", error, METRIC_NAMES)
        number("error_scale", error_scale, 1e-9, 1e9)
        check_trigger_cost(trigger_cost)
        if errors != "table":
            raise ValueError(
                f"errors: found {errors!r}, but many environments at once replay stored traces; expected "
                "'table', or vectorization_mode='sync' or 'async'"
            )
        if render_mode is not None:
            raise ValueError(f"render_mode: found {render_mode!r}, but traces hold no depth; expected None")
        recordings = find_recordings(Path(data))
        if not recordings:
            raise ValueError(f"data: found no recordings in {data}, expected some; only they have traces")
        stream = trace_stream(
            recording_stream(recordings, split, sequences, lidar_hz, beams),
            Path(data),
            tables,
            extrapolator,
            odometry,
        )
        self.num_envs = num_envs
        self.metadata = {**AdaptiveDepthEnv.metadata, "autoreset_mode": AutoresetMode(autoreset_mode)}
        self._cost: TriggerCost = trigger_cost
        if isinstance(trigger_cost, (tuple, list)):
            self._cost = float(trigger_cost[0]), float(trigger_cost[1])
        self._costs_shown = isinstance(self._cost, tuple)
        self.single_observation_space = observation_space(
            obs_mode, stream.camera.shape, costs=self._costs_shown
        )
        self.single_action_space = spaces.Discrete(2)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._obs_mode = obs_mode
        self._error_scale = error_scale
        self._lower_is_better = LOWER_IS_BETTER[error]
        self._sequences = stream.seeds
        self._slices = stream.slices
        self._pixels = stream.camera.height * stream.camera.width
        self._metrics = tuple(dict.fromkeys((*INFO_METRICS, error)))
        self._error_column = self._metrics.index(error)
        self._stack = TraceStack(stream, self._metrics, statistics=obs_mode == "statistics")
        self._ledger = BatchedLedger(num_envs, stream.lidar_period)
        self._activity = ActivityMemory((num_envs,)) if obs_mode == "statistics" else None
        self._rngs: list[np.random.Generator | None] = [None] * num_envs
        self._rows = np.zeros(num_envs, np.int64)
        self._pending = np.zeros(num_envs, np.int64)  # the slice last observed
        self._costs = np.zeros(num_envs)
        self._ended = np.zeros(num_envs, np.bool_)
        self._started = np.zeros(num_envs, np.bool_)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start a sequence in every environment, or in those of ``options["reset_mask"]``.

        Args:
            seed: environment i gets ``seed + i``, or the i-th of a list.
            options: as for one environment, for all of them; ``"reset_mask"`` is ``(n,)`` bool.

        Raises:
            ValueError: unknown options, a number of seeds that is not ``num_envs``, or an empty mask.
            TypeError: a mask that is no array of bool.
        """
        if self.closed:
            raise gym.error.ClosedEnvironmentError("reset: the environment is closed; make a new one")
        if seed is None or isinstance(seed, (int, np.integer)):
            seeds = [None if seed is None else int(seed) + i for i in range(self.num_envs)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: found {len(seeds)} seeds, expected num_envs={self.num_envs}")
        options = dict(options or {})
        mask = self._checked_mask(options.pop("reset_mask", np.ones(self.num_envs, np.bool_)))
        options = checked_options(options)
        self._start(mask, seeds, options)
        if self._activity is not None:
            self._see(mask)
        scored = self._scores(self._ledger.index)
        return self._observations(), self._infos(mask, np.zeros_like(mask), scored)

    def step(
        self, actions: Any
    ) -> tuple[Any, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Act in every environment; those that ended start their next sequence as the autoreset mode says.

        Raises:
            ValueError: an action that is not 0 or 1.
            ResetNeeded: before ``reset``, or after an end with autoreset disabled.
        """
        self._require_started()
        mode = self.metadata["autoreset_mode"]
        resetting = self._ended.copy()
        if mode is AutoresetMode.DISABLED and resetting.any():
            raise gym.error.ResetNeeded(
                f"step: environments {np.flatnonzero(resetting).tolist()} ended; reset them with a reset_mask"
            )
        live = ~resetting
        actions = self._checked_actions(actions, live)
        lidar = self._stack.columns["lidar"][self._rows, self._pending]
        triggered = self._ledger.act(live, lidar, actions)
        if self._activity is not None:
            self._activity.act(triggered)
        truncated = live & (self._pending == self._slices)
        self._start(resetting, [None] * self.num_envs, {})  # NEXT_STEP: this step of theirs is the reset
        scored = self._scores(self._ledger.index)
        rewards = np.where(live, self._rewards(scored, triggered), 0.0)
        infos: dict[str, Any] = {}
        if mode is AutoresetMode.SAME_STEP and truncated.any():
            infos = self._final_infos(truncated, triggered, scored)
            self._start(truncated, [None] * self.num_envs, {})
            triggered = triggered & ~truncated
            scored = self._scores(self._ledger.index)
            self._ended[:] = False
            moved = np.ones(self.num_envs, np.bool_)
        else:
            self._ended = truncated.copy()
            moved = ~truncated
        self._pending = np.where(moved, self._ledger.index + 1, self._pending)
        if self._activity is not None:
            self._see(moved)
        infos |= self._infos(np.ones(self.num_envs, np.bool_), triggered, scored)
        return self._observations(), rewards, np.zeros(self.num_envs, np.bool_), truncated, infos

    def set_trigger_cost(self, cost: float) -> None:
        """Let triggers cost ``cost`` from the next action on, in every environment, for constrained training.

        Raises:
            ValueError: not a number of at least 0, or the costs are drawn from a range.
        """
        if isinstance(self._cost, tuple):
            raise ValueError(
                f"set_trigger_cost: each episode draws its cost from {self._cost}, "
                "expected an environment made with a single trigger_cost"
            )
        number("cost", cost, *ANY_COST)
        self._cost = float(cost)
        self._costs[:] = cost

    def redraw_trigger_costs(self, where: NDArray[np.bool_]) -> None:
        """Draw new costs in the environments of ``where`` ``(n,)``; the next observation shows them.

        For training that takes every LiDAR interval for an episode of its own.

        Raises:
            ValueError: there is one cost, no range to draw from.
        """
        if not isinstance(self._cost, tuple):
            raise ValueError(f"redraw_trigger_costs: found the cost {self._cost}, expected a range of costs")
        for i in np.flatnonzero(where).tolist():
            rng = self._rngs[i]
            assert rng is not None
            self._costs[i] = draw_trigger_cost(self._cost, rng)

    @property
    def slices(self) -> int:
        """Steps of every sequence."""
        return self._slices

    @property
    def trigger_costs(self) -> NDArray[np.float64]:
        """``(n,)`` float64, what a trigger costs in each running episode."""
        return self._costs.copy()

    @property
    def fresh_rewards(self) -> NDArray[np.float64]:
        """``(n,)`` reward that a depth frame made at the slice acted on next earns, its trigger left out."""
        errors = self._stack.errors[:, self._rows, self._pending, 0]
        return self._reward_parts(errors, np.zeros(self.num_envs, np.bool_))[0]

    @property
    def sequences(self) -> NDArray[np.int64]:
        """``(n,)`` int64, the sequence that each environment replays."""
        return np.array(self._sequences)[self._rows]

    def render(self) -> None:
        """Not possible: raises ``RuntimeError``."""
        no_frames("render")

    def _start(self, where: NDArray[np.bool_], seeds: Sequence[int | None], options: dict[str, Any]) -> None:
        """Start a sequence in the environments of ``where``; their first observed slice is 1."""
        if not where.any():
            return
        for i in np.flatnonzero(where).tolist():
            if seeds[i] is not None or self._rngs[i] is None:
                self._rngs[i] = seeding.np_random(seeds[i])[0]
            rng = self._rngs[i]
            assert rng is not None
            sequence = choose_sequence(self._sequences, seeds[i], options, rng)
            self._costs[i] = episode_cost(self._cost, options, rng)
            self._rows[i] = self._stack.row(sequence)
        self._ledger.reset(where)
        self._pending[where] = 1
        self._ended[where] = False
        self._started[where] = True
        if self._activity is not None:
            self._activity.reset(where)

    def _see(self, where: NDArray[np.bool_]) -> None:
        """Let the environments of ``where`` take in the slice they act on next."""
        assert self._activity is not None
        others = ~where
        kept = self._activity.windows[others]
        self._activity.see(
            self._stack.statistics[self._rows, self._pending],
            self._stack.columns["lidar"][self._rows, self._pending],
        )
        self._activity.windows[others] = kept

    def _scores(self, index: NDArray[np.int64]) -> NDArray[np.float64]:
        """``(metrics, n)`` errors of the held depth at slices ``index``."""
        return self._stack.errors[:, self._rows, index, index - self._ledger.held_index]

    def _rewards(self, scored: NDArray[np.float64], triggered: NDArray[np.bool_]) -> NDArray[np.float64]:
        error, trigger = self._reward_parts(scored, triggered)
        return error + trigger

    def _reward_parts(
        self, scored: NDArray[np.float64], triggered: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """:func:`nl_env.rewards.components` of every environment, ``(n,)`` each."""
        error = scored[self._error_column]
        if not self._lower_is_better:
            error = 1.0 - error
        error = np.where(np.isnan(error), 0.0, -error / self._error_scale)
        return error, np.where(triggered, -self._costs, 0.0)

    def _infos(
        self, where: NDArray[np.bool_], triggered: NDArray[np.bool_], scored: NDArray[np.float64]
    ) -> dict[str, Any]:
        """Infos of the slices acted on last, in the environments of ``where``; zeros elsewhere."""
        ledger = self._ledger
        error, trigger = self._reward_parts(scored, triggered)
        infos: dict[str, Any] = {
            "t": ledger.index * SLICE_US,
            "triggered": triggered.copy(),
            "depth_age": ledger.age * SLICE_US,
            **{name: scored[self._metrics.index(name)] for name in INFO_METRICS},
            "held_depth_source": _SOURCES[ledger.extrapolated.astype(np.int64)],
            **{name: self._stack.columns[name][self._rows, ledger.index] for name in COLUMNS},
            "effective_rate": ledger.effective_rate,
            "reward/error": error,
            "reward/trigger": trigger,
        }
        if not where.all():
            for values in infos.values():
                values[~where] = None if values.dtype == object else 0
        return infos | {f"_{name}": where.copy() for name in infos}

    def _final_infos(
        self, where: NDArray[np.bool_], triggered: NDArray[np.bool_], scored: NDArray[np.float64]
    ) -> dict[str, Any]:
        """Observation and info of the last slice of the environments of ``where``, which ended."""
        envs = np.flatnonzero(where)
        batch = self._observations(envs)
        final = np.full(self.num_envs, None, object)
        for place, env in enumerate(envs.tolist()):
            if isinstance(batch, dict):
                final[env] = {name: part[place] for name, part in batch.items()}
            else:
                final[env] = batch[place]
        infos = {"final_obs": final, "final_info": self._infos(where, triggered, scored.copy())}
        return infos | {f"_{name}": where.copy() for name in infos}

    def _observations(self, envs: Any = slice(None)) -> Any:
        """What the environments that the index ``envs`` selects observe, fresh."""
        rows, index = self._rows[envs], self._pending[envs]
        if self._obs_mode in ("image", "signed"):
            images = self._stack.images(rows, index)
            return images if self._obs_mode == "image" else signed_from_image(images)
        ledger, columns = self._ledger, self._stack.columns
        since_lidar, since_depth = ledger.staleness(
            self._pending, columns["lidar"][self._rows, self._pending]
        )
        state = state_vector(
            since_lidar[envs],
            since_depth[envs],
            columns["event_count"][rows, index],
            self._pixels,
            ledger.last_action[envs],
        )
        costs = self._costs[envs] if self._costs_shown else None
        if self._activity is not None:
            return statistics_observation(state, self._activity.observed()[envs], costs)
        shown = {"event_frame": self._stack.images(rows, index), "state": state}
        return shown if costs is None else shown | {"trigger_cost": cost_coordinate(costs)[:, None]}

    def _checked_actions(self, actions: Any, live: NDArray[np.bool_]) -> NDArray[np.int64]:
        actions = np.asarray(actions)
        if actions.shape != (self.num_envs,) or not np.issubdtype(actions.dtype, np.integer):
            raise ValueError(
                f"actions: found shape {actions.shape} dtype {actions.dtype}, "
                f"expected ({self.num_envs},) integers, 0 (hold) or 1 (trigger)"
            )
        wrong = live & (actions != 0) & (actions != 1)
        if wrong.any():
            raise ValueError(f"actions: found {actions[wrong][0]}, expected 0 (hold) or 1 (trigger)")
        return actions.astype(np.int64)

    def _checked_mask(self, mask: Any) -> NDArray[np.bool_]:
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            raise TypeError(f"options['reset_mask']: found {mask!r}, expected an array of bool")
        if mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(
                f"options['reset_mask']: found {mask!r}, expected shape ({self.num_envs},) and a True in it"
            )
        if not (mask | self._started).all():
            raise gym.error.ResetNeeded("reset: the first reset needs every environment, found a mask")
        return mask.copy()

    def _require_started(self) -> None:
        if self.closed:
            raise gym.error.ClosedEnvironmentError("step: the environment is closed; make a new one")
        if not self._started.all():
            raise gym.error.ResetNeeded("step: no sequence was started; call reset() first")


_SOURCES = np.array([LIDAR, EXTRAPOLATED], object)
"""Names of the held depth's sources, by whether it is extrapolated."""
