"""What the agent sees: pure functions from an event frame and four numbers to each observation mode.

``"image"``
    ``(1, H, W)`` uint8, the event frame (Eq. 1) offset by 128 and clipped: 128 = no change.
``"signed"``
    ``(1, H, W)`` int8, the event frame clipped to [-128, 127].
``"dict"``
    ``{"event_frame": image, "state": (4,) float32}`` with the fields of :data:`STATE_FIELDS`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from nl_env.config import choice

OBS_MODES = ("image", "signed", "dict")
IMAGE_OFFSET = 128
STATE_FIELDS = ("since_lidar", "since_depth", "event_rate", "last_action")
"""Time since the last LiDAR frame and since the last depth frame, as shares of the LiDAR period (0 where a
LiDAR frame arrives at this very slice); the event rate ``x / (1 + x)`` with x events per pixel and slice;
the last action. All in [0, 1]."""


def observation_space(mode: str, shape: tuple[int, int]) -> spaces.Space[Any]:
    """Gymnasium space of ``mode`` for sensors of ``shape`` ``(H, W)``; unknown modes raise ``ValueError``."""
    choice("obs_mode", mode, OBS_MODES)
    image = spaces.Box(0, 255, (1, *shape), np.uint8)
    if mode == "image":
        return image
    if mode == "signed":
        return spaces.Box(-128, 127, (1, *shape), np.int8)
    return spaces.Dict(
        {"event_frame": image, "state": spaces.Box(0.0, 1.0, (len(STATE_FIELDS),), np.float32)}
    )


def image_observation(event_frame: NDArray[np.int16]) -> NDArray[np.uint8]:
    """``(H, W)`` int16 event frame to a fresh ``(1, H, W)`` uint8 image."""
    return (np.clip(event_frame, -128, 127) + np.int16(IMAGE_OFFSET)).astype(np.uint8)[None]


def signed_observation(event_frame: NDArray[np.int16]) -> NDArray[np.int8]:
    """``(H, W)`` int16 event frame to a fresh ``(1, H, W)`` int8 frame."""
    return np.clip(event_frame, -128, 127).astype(np.int8)[None]


def state_vector(
    since_lidar: float, since_depth: float, event_count: int, pixels: int, last_action: int
) -> NDArray[np.float32]:
    """``(4,)`` float32 in [0, 1]; see :data:`STATE_FIELDS`. Times are shares of the LiDAR period."""
    return np.array(
        [since_lidar, since_depth, event_count / (event_count + pixels), last_action], dtype=np.float32
    )


def make_observation(mode: str, event_frame: NDArray[np.int16], state: NDArray[np.float32]) -> Any:
    """One observation of ``mode``; every array is fresh."""
    if mode == "image":
        return image_observation(event_frame)
    if mode == "signed":
        return signed_observation(event_frame)
    return {"event_frame": image_observation(event_frame), "state": state}


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
