"""The vector environment of stored traces against ``SyncVectorEnv`` of the single one."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from stored_traces import SEEDS, SLICES

import nl_env  # noqa: F401 - registers the environments
from nl_env.batched_replay import BatchedReplayEnv
from nl_env.depth.metrics import METRIC_NAMES
from nl_env.replay import ReplayEnv

ENVS = 3
COSTS = (0.01, 1.0)


def batched(data, n=ENVS, **arguments):
    return BatchedReplayEnv(n, data=data, extrapolator="warp", **arguments)


def one_by_one(data, n=ENVS, autoreset_mode="NextStep", **arguments):
    def make():
        return ReplayEnv(data=data, extrapolator="warp", errors="table", **arguments)

    return SyncVectorEnv([make] * n, autoreset_mode=autoreset_mode)


def pair(data, **arguments):
    return one_by_one(data, **arguments), batched(data, **arguments)


def assert_same(found, expected, where=""):
    """Equal in structure, types and every value."""
    if isinstance(expected, (dict, tuple)):
        assert type(found) is type(expected)
        if isinstance(expected, dict):
            assert found.keys() == expected.keys(), where
        for key in expected if isinstance(expected, dict) else range(len(expected)):
            assert_same(found[key], expected[key], f"{where}/{key}")
    elif isinstance(expected, np.ndarray):
        assert (found.dtype, found.shape) == (expected.dtype, expected.shape), where
        if expected.dtype == object:
            for left, right in zip(found, expected, strict=True):
                assert_same(left, right, where)
        else:
            np.testing.assert_array_equal(found, expected, err_msg=where)
    else:
        assert found == expected, where


@pytest.mark.parametrize("autoreset_mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize(
    ("obs_mode", "trigger_cost"),
    [
        ("image", 0.1),
        ("signed", 0.1),
        ("dict", 0.1),
        ("dict", COSTS),
        ("statistics", 0.1),
        ("statistics", COSTS),
    ],
)
def test_every_step_equals_the_single_environments(stored, obs_mode, trigger_cost, autoreset_mode):
    single, vector = pair(stored, obs_mode=obs_mode, trigger_cost=trigger_cost, autoreset_mode=autoreset_mode)
    assert vector.observation_space == single.observation_space
    assert vector.single_observation_space == single.single_observation_space
    assert vector.action_space == single.action_space
    assert vector.metadata["autoreset_mode"] is single.metadata["autoreset_mode"]
    rng = np.random.default_rng(1)
    seeds = [SEEDS[1], 3, 4]
    assert_same(vector.reset(seed=seeds), single.reset(seed=seeds), "reset")
    for k in range(2 * SLICES + 5):  # two ends, at both of which the next sequence is drawn
        actions = rng.integers(2, size=ENVS)
        found, expected = vector.step(actions), single.step(actions)
        assert_same(found, expected, f"step {k}")
        assert vector.observation_space.contains(found[0])
    assert_same(vector.reset(seed=11), single.reset(seed=11), "second reset")
    assert_same(vector.reset(), single.reset(), "third reset")


@pytest.mark.parametrize("error", METRIC_NAMES)
def test_every_metric_can_be_the_reward(stored, error):
    single, vector = pair(stored, error=error, error_scale=0.5)
    single.reset(seed=0)
    vector.reset(seed=0)
    for k in range(6):
        actions = (np.arange(ENVS) + k) % 2
        assert_same(vector.step(actions), single.step(actions))


@pytest.mark.parametrize("autoreset_mode", ["NextStep", "Disabled"])
def test_some_environments_can_be_reset(stored, autoreset_mode):
    """Also out of step with the others, so that ends come at different times."""
    single, vector = pair(stored, obs_mode="statistics", trigger_cost=COSTS, autoreset_mode=autoreset_mode)
    single.reset(seed=0)
    vector.reset(seed=0)
    ones = np.ones(ENVS, np.int64)
    for _ in range(4):
        single.step(ones)
        vector.step(ones)
    mask = np.array([False, True, False])
    for options in ({}, {"sequence": SEEDS[0], "trigger_cost": 0.5}):
        found = vector.reset(seed=[1, 2, 3], options={**options, "reset_mask": mask})
        assert_same(found, single.reset(seed=[1, 2, 3], options={**options, "reset_mask": mask}))
    assert vector.trigger_costs[1] == 0.5 and vector.sequences[1] == SEEDS[0]
    steps = SLICES + 8 if autoreset_mode == "NextStep" else SLICES - 4
    for k in range(steps):
        assert_same(vector.step(ones * (k % 2)), single.step(ones * (k % 2)), f"step {k}")
    if autoreset_mode == "Disabled":
        with pytest.raises(gym.error.ResetNeeded, match=r"environments \[0, 2\] ended"):
            vector.step(ones)
        mask = ~mask
        options = {"reset_mask": mask}
        assert_same(vector.reset(options=dict(options)), single.reset(options=dict(options)))
        assert_same(vector.step(ones), single.step(ones))


def test_gymnasium_makes_it(stored):
    env = gym.make_vec(
        "nl_env/Replay-v0",
        num_envs=4,
        vectorization_mode="vector_entry_point",
        data=stored,
        extrapolator="warp",
        autoreset_mode=AutoresetMode.SAME_STEP,
    )
    assert isinstance(env.unwrapped, BatchedReplayEnv)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    env.close()
    with pytest.raises(gym.error.ClosedEnvironmentError):
        env.step(np.zeros(4, np.int64))


def test_observations_and_infos_are_fresh(stored):
    env = batched(stored, obs_mode="dict")
    first, info = env.reset(seed=0)
    kept = first["event_frame"].copy(), first["state"].copy(), {name: v.copy() for name, v in info.items()}
    for values in env.step(np.ones(ENVS, np.int64))[4].values():
        values[:] = values[::-1]
    env.step(np.ones(ENVS, np.int64))
    assert_same((first["event_frame"], first["state"], info), kept)


def test_it_pickles_in_the_middle_of_episodes(stored):
    env = batched(stored, obs_mode="statistics", trigger_cost=COSTS, autoreset_mode="SameStep")
    env.reset(seed=0)
    ones = np.ones(ENVS, np.int64)
    env.step(ones)
    copy = pickle.loads(pickle.dumps(env))
    for _ in range(SLICES + 3):
        assert_same(copy.step(ones), env.step(ones))
    images = batched(stored)
    images.reset(seed=0)
    assert_same(pickle.loads(pickle.dumps(images)).step(ones), images.step(ones))


def test_the_cost_can_be_set_while_it_runs(stored):
    env = batched(stored)
    env.reset(seed=0)
    env.set_trigger_cost(0.7)
    _, rewards, _, _, info = env.step(np.array([1, 0, 1]))
    np.testing.assert_array_equal(info["reward/trigger"], [-0.7, 0.0, -0.7])
    np.testing.assert_allclose(rewards, info["reward/error"] + info["reward/trigger"])
    env.reset(seed=1)
    np.testing.assert_array_equal(env.trigger_costs, 0.7)
    with pytest.raises(ValueError, match="cost: found -1"):
        env.set_trigger_cost(-1)
    with pytest.raises(ValueError, match="each episode draws its cost"):
        batched(stored, obs_mode="dict", trigger_cost=COSTS).set_trigger_cost(0.5)


def test_what_does_not_fit_is_refused(stored, tmp_path):
    env = batched(stored)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(ENVS, np.int64))
    mask = np.array([True, False, False])
    with pytest.raises(gym.error.ResetNeeded, match="first reset needs every environment"):
        env.reset(options={"reset_mask": mask})
    env.reset(seed=0)
    for actions in (np.zeros(2, np.int64), np.zeros(ENVS), [0, 1, 2], [0, -1, 0], [True, False, True], None):
        with pytest.raises(ValueError, match="actions: found"):
            env.step(actions)
    for arguments, kind, message in (
        ({"seed": [1, 2]}, ValueError, "seed: found 2 seeds, expected num_envs=3"),
        ({"options": {"sequenz": 1}}, ValueError, "options key: found 'sequenz'"),
        ({"options": {"trigger_cost": -1.0}}, ValueError, "trigger_cost"),
        ({"options": {"reset_mask": [True, False, True]}}, TypeError, "expected an array of bool"),
        ({"options": {"reset_mask": np.zeros(ENVS, bool)}}, ValueError, "and a True in it"),
        ({"options": {"sequence": 5}}, ValueError, "seed: found 5, expected one of the 2 recorded"),
    ):
        with pytest.raises(kind, match=message):
            env.reset(**arguments)
    for arguments, kind, message in (
        ({"errors": "compute"}, ValueError, "errors: found 'compute', .* vectorization_mode='sync'"),
        ({"render_mode": "rgb_array"}, ValueError, "render_mode: found 'rgb_array'"),
        ({"n": 0}, ValueError, "num_envs: found 0"),
        ({"obs_mode": "image", "trigger_cost": COSTS}, ValueError, "found a range of costs"),
        ({"error": "mae"}, ValueError, "error: found 'mae'"),
        ({"autoreset_mode": "Sometimes"}, ValueError, "Sometimes"),
        ({"split": "val"}, ValueError, "found no recording of split 'val'"),
    ):
        with pytest.raises(kind, match=message):
            batched(stored, **arguments)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        batched(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="found no recordings"):
        batched(tmp_path)
    with pytest.raises(RuntimeError, match="render: stored traces"):
        env.render()
