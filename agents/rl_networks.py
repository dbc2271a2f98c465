"""The networks of trained trigger policies: what of an actor or a Q-network decides, and nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from agents.pictures import POOL, picture_shape
from nl_env.config import choice
from nl_env.observations import STATE_FIELDS
from nl_env.statistics import ACTIVITY_FIELDS, TYPICAL

MODES = ("statistics", "dict", "image")
"""Observation modes that a network can be made for."""
ACTIVATIONS: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh}
TYPICAL_BLOCK = float(TYPICAL) * POOL**2
"""The number in a picture that the encoder maps to 1/2."""


def vector_fields(obs_mode: str, conditioned: bool) -> int:
    """Numbers in an observation beside the image."""
    if obs_mode == "image":
        return 0
    return len(STATE_FIELDS) + (ACTIVITY_FIELDS if obs_mode == "statistics" else 0) + conditioned


class ImageEncoder(nn.Module):
    """Pictures of event frames (:mod:`agents.pictures`) to a few numbers, through three strided convolutions.

    Args:
        height, width: of the event frames.
        channels: of the pictures.
        size: numbers that come out.
    """

    def __init__(self, height: int, width: int, channels: int, size: int = 32) -> None:
        super().__init__()
        self.shape = (height, width)
        self.layers = nn.Sequential(
            nn.Conv2d(channels, 8, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(8, 16, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(16, 16, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Flatten(),
        )
        with torch.no_grad():
            flat = self.layers(torch.zeros(1, channels, *picture_shape(height, width))).shape[1]
        self.last = nn.Linear(flat, size)

    def forward(self, pictures: Tensor) -> Tensor:
        """``(n, channels, H / POOL, W / POOL)`` of any dtype to ``(n, size)``."""
        sums = pictures.float()
        return torch.relu(self.last(self.layers(sums / (sums.abs() + TYPICAL_BLOCK))))


class Encoder(nn.Module):
    """What every part of an agent looks at: the encoded image, if any, and the standardised numbers.

    Args:
        obs_mode: one of :data:`MODES`.
        conditioned: the observation shows the trigger cost.
        height, width: of the event frames; unused in mode ``"statistics"``.
    """

    def __init__(self, obs_mode: str, conditioned: bool, height: int = 0, width: int = 0) -> None:
        super().__init__()
        choice("obs_mode", obs_mode, MODES)
        fields = vector_fields(obs_mode, conditioned)
        channels = {"dict": 3, "image": 2}
        self.image = ImageEncoder(height, width, channels[obs_mode]) if obs_mode in channels else None
        self.mean: Tensor
        self.scale: Tensor
        self.register_buffer("mean", torch.zeros(fields))
        self.register_buffer("scale", torch.ones(fields))
        self.size = fields + (0 if self.image is None else self.image.last.out_features)

    def forward(self, encoded: Tensor | None, vector: Tensor | None) -> Tensor:
        """``(n, size)`` of encoded images and of vectors ``(n, fields)``, of which a mode may lack one."""
        parts = [] if encoded is None else [encoded]
        if vector is not None:
            parts.append((vector - self.mean) * self.scale)
        return torch.cat(parts, dim=-1) if len(parts) > 1 else parts[0]


class TriggerNetwork(nn.Module):
    """Observations to one number: trigger where it is above 0.

    Args:
        obs_mode: one of :data:`MODES`.
        conditioned: the observation shows the trigger cost.
        hidden: widths of the hidden layers.
        activation: one of :data:`ACTIVATIONS`.
        height, width: of the event frames; unused in mode ``"statistics"``.
        cost_range: lowest and highest trigger cost of the training, where it is conditioned.

    Attributes:
        options: these arguments, JSON-ready.
    """

    def __init__(
        self,
        obs_mode: str,
        conditioned: bool,
        hidden: Sequence[int],
        activation: str = "tanh",
        height: int = 0,
        width: int = 0,
        cost_range: Sequence[float] = (),
    ) -> None:
        super().__init__()
        choice("activation", activation, tuple(ACTIVATIONS))
        if not hidden or min(hidden) < 1:
            raise ValueError(f"hidden: found {hidden!r}, expected at least one width of at least 1")
        if conditioned and (obs_mode == "image" or len(cost_range) != 2):
            raise ValueError(
                f"network: found obs_mode {obs_mode!r} and cost_range {cost_range!r} for a network that is "
                "told the trigger cost, expected a mode that shows it and a pair"
            )
        self.options = {
            "obs_mode": obs_mode,
            "conditioned": conditioned,
            "hidden": list(hidden),
            "activation": activation,
            "height": height,
            "width": width,
            "cost_range": list(cost_range),
        }
        self.obs_mode = obs_mode
        self.conditioned = conditioned
        self.activation = activation
        self.cost_range = tuple(float(cost) for cost in cost_range)
        self.encoder = Encoder(obs_mode, conditioned, height, width)
        widths = [self.encoder.size, *hidden]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))
        self.last = nn.Linear(widths[-1], 1)
        self._activate = ACTIVATIONS[activation]()

    def encode(self, pictures: Tensor) -> Tensor:
        """Encoded pictures, with a memory in mode ``"dict"``; ``ValueError`` where the mode has none."""
        if self.encoder.image is None:
            raise ValueError(f"encode: obs_mode {self.obs_mode!r} shows no image")
        return self.encoder.image(pictures)

    def forward(self, encoded: Tensor | None, vector: Tensor | None) -> Tensor:
        """``(n,)`` margins of encoded images and vectors, as :class:`Encoder` takes them."""
        x = self.encoder(encoded, vector)
        for layer in self.layers:
            x = self._activate(layer(x))
        return self.last(x)[..., 0]


ARCHITECTURES = {"trigger-network": TriggerNetwork}
