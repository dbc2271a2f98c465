"""Policies trained by reinforcement, from safetensors and a card; ``scripts/train_rl.py`` makes them."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import nl_env
from agents.activity import StatisticsPolicy
from agents.base import Actions, Memory, Policy
from agents.pictures import PictureMemory, memory_size, picture, picture_shape
from nl_env.config import number
from nl_env.observations import IMAGE_OFFSET, STATE_FIELDS
from nl_env.weight_files import Card, load_network

WEIGHTS = Path(nl_env.__file__).parent / "weights" / "rl.safetensors"
DEFAULT_COST = 0.1


def load_trigger(
    path: str | Path = WEIGHTS, trigger_cost: float | None = None, rate_hz: float | None = None
) -> Policy:
    """The policy with the weights at ``path``, which sees what it was trained on.

    Args:
        path: weights with their card beside them; the shipped ones by default.
        trigger_cost: what to tell a policy that was trained for a range of costs.
        rate_hz: choose that cost so that the mean effective frame rate on the card's validation sequences
            is this one. Without either argument the cost is 0.1, or the nearest that was trained.

    Raises:
        FileNotFoundError: no such file, or no card.
        ValueError: the file or its card does not fit (the message names it), both arguments, either one for a
            policy of a single cost, or a cost or rate that the training did not reach.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"weights: found no file {str(path)!r}; scripts/train_rl.py makes one")
    network, card = _loaded(path.resolve(), path.stat().st_mtime_ns)
    if trigger_cost is not None and rate_hz is not None:
        raise ValueError(f"found trigger_cost={trigger_cost!r} and rate_hz={rate_hz!r}, expected at most one")
    if not network.conditioned and (trigger_cost is not None or rate_hz is not None):
        raise ValueError(
            f"{path}: found a policy trained for one trigger cost, expected neither trigger_cost nor rate_hz"
        )
    if rate_hz is not None:
        trigger_cost = cost_for_rate(card, rate_hz, path)
    if network.conditioned:
        low, high = network.cost_range
        if trigger_cost is None:
            trigger_cost = min(max(DEFAULT_COST, low), high)
        number("trigger_cost", trigger_cost, low, high)
    kind = StatisticsTrigger if network.obs_mode == "statistics" else PictureTrigger
    return kind(network, trigger_cost)


def cost_for_rate(card: Card, rate_hz: float, path: Path) -> float:
    """The trigger cost at which the card's validation found ``rate_hz``, between its points in the logarithm.

    Raises:
        ValueError: a rate that was not reached, or a card without a curve; ``path`` is named.
    """
    try:
        curve = card.metrics["validation"]["curve"]
        costs, rates = np.array(curve["trigger_cost"], float), np.array(curve["rate_hz"], float)
    except (KeyError, TypeError, ValueError) as cause:
        raise ValueError(f"card: found no validation curve beside {str(path)!r}, expected one") from cause
    rates = np.minimum.accumulate(rates)  # sorted by cost; a dearer trigger is never wanted more often
    if not rates[-1] <= rate_hz <= rates[0]:
        raise ValueError(
            f"rate_hz: found {rate_hz!r}, expected {rates[-1]:.4g} to {rates[0]:.4g}, "
            f"which {str(path)!r} reaches"
        )
    return float(np.exp(np.interp(-rate_hz, -rates, np.log(costs))))


class StatisticsTrigger(StatisticsPolicy):
    """A network on event statistics; it runs without PyTorch once it is loaded.

    Args:
        network: an ``agents.rl_networks.TriggerNetwork`` of that mode, whose numbers are copied.
        trigger_cost: to show a network that is told it; None for others.
    """

    def __init__(self, network: Any, trigger_cost: float | None) -> None:
        self.trigger_cost = trigger_cost
        self._mean, self._scale = (
            getattr(network.encoder, name).numpy().copy() for name in ("mean", "scale")
        )
        self._layers = [_arrays(layer) for layer in network.layers]
        self._last = _arrays(network.last)
        self._relu = network.activation == "relu"

    def decide(self, seen: NDArray[np.float32], memory: Memory) -> Actions:
        return (self.margin(seen) > 0).astype(np.int64)

    def margin(self, seen: NDArray[np.float32]) -> NDArray[np.float32]:
        """``(n,)`` outputs of the network for observations ``(n, fields)``."""
        x = (seen[:, : len(self._mean)] - self._mean) * self._scale
        for weight, bias in self._layers:
            x = x @ weight + bias
            x = np.maximum(x, 0) if self._relu else np.tanh(x)
        weight, bias = self._last
        return (x @ weight + bias)[:, 0]


class PictureTrigger(Policy):
    """A network on event frames, alone or with the state beside them.

    Args:
        network: an ``agents.rl_networks.TriggerNetwork`` of mode ``"image"`` or ``"dict"``.
        trigger_cost: to show a network that is told it; None for others.
    """

    def __init__(self, network: Any, trigger_cost: float | None) -> None:
        self.network = network
        self.obs_mode = network.obs_mode
        self.trigger_cost = trigger_cost
        self._keys = ["state"] if self.obs_mode == "dict" else []
        if trigger_cost is not None:
            self._keys.append("trigger_cost")

    def read(self, observation: Any) -> tuple[NDArray[Any], bool]:
        """Event frames and numbers side by side, ``(n, H * W + fields)``, and whether it was a batch.

        Raises:
            ValueError: another mode, or event frames of another size than the network was trained for.
        """
        wanted = {"event_frame", *self._keys}
        if self._keys:
            found = set(observation) if isinstance(observation, dict) else type(observation).__name__
            if found != wanted:
                raise ValueError(f"observation: found {found}, expected a dict of {sorted(wanted)}")
        frames, batched = super().read(observation)
        expected = self.network.encoder.image.shape
        if frames.shape[1:] != expected:
            raise ValueError(
                f"observation: found event frames of {frames.shape[1]}x{frames.shape[2]}, "
                f"expected {expected[0]}x{expected[1]}, the size the policy was trained for"
            )
        parts = [frames.reshape(len(frames), -1).astype(np.float32)]
        parts += [np.asarray(observation[key], np.float32).reshape(len(frames), -1) for key in self._keys]
        return np.concatenate(parts, axis=1), batched

    def initial_memory(self, count: int) -> Memory:
        """In mode ``"dict"`` the events since the held depth frame was made, by blocks of pixels."""
        size = memory_size(picture_shape(*self.network.encoder.image.shape)) if self._keys else 0
        return np.zeros((count, size), np.float32)

    def decide(self, seen: NDArray[np.float32], memory: Memory) -> Actions:
        import torch

        height, width = self.network.encoder.image.shape
        pixels = height * width
        # ``read`` made them of integers.
        shown = picture((seen[:, :pixels] + IMAGE_OFFSET).astype(np.uint8).reshape(-1, height, width))
        vector = seen[:, pixels:]
        if self._keys:
            remembered = PictureMemory(memory, shown.shape[2:])
            shown = remembered.see(shown, vector[:, STATE_FIELDS.index("since_depth")])
        with torch.inference_mode():
            margins = self.network(
                self.network.encode(torch.from_numpy(shown)),
                torch.from_numpy(vector) if self._keys else None,
            )
        return (margins > 0).numpy().astype(np.int64)


@lru_cache(maxsize=16)
def _loaded(path: Path, changed_ns: int) -> tuple[Any, Card]:
    from agents.rl_networks import ARCHITECTURES

    return load_network(path, ARCHITECTURES)


def _arrays(layer: Any) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Weights ``(inputs, outputs)`` and biases of a linear layer."""
    return layer.weight.detach().numpy().T.copy(), layer.bias.detach().numpy().copy()
