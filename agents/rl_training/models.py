"""Stable-Baselines3 models for our observations, and the network of a trained one without the rest."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from sb3_contrib import QRDQN
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn

from agents.pictures import POOL
from agents.rl_networks import ACTIVATIONS, Encoder, TriggerNetwork
from agents.rl_training.hyperparameters import Hyperparameters, scheduled
from nl_env.config import choice

ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"ppo": PPO, "dqn": DQN, "qrdqn": QRDQN}


class TriggerFeatures(BaseFeaturesExtractor):
    """:class:`agents.rl_networks.Encoder` as Stable-Baselines3's features extractor."""

    def __init__(self, observation_space: spaces.Space[Any], obs_mode: str, conditioned: bool) -> None:
        height, width = image_size(observation_space)
        encoder = Encoder(obs_mode, conditioned, height, width)
        super().__init__(observation_space, encoder.size)
        self.encoder = encoder

    def forward(self, observations: Any) -> Tensor:
        """Features ``(n, size)`` of a batch of observations."""
        images, vector = split(observations)
        encoded = None if images is None or self.encoder.image is None else self.encoder.image(images)
        return self.encoder(encoded, vector)


def split(observations: Any) -> tuple[Any, Any]:
    """Pictures and numbers of a batch of observations, of which a mode may lack one; tensors or arrays."""
    if isinstance(observations, dict):
        parts = [observations[name] for name in ("state", "trigger_cost") if name in observations]
        vector = torch.cat(parts, -1) if isinstance(parts[0], Tensor) else np.concatenate(parts, axis=-1)
        return observations["event_frame"], vector
    return (observations, None) if observations.ndim == 4 else (None, observations)


def image_size(space: spaces.Space[Any]) -> tuple[int, int]:
    """``(H, W)`` of the event frames behind the pictures in ``space``; zeros where there are none."""
    if isinstance(space, spaces.Dict):
        space = space["event_frame"]
    assert isinstance(space, spaces.Box)
    height, width = space.shape[-2:] if len(space.shape) == 3 else (0, 0)
    return height * POOL, width * POOL


def make_model(
    algorithm: str, hyperparameters: Hyperparameters, env: VecEnv, seed: int, gamma: float | None = None
) -> BaseAlgorithm:
    """A fresh model.

    Args:
        algorithm: one of :data:`ALGORITHMS`.
        hyperparameters: of the training.
        env: what it trains on.
        seed: of its first weights.
        gamma: in place of the hyperparameters' discount.

    Raises:
        ValueError: unknown algorithm, or arguments that it does not take.
    """
    choice("algorithm", algorithm, tuple(ALGORITHMS))
    arguments = scheduled(hyperparameters.algorithm)
    if gamma is not None:
        arguments["gamma"] = gamma
    try:
        return ALGORITHMS[algorithm](
            policy=hyperparameters.policy,
            env=env,
            seed=seed,
            device="cpu",
            policy_kwargs={
                **hyperparameters.policy_kwargs,
                "normalize_images": False,  # the encoder takes image observations as they are
                "features_extractor_class": TriggerFeatures,
                "features_extractor_kwargs": {
                    "obs_mode": hyperparameters.obs_mode,
                    "conditioned": isinstance(hyperparameters.trigger_cost, tuple),
                },
            },
            **arguments,
        )
    except TypeError as cause:
        raise ValueError(f"hyperparameters: {algorithm} does not take them ({cause})") from cause


def standardise(model: BaseAlgorithm, observations: Any) -> None:
    """Let the model's encoders standardise the numbers of observations like these, ``(n, ...)``."""
    _, vector = split(observations)
    if vector is None:
        return
    numbers = torch.as_tensor(vector)
    for module in model.policy.modules():
        if isinstance(module, Encoder):
            module.mean.copy_(numbers.mean(dim=0))
            module.scale.copy_(1 / numbers.std(dim=0).clamp_min(1e-2))


def decider(model: BaseAlgorithm, hyperparameters: Hyperparameters) -> TriggerNetwork:
    """The network that says what ``model`` does when it is deterministic; shares no memory with it."""
    policy: Any = model.policy
    if isinstance(model, PPO):
        extractor, hidden, last = (
            policy.pi_features_extractor,
            policy.mlp_extractor.policy_net,
            policy.action_net,
        )
        weight, bias = last.weight, last.bias
    else:
        net = policy.quantile_net if isinstance(model, QRDQN) else policy.q_net
        *layers, last = net.quantile_net if isinstance(model, QRDQN) else net.q_net
        extractor, hidden = net.features_extractor, layers
        # The mean over quantiles, which are rows as (quantile, action).
        weight, bias = last.weight.reshape(-1, 2, last.in_features).mean(0), last.bias.reshape(-1, 2).mean(0)
    linear = [layer for layer in hidden if isinstance(layer, nn.Linear)]
    network = TriggerNetwork(
        **network_options(model, hyperparameters, [layer.out_features for layer in linear])
    )
    with torch.no_grad():
        network.encoder.load_state_dict(extractor.encoder.state_dict())
        for mine, theirs in zip(network.layers, linear, strict=True):
            mine.load_state_dict(theirs.state_dict())
        network.last.weight.copy_(weight[1:] - weight[:1])
        network.last.bias.copy_(bias[1:] - bias[:1])
    return network.eval()


def network_options(
    model: BaseAlgorithm, hyperparameters: Hyperparameters, hidden: list[int]
) -> dict[str, Any]:
    """Arguments of :class:`agents.rl_networks.TriggerNetwork` for a model's network; JSON-ready."""
    cost = hyperparameters.trigger_cost
    height, width = image_size(model.observation_space)
    policy: Any = model.policy
    (name,) = (name for name, kind in ACTIVATIONS.items() if kind is policy.activation_fn)
    return {
        "obs_mode": hyperparameters.obs_mode,
        "conditioned": isinstance(cost, tuple),
        "hidden": hidden,
        "activation": name,
        "height": height,
        "width": width,
        "cost_range": list(cost) if isinstance(cost, tuple) else [],
    }
