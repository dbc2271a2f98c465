"""The environment: at every 20 ms slice, hold the last depth frame or trigger a new one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from nl_env import rewards
from nl_env.config import SPLITS, choice, number
from nl_env.costs import ANY_COST, TriggerCost, check_trigger_cost, episode_cost
from nl_env.depth.extrapolators import make_extrapolator
from nl_env.depth.metrics import LOWER_IS_BETTER, METRIC_NAMES
from nl_env.held_depth import ComputedDepth, HeldDepth
from nl_env.keyframes import label_keyframe
from nl_env.ledger import DepthLedger
from nl_env.observations import (
    image_observation,
    make_observation,
    observation_space,
    state_vector,
)
from nl_env.statistics import ActivityMemory, slice_statistics
from nl_env.types import SLICE_US, DepthExtrapolator, Sample, SensorStream
from nl_env.viewer import PanelView, Timeline, Window, draw_panel

INFO_METRICS = ("log_mae", "imae", "bad_25", "rmse", "abs_rel")
"""Errors of the held depth frame that every ``info`` carries."""


def check_action(action: Any) -> int:
    """Return the action as 0 or 1; anything that is not the integer 0 or 1 raises ``ValueError``."""
    is_integer = isinstance(action, (int, np.integer)) or (
        isinstance(action, np.ndarray) and action.ndim == 0 and np.issubdtype(action.dtype, np.integer)
    )
    if not is_integer or int(action) not in (0, 1):
        raise ValueError(f"action: found {action!r}, expected the integer 0 (hold) or 1 (trigger)")
    return int(action)


class AdaptiveDepthEnv(gym.Env[Any, Any]):
    """Adaptive depth sensing over any :class:`nl_env.types.SensorStream`.

    ``nl_env/Driving-v0`` (:class:`nl_env.driving.DrivingEnv`) documents the task. This class holds
    everything that does not depend on where the samples come from.

    Args:
        stream: delivers the samples. The environment owns it and closes it.
        extrapolator: a name, a path to weights, or a :class:`nl_env.types.DepthExtrapolator`.
        odometry: give a named extrapolator the true camera poses.
        runtime: what runs a network: ``"auto"`` (CUDA where there is one, else PyTorch), ``"torch"``,
            ``"openvino"``, ``"onnxruntime"`` or ``"cuda"``.
        obs_mode: ``"image"``, ``"signed"``, ``"dict"`` or ``"statistics"``.
        error: the metric behind the reward; ``delta_n`` counts as ``1 - delta_n``.
        error_scale: the error that costs a reward of 1.
        trigger_cost: reward paid for one extrapolation; with a pair each episode draws its own, uniformly in
            the logarithm, and the observation shows it (modes ``"dict"`` and ``"statistics"``).
        min_depth: depths below are read as this one by the full-image metrics, m.
        render_mode: ``None``, ``"human"``, ``"rgb_array"`` or ``"depth_array"``.
        held_depth: what makes and scores depth frames; None for the extrapolator.

    Raises:
        ValueError: unknown name (the message lists the valid ones) or a number out of range.
    """

    metadata = {  # noqa: RUF012
        "render_modes": ["human", "rgb_array", "depth_array"],
        "render_fps": 1_000_000 // SLICE_US,
    }

    def __init__(
        self,
        stream: SensorStream,
        *,
        extrapolator: str | DepthExtrapolator = "unet",
        odometry: bool = False,
        runtime: str = "auto",
        obs_mode: str = "image",
        error: str = "log_mae",
        error_scale: float = 0.05,
        trigger_cost: TriggerCost = 0.1,
        min_depth: float = 1.0,
        render_mode: str | None = None,
        held_depth: HeldDepth | None = None,
    ) -> None:
        choice("error", error, METRIC_NAMES)
        choice("render_mode", render_mode, (None, *self.metadata["render_modes"]))
        number("error_scale", error_scale, 1e-9, 1e9)
        check_trigger_cost(trigger_cost)
        self._cost_range: tuple[float, float] | None = None
        if isinstance(trigger_cost, (tuple, list)):
            self._cost_range = (float(trigger_cost[0]), float(trigger_cost[1]))
        else:
            self._fixed_cost = float(trigger_cost)
        self.observation_space = observation_space(
            obs_mode, stream.camera.shape, costs=self._cost_range is not None
        )
        self.action_space = spaces.Discrete(2)
        self.render_mode = render_mode
        self._obs_mode = obs_mode
        self._error = error
        self._error_scale = error_scale
        self._min_depth = min_depth
        self._stream = stream
        if held_depth is None:
            made = make_extrapolator(extrapolator, odometry=odometry, runtime=runtime)
            held_depth = ComputedDepth(stream, made, min_depth)
        self._held_depth = held_depth
        self._window = Window(self.metadata["render_fps"])
        self._running = False
        self._started = False
        self._closed = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start a sequence and return the observation of slice 1, the info of t = 0.

        Args:
            seed: seeds ``np_random`` and is the sequence to run. Without it the next training
                sequence is drawn from ``np_random``.
            options: ``{"sequence": int}`` runs that sequence whatever the seed; ``{"trigger_cost": float}``
                sets this episode's cost.

        Raises:
            ValueError: unknown options, or a value out of range.
        """
        if self._closed:
            raise gym.error.ClosedEnvironmentError("reset: the environment is closed; make a new one")
        super().reset(seed=seed)
        options = checked_options(options or {})
        sequence = self._sequence(seed, options)
        self._trigger_cost = self._draw_cost(options)
        sample = self._stream.reset(sequence)
        self._held_depth.start()
        self._ledger = DepthLedger(self._stream.lidar_period)
        self._activity = ActivityMemory() if self._obs_mode == "statistics" else None
        self._timeline = Timeline()
        self._running = self._started = True
        _, info = self._settle(sample, triggered=False)
        self._receive()
        self._render_human()
        return self._observation(), info

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Hold (0) or trigger (1) at the slice last observed, score it, and observe the next one."""
        self._require_running("step")
        sample = self._pending
        triggered = self._ledger.act(sample.index, sample.has_lidar, check_action(action))
        if self._activity is not None:
            self._activity.act(triggered)
        reward, info = self._settle(sample, triggered)
        truncated = sample.index == self._stream.slices
        if truncated:
            self._running = False
        else:
            self._receive()
        self._render_human()
        return self._observation(), reward, False, truncated, info

    def render(self) -> NDArray[Any] | None:
        """Draw the slice scored last; what comes back depends on ``render_mode``.

        ``"rgb_array"``: a ``(H, W, 3)`` uint8 panel with intensity, event frame, true depth, held depth,
        error and the time line of triggers. ``"depth_array"``: the held depth, ``(H, W)`` float32.
        ``"human"``: the panel in a window, returns None.
        """
        self._require_started("render")
        if self.render_mode is None:
            gym.logger.warn("render: the environment was made without a render_mode, e.g. 'rgb_array'")
            return None
        if self.render_mode == "depth_array":
            return self.depth.copy()
        panel = self._panel()
        if self.render_mode == "rgb_array":
            return panel
        self._window.show(panel)
        return None

    def close(self) -> None:
        """Release the stream and the window; may be called twice."""
        self._closed = True
        self._running = self._started = False
        self._stream.close()
        self._window.close()

    @property
    def sample(self) -> Sample:
        """The sample the last observation shows, on which the next action acts."""
        self._require_started("sample")
        return self._pending

    @property
    def depth(self) -> NDArray[np.float32]:
        """``(H, W)`` float32 m, the held depth frame; not a copy."""
        self._require_started("depth")
        return self._held_depth.depth

    @property
    def true_depth(self) -> NDArray[np.float32]:
        """``(H, W)`` float32 m, the true depth at the slice scored last; not a copy."""
        self._require_started("true_depth")
        return self._scored.depth

    @property
    def prior_depth(self) -> NDArray[np.float32]:
        """``(H, W)`` float32 m, the last LiDAR frame; not a copy."""
        self._require_started("prior_depth")
        return self._held_depth.prior

    @property
    def trigger_cost(self) -> float:
        """What a trigger costs in the running episode."""
        self._require_started("trigger_cost")
        return self._trigger_cost

    def set_trigger_cost(self, cost: float) -> None:
        """Let triggers cost ``cost`` from the next action on, in this episode and those to come.

        For constrained training, which adapts the cost while it learns.

        Raises:
            ValueError: not a number of at least 0, or the costs are drawn from a range.
        """
        if self._cost_range is not None:
            raise ValueError(
                f"set_trigger_cost: each episode draws its cost from {self._cost_range}, "
                "expected an environment made with a single trigger_cost"
            )
        number("cost", cost, *ANY_COST)
        self._fixed_cost = self._trigger_cost = float(cost)

    @property
    def stream(self) -> SensorStream:
        """Where the samples come from."""
        return self._stream

    def _sequence(self, seed: int | None, options: dict[str, Any]) -> int:
        if "sequence" in options:
            return int(options["sequence"])
        if seed is not None:
            return int(seed)
        train = SPLITS["train"]
        return int(self.np_random.integers(train.start, train.stop))

    def _draw_cost(self, options: dict[str, Any]) -> float:
        """The cost of the episode that starts: given, drawn from the range, or the only one."""
        return episode_cost(self._cost_range or self._fixed_cost, options, self.np_random)

    def _receive(self) -> None:
        """Take in the slice that the next action acts on."""
        self._pending = self._stream.advance()
        if self._activity is not None:
            self._activity.see(self._statistics(self._pending), self._pending.has_lidar)

    def _statistics(self, sample: Sample) -> NDArray[np.float32]:
        """``(SLICE_STATISTICS,)`` float32 of the slice's image observation."""
        return slice_statistics(image_observation(sample.event_frame)[0])

    def _settle(self, sample: Sample, triggered: bool) -> tuple[float, dict[str, Any]]:
        """Produce or hold the depth of ``sample``'s slice, score it, and return reward and info."""
        scores = self._held_depth.settle(sample, triggered, self._ledger.age)
        self._scored = sample
        error = scores[self._error] if LOWER_IS_BETTER[self._error] else 1.0 - scores[self._error]
        parts = rewards.components(error, self._error_scale, triggered, self._trigger_cost)
        info = self._info(sample, triggered, scores, parts)
        if self.render_mode in ("human", "rgb_array"):
            self._intensity = self._stream.intensity()
            self._timeline.add(info["lidar"], triggered, info["keyframe"], error)
        return rewards.total(parts), info

    def _info(
        self, sample: Sample, triggered: bool, scores: Mapping[str, float], parts: dict[str, float]
    ) -> dict[str, Any]:
        label = label_keyframe(sample.state)
        return {
            "t": sample.t,
            "lidar": sample.has_lidar,
            "triggered": triggered,
            "depth_age": self._ledger.age * SLICE_US,
            **{name: scores[name] for name in INFO_METRICS},
            "held_depth_source": self._ledger.held_source,
            "ego_speed": float(sample.state.speed),
            "shortest_distance": float(sample.state.shortest_distance),
            "new_actors": int(sample.state.new_actors),
            "keyframe": label.label,
            "keyframe_speed": label.speed,
            "keyframe_distance": label.distance,
            "keyframe_new": label.new,
            "event_count": int(sample.event_count),
            "active_fraction": sample.active_fraction,
            "effective_rate": self._ledger.effective_rate,
            **{f"reward/{name}": value for name, value in parts.items()},
        }

    def _observation(self) -> Any:
        sample = self._pending
        since_lidar, since_depth = self._ledger.staleness(sample.index, sample.has_lidar)
        state = state_vector(
            since_lidar, since_depth, sample.event_count, sample.event_frame.size, self._ledger.last_action
        )
        return make_observation(
            self._obs_mode,
            sample.event_frame,
            state,
            activity=None if self._activity is None else self._activity.observed(),
            cost=None if self._cost_range is None else self._trigger_cost,
        )

    def _panel(self) -> NDArray[np.uint8]:
        return draw_panel(
            PanelView(
                t_us=self._scored.t,
                intensity=self._intensity,
                event_frame=self._scored.event_frame,
                true_depth=self.true_depth,
                held_depth=self.depth,
                max_depth=self._stream.max_depth,
                min_depth=self._min_depth,
                held_source=self._ledger.held_source,
                held_age_us=self._ledger.age * SLICE_US,
                effective_rate=self._ledger.effective_rate,
                ego_speed=self._scored.state.speed,
                error_name=self._error,
                slices=self._stream.slices,
                timeline=self._timeline,
            )
        )

    def _render_human(self) -> None:
        if self.render_mode == "human":
            self._window.show(self._panel())

    def _require_started(self, what: str) -> None:
        if self._closed:
            raise gym.error.ClosedEnvironmentError(f"{what}: the environment is closed; make a new one")
        if not self._started:
            raise gym.error.ResetNeeded(f"{what}: no sequence was started; call reset() first")

    def _require_running(self, what: str) -> None:
        self._require_started(what)
        if not self._running:
            raise gym.error.ResetNeeded(
                f"{what}: the sequence ended at slice {self._stream.slices}; call reset() for the next"
            )


def checked_options(options: dict[str, Any]) -> dict[str, Any]:
    """The options of a reset; unknown ones and a bad sequence raise ``ValueError``."""
    for key in options:
        choice("options key", key, ("sequence", "trigger_cost"))
    sequence = options.get("sequence", 0)
    if not isinstance(sequence, (int, np.integer)) or sequence < 0:
        raise ValueError(f"options['sequence']: found {sequence!r}, expected an integer >= 0")
    return options
