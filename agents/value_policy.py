"""The trigger policy that asks a trained value network; it runs without PyTorch once it is loaded."""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import nl_env
from agents.activity import SINCE_LIDAR, StatisticsPolicy
from agents.base import Actions, Memory
from nl_env.config import number
from nl_env.weight_files import load_network

WEIGHTS = Path(nl_env.__file__).parent / "weights"


class TriggerValue(StatisticsPolicy):
    """Trigger where the network says that it is worth more than its price.

    A network conditioned on the trigger cost is told ``parameter`` as ``trigger_cost``; the observation shows
    it. For another one ``parameter`` is the error (``log_mae`` summed over slices) that a trigger must save.

    Args:
        network: an ``agents.value_network.ValueNetwork``, whose numbers are copied.
        parameter: see above; None takes 0.1 as a cost, and a tenth of ``error_scale`` as an error.

    Raises:
        ValueError: a cost outside of what the network was trained for, or an error below 0.
    """

    memoryless = True

    def __init__(self, network: Any, parameter: float | None = None) -> None:
        default = 0.1 if network.conditioned else 0.1 * network.error_scale
        parameter = default if parameter is None else parameter
        self._threshold = 0.0
        if network.conditioned:
            number("trigger_cost", parameter, *network.cost_range)
            self.trigger_cost = float(parameter)
        else:
            number("threshold", parameter, 0.0, math.inf)
            self._threshold = parameter / network.unit
        self._mean = network.mean.numpy().copy()
        self._scale = network.scale.numpy().copy()
        self._layers = [_arrays(layer) for layer in network.layers]
        self._last = _arrays(network.last)

    @classmethod
    def load(cls, path: str | Path, parameter: float | None = None) -> TriggerValue:
        """The policy with the weights at ``path``, a safetensors file with its card beside it.

        Raises:
            FileNotFoundError: no such file, or no card.
            ValueError: the file or its card does not fit; the message names it. Or as the class.
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"weights: found no file {str(path)!r}; scripts/train_value.py makes one")
        return cls(_loaded(path.resolve(), path.stat().st_mtime_ns), parameter)

    def decide(self, seen: NDArray[np.float32], memory: Memory) -> Actions:
        return ((self.score(seen) > self._threshold) & (seen[:, SINCE_LIDAR] > 0)).astype(np.int64)

    def score(self, seen: NDArray[np.float32]) -> NDArray[np.float32]:
        """``(n,)`` output of the network for observations ``(n, fields)``."""
        x = (seen[:, : len(self._mean)] - self._mean) * self._scale
        for weight, bias in self._layers:
            x = np.maximum(x @ weight + bias, 0)
        weight, bias = self._last
        return (x @ weight + bias)[:, 0]


@lru_cache(maxsize=16)
def _loaded(path: Path, changed_ns: int) -> Any:
    from agents.value_network import ARCHITECTURES

    return load_network(path, ARCHITECTURES)[0]


def _arrays(layer: Any) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Weights ``(inputs, outputs)`` and biases of a linear layer."""
    return layer.weight.detach().numpy().T.copy(), layer.bias.detach().numpy().copy()
