"""Every registered environment keeps Gymnasium's and Stable-Baselines3's contracts."""

import os
import pickle
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from rollouts import IDS, SHORT, digest, make, rollout
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as sb3_check
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

from nl_env.observations import COST_MODES, OBS_MODES

SEED = 3
STEPS = 6
THREAD_VARIABLES = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
INT8_WARNINGS = ("has to be `np.uint8`", "bounds are not in [0, 255]")
"""What SB3 says about any int8 image, which is what ``obs_mode="signed"`` is."""


@pytest.fixture(autouse=True)
def no_display(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.delenv("DISPLAY", raising=False)


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("obs_mode", OBS_MODES)
def test_gymnasium_check_env_without_a_warning(env_id, obs_mode):
    env = make(env_id, obs_mode=obs_mode)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gymnasium_check(env.unwrapped, skip_render_check=obs_mode != "image")
    env.close()


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("obs_mode", OBS_MODES)
def test_sb3_check_env_without_a_warning(env_id, obs_mode):
    env = make(env_id, obs_mode=obs_mode)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sb3_check(env.unwrapped)
    env.close()
    messages = [str(warning.message) for warning in caught]
    expected = INT8_WARNINGS if obs_mode == "signed" else ()
    assert len(messages) == len(expected), messages
    assert all(part in message for part, message in zip(expected, messages, strict=True))


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("obs_mode", COST_MODES)
def test_checkers_accept_a_cost_for_each_episode(env_id, obs_mode):
    env = make(env_id, obs_mode=obs_mode, trigger_cost=(0.01, 1.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gymnasium_check(env.unwrapped, skip_render_check=True)
        sb3_check(env.unwrapped)
    costs = set()
    for seed in range(4):
        env.reset(seed=seed)
        costs.add(env.unwrapped.trigger_cost)
    assert len(costs) == 4 and all(0.01 <= cost <= 1.0 for cost in costs)
    env.close()


@pytest.mark.parametrize("env_id", IDS)
def test_seeds_differ_and_a_second_reset_repeats(env_id):
    env = make(env_id)
    first, again, other = (digest(rollout(env, seed, steps=2)) for seed in (SEED, SEED, SEED + 1))
    assert first == again != other


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("mode", ["sync", "async"])
def test_gymnasium_vector_environments_equal_single_ones(env_id, mode, monkeypatch):
    """Same bytes also in fresh processes with two threads each, where the id is resolved by its module."""
    for name in THREAD_VARIABLES:
        monkeypatch.setenv(name, "2")
    vector = gym.make_vec(
        f"nl_env:{env_id}",
        num_envs=2,
        vectorization_mode=mode,
        vector_kwargs={"context": "spawn"} if mode == "async" else {},
        **SHORT[env_id],
    )
    expected = [rollout(make(env_id), seed) for seed in (SEED, SEED + 1)]
    observations, infos = vector.reset(seed=[SEED, SEED + 1])
    rewards = np.zeros(2)
    for step in range(STEPS + 1):
        for place in range(2):
            observation, reward, info = expected[place][step]
            np.testing.assert_array_equal(observations[place], observation)
            assert rewards[place] == reward
            assert {name: infos[name][place] for name in info} == info
        observations, rewards, _, _, infos = vector.step(np.array([step % 2] * 2))
    vector.close()


@pytest.mark.parametrize("env_id", IDS)
def test_an_sb3_subprocess_equals_a_single_environment(env_id):
    vector = make_vec_env(
        f"nl_env:{env_id}",
        seed=SEED,
        env_kwargs=SHORT[env_id],
        vec_env_cls=SubprocVecEnv,
        vec_env_kwargs={"start_method": "spawn"},
    )
    (first, _, _), *expected = rollout(make(env_id), SEED)
    np.testing.assert_array_equal(vector.reset()[0], first)
    for step, (observation, reward, info) in enumerate(expected):
        observations, rewards, _, infos = vector.step(np.array([step % 2]))
        np.testing.assert_array_equal(observations[0], observation)
        assert rewards[0] == reward
        assert {name: infos[0][name] for name in info} == info
    vector.close()


@pytest.mark.parametrize("env_id", IDS)
def test_pickles_before_and_in_the_middle_of_a_sequence(env_id):
    env = make(env_id)
    expected = digest(rollout(env, SEED))
    assert digest(rollout(pickle.loads(pickle.dumps(make(env_id))), SEED)) == expected
    copy = pickle.loads(pickle.dumps(env))
    for action in (1, 0):
        left, right = env.step(action), copy.step(action)
        assert digest([(left[0], left[1], left[4])]) == digest([(right[0], right[1], right[4])])


@pytest.mark.parametrize("env_id", IDS)
def test_the_sequence_ends_truncated_after_its_duration(env_id):
    env = make(env_id, extrapolator="repeat")
    env.reset(seed=SEED)
    ends = [env.step(1)[2:4] for _ in range(20)]
    assert ends == [(False, False)] * 19 + [(False, True)]


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="counts handles through /proc")
@pytest.mark.parametrize("env_id", IDS)
def test_resets_leave_handles_and_threads_flat(env_id):
    env = make(env_id)
    counts = []
    for _ in range(4):
        rollout(env, SEED, steps=2)
        counts.append([len(os.listdir(f"/proc/self/{kind}")) for kind in ("fd", "task")])
    assert counts[1:] == counts[:1] * 3


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize(
    ("policy", "obs_mode"),
    [("CnnPolicy", "image"), ("MultiInputPolicy", "dict"), ("MlpPolicy", "statistics")],
)
def test_ppo_learns_on_it_as_it_is(env_id, policy, obs_mode):
    env = make(env_id, obs_mode=obs_mode, extrapolator="repeat")
    model = PPO(policy, env, n_steps=16, batch_size=16, n_epochs=1, device="cpu", seed=0)
    before = [parameter.detach().clone() for parameter in model.policy.parameters()]
    model.learn(16)
    assert any((old != new).any() for old, new in zip(before, model.policy.parameters(), strict=True))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scenario": "desert"}, "'roundabout'"),
        ({"style": "alpine"}, "'suburb'"),
        ({"weather": "Snow"}, "'ClearNoon'"),
        ({"resolution": "huge"}, "'quarter'"),
        ({"noise": "noisy"}, "'realistic'"),
        ({"lidar_hz": 7}, "25"),
        ({"obs_mode": "rgb"}, "'image'"),
        ({"extrapolator": "magic"}, "warp"),
        ({"error": "mse"}, "'log_mae'"),
        ({"duration": -1.0}, "duration_s"),
    ],
)
def test_driving_lists_the_valid_names(arguments, message):
    with pytest.raises(ValueError, match=message):
        gym.make("nl_env/Driving-v0", **arguments)


def test_driving_refuses_unknown_arguments_and_ids():
    with pytest.raises(TypeError, match="wheather"):
        gym.make("nl_env/Driving-v0", wheather="ClearNoon")
    with pytest.raises(gym.error.NameNotFound):
        gym.make("nl_env/Flying-v0")
