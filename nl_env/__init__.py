"""Gymnasium benchmark for adaptive depth sensing with an event camera and a LiDAR.

Importing this package registers its environments; the classes behind them load with ``gymnasium.make``.
"""

from gymnasium.envs.registration import register, registry

__version__ = "0.1.0"

ENTRY_POINTS = {
    "nl_env/Driving-v0": "nl_env.driving:DrivingEnv",
    "nl_env/Replay-v0": "nl_env.replay:ReplayEnv",
}

VECTOR_ENTRY_POINTS = {"nl_env/Replay-v0": "nl_env.batched_replay:BatchedReplayEnv"}


def register_envs() -> None:
    """Register every environment id; calling it again changes nothing."""
    for env_id, entry_point in ENTRY_POINTS.items():
        if env_id not in registry:
            register(env_id, entry_point=entry_point, vector_entry_point=VECTOR_ENTRY_POINTS.get(env_id))


register_envs()
