"""Short rollouts of registered environments and their digests, to compare bytes across processes."""

from __future__ import annotations

import hashlib

import gymnasium as gym

import nl_env

IDS = sorted(set(nl_env.ENTRY_POINTS) - {"nl_env/Replay-v0"})  # it needs data; test_replay.py holds it
SHORT = {"nl_env/Driving-v0": {"duration": 0.4, "scenario": "highway"}}
"""Arguments that make each environment quick to build and to finish: 20 slices."""


def make(env_id, **arguments):
    return gym.make(env_id, **{**SHORT[env_id], **arguments})


def rollout(env, seed, steps=6):
    """``(observation, reward, info)`` of reset and ``steps`` steps, triggering at every second one."""
    observation, info = env.reset(seed=seed)
    records = [(observation, 0.0, info)]
    for k in range(steps):
        observation, reward, _, _, info = env.step(k % 2)
        records.append((observation, reward, info))
    return records


def digest(records):
    """SHA-256 over every byte of observations, rewards and infos."""
    sha = hashlib.sha256()
    for observation, reward, info in records:
        arrays = observation.values() if isinstance(observation, dict) else [observation]
        for array in arrays:
            sha.update(array.tobytes())
        sha.update(repr((reward, sorted(info.items()))).encode())
    return sha.hexdigest()
