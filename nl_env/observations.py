"""What the agent sees: pure functions from an event frame and a few numbers to each observation mode.

``"image"``
    ``(1, H, W)`` uint8, the event frame (Eq. 1) offset by 128 and clipped: 128 = no change.
``"signed"``
    ``(1, H, W)`` int8, the event frame clipped to [-128, 127].
``"dict"``
    ``{"event_frame": image, "state": (4,) float32}`` with the fields of :data:`STATE_FIELDS`; where the
    trigger cost is drawn for each episode also ``"trigger_cost"``, ``(1,)`` float32.
``"statistics"``
    ``(n,)`` float32: the state, then the event activity of each region of the image
    (:mod:`nl_env.statistics`), then the trigger cost where it is drawn for each episode.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numba import njit
from numpy.typing import NDArray

from nl_env.config import choice
from nl_env.costs import COST_RANGE
from nl_env.statistics import ACTIVITY_FIELDS, IMAGE_ZERO

OBS_MODES = ("image", "signed", "dict", "statistics")
COST_MODES = ("dict", "statistics")
"""The modes that can show the trigger cost."""
IMAGE_OFFSET = IMAGE_ZERO
STATE_FIELDS = ("since_lidar", "since_depth", "event_rate", "last_action")
"""Time since the last LiDAR frame and since the last depth frame, as shares of the LiDAR period (0 where a
LiDAR frame arrives at this very slice); the event rate ``x / (1 + x)`` with x events per pixel and slice;
the last action. All in [0, 1]."""


def observation_space(mode: str, shape: tuple[int, int], costs: bool = False) -> spaces.Space[Any]:
    """Gymnasium space of ``mode`` for sensors of ``shape`` ``(H, W)``.

    Args:
        mode: one of :data:`OBS_MODES`.
        shape: of the event frames.
        costs: the observation shows the trigger cost.

    Raises:
        ValueError: unknown mode, or ``costs`` in a mode that has no place for it.
    """
    choice("obs_mode", mode, OBS_MODES)
    if costs and mode not in COST_MODES:
        raise ValueError(
            f"trigger_cost: found a range of costs with obs_mode {mode!r}, "
            f"expected one of {', '.join(map(repr, COST_MODES))}, which show the cost, or a single number"
        )
    if mode == "statistics":
        return _unit_box(len(STATE_FIELDS) + ACTIVITY_FIELDS + costs)
    image = spaces.Box(0, 255, (1, *shape), np.uint8)
    if mode == "image":
        return image
    if mode == "signed":
        return spaces.Box(-128, 127, (1, *shape), np.int8)
    shown: dict[str, spaces.Space[Any]] = {"event_frame": image, "state": _unit_box(len(STATE_FIELDS))}
    return spaces.Dict(shown | ({"trigger_cost": _unit_box(1)} if costs else {}))


def _unit_box(size: int) -> spaces.Box:
    return spaces.Box(0.0, 1.0, (size,), np.float32)


def cost_coordinate(cost: Any) -> NDArray[np.float32]:
    """Trigger costs, a number or an array, as observations show them: 0 at 1e-4 to 1 at 1e2, logarithmic."""
    low, high = np.log10(COST_RANGE)
    return np.clip((np.log10(cost) - low) / (high - low), 0.0, 1.0).astype(np.float32)


def image_observation(event_frame: NDArray[np.int16]) -> NDArray[np.uint8]:
    """``(H, W)`` int16 event frame to a fresh ``(1, H, W)`` uint8 image."""
    image = np.empty((1, *event_frame.shape), np.uint8)
    _clip_and_offset(np.ascontiguousarray(event_frame).reshape(-1), image.reshape(-1))
    return image


def signed_from_image(images: NDArray[np.uint8]) -> NDArray[np.int8]:
    """Observations of mode ``"image"`` as those of mode ``"signed"``, of any shape; fresh."""
    return (images ^ np.uint8(IMAGE_OFFSET)).view(np.int8)


def signed_observation(event_frame: NDArray[np.int16]) -> NDArray[np.int8]:
    """``(H, W)`` int16 event frame to a fresh ``(1, H, W)`` int8 frame."""
    return signed_from_image(image_observation(event_frame))


@njit(cache=True, error_model="numpy")
def _clip_and_offset(sums, image):  # type: ignore[no-untyped-def]
    """Signed event sums as bytes, 128 = no change; one pass, where NumPy would need three."""
    for k in range(sums.size):
        image[k] = np.uint8(min(max(sums[k], np.int16(-128)), np.int16(127)) + np.int16(IMAGE_OFFSET))


def state_vector(
    since_lidar: Any, since_depth: Any, event_count: Any, pixels: int, last_action: Any
) -> NDArray[np.float32]:
    """``(4,)`` float32 in [0, 1]; see :data:`STATE_FIELDS`. Times are shares of the LiDAR period.

    Everything but ``pixels`` may be an array ``(n,)``: the result is then ``(n, 4)``.
    """
    fields = [since_lidar, since_depth, event_count / (event_count + pixels), last_action]
    return np.array(np.array(fields, dtype=np.float32).T, order="C")


def statistics_observation(
    state: NDArray[np.float32], activity: NDArray[np.float32], cost: Any = None
) -> NDArray[np.float32]:
    """The observation of mode ``"statistics"``, single or a batch.

    Args:
        state: ``(..., 4)`` of :func:`state_vector`.
        activity: ``(..., ACTIVITY_FIELDS)`` of :meth:`nl_env.statistics.ActivityMemory.observed`.
        cost: trigger cost, ``(...)``, or None where it is not shown.
    """
    parts = [state, activity]
    if cost is not None:
        parts.append(cost_coordinate(cost)[..., None])
    return np.concatenate(parts, axis=-1)


def make_observation(
    mode: str,
    event_frame: NDArray[np.int16],
    state: NDArray[np.float32],
    activity: NDArray[np.float32] | None = None,
    cost: float | None = None,
) -> Any:
    """One observation of ``mode``; every array is fresh.

    Args:
        mode: one of :data:`OBS_MODES`.
        event_frame: ``(H, W)``.
        state: of :func:`state_vector`.
        activity: of :class:`nl_env.statistics.ActivityMemory`; mode ``"statistics"`` needs it.
        cost: trigger cost to show, or None.
    """
    if mode == "image":
        return image_observation(event_frame)
    if mode == "signed":
        return signed_observation(event_frame)
    if mode == "statistics":
        assert activity is not None
        return statistics_observation(state, activity, cost)
    shown = {"event_frame": image_observation(event_frame), "state": state}
    return shown if cost is None else shown | {"trigger_cost": cost_coordinate(cost)[None]}


def event_frames(observation: Any) -> NDArray[np.int16]:
    """The event frames inside an observation or a batch of observations of any mode.

    Args:
        observation: ``(C, H, W)`` or ``(n, C, H, W)`` uint8 or int8, or a dict holding it as
            ``"event_frame"``. With several channels (frame stacking) the last, newest one counts.

    Returns:
        ``(H, W)`` or ``(n, H, W)`` int16 signed sums, as far as clipping kept them.

    Raises:
        ValueError: another dtype or number of dimensions.
    """
    frame = np.asarray(observation["event_frame"] if isinstance(observation, dict) else observation)
    if frame.ndim not in (3, 4) or frame.dtype not in (np.uint8, np.int8):
        raise ValueError(
            f"observation: found shape {frame.shape} dtype {frame.dtype}, "
            "expected (C, H, W) or (n, C, H, W) of uint8 or int8"
        )
    offset = IMAGE_OFFSET if frame.dtype == np.uint8 else 0
    return frame[..., -1, :, :].astype(np.int16) - np.int16(offset)
