"""Stored traces as a vector environment of Stable-Baselines3."""

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from stored_traces import SLICES

from agents.pictures import picture
from agents.sb3_vec_env import ReplayVecEnv, mirrored
from nl_env.batched_replay import BatchedReplayEnv
from nl_env.observations import cost_coordinate
from nl_env.statistics import ActivityMemory, slice_statistics

ENVS = 4


def batched(data, autoreset_mode=AutoresetMode.SAME_STEP, **arguments):
    return BatchedReplayEnv(ENVS, data=data, extrapolator="warp", autoreset_mode=autoreset_mode, **arguments)


def make(data, end_at_lidar=False, cost_offset=None, mirror=False, relative=False, **arguments):
    env = batched(data, **arguments)
    return ReplayVecEnv(
        env, end_at_lidar=end_at_lidar, cost_offset=cost_offset, mirror=mirror, relative=relative
    )


def roll(env, steps=2 * SLICES, seed=3):
    """``(observations, rewards, dones, infos)`` of every step with drawn actions, resets first."""
    env.seed(seed)
    rng = np.random.default_rng(seed)
    records = [(env.reset(), np.zeros(ENVS), np.zeros(ENVS, bool), [{}] * ENVS)]
    records += [env.step(rng.integers(2, size=ENVS)) for _ in range(steps)]
    env.close()
    return records


@pytest.mark.parametrize("obs_mode", ["image", "dict", "statistics"])
def test_steps_are_those_of_the_batched_environment(stored, obs_mode):
    first, *steps = roll(make(stored, obs_mode=obs_mode))
    reference, rng = batched(stored, obs_mode=obs_mode), np.random.default_rng(3)
    np.testing.assert_equal(first[0], reference.reset(seed=[3 + i for i in range(ENVS)])[0])
    for k, (observations, rewards, dones, infos) in enumerate(steps, 1):
        expected, scored, _, truncated, found = reference.step(rng.integers(2, size=ENVS))
        np.testing.assert_equal(observations, expected)
        np.testing.assert_array_equal(rewards, scored.astype(np.float32))
        np.testing.assert_array_equal(dones, truncated)
        assert dones.tolist() == [k % SLICES == 0] * ENVS
        for i in np.flatnonzero(dones):
            np.testing.assert_equal(infos[i]["terminal_observation"], found["final_obs"][i])
            assert infos[i]["TimeLimit.truncated"]


def test_the_return_of_a_sequence_is_reported_at_its_end(stored):
    records = roll(make(stored, end_at_lidar=True))
    rewards = np.array([record[1] for record in records])
    for end in (SLICES, 2 * SLICES):
        for i, info in enumerate(records[end][3]):
            assert info["episode"]["l"] == SLICES
            assert info["episode"]["r"] == pytest.approx(
                rewards[end - SLICES + 1 : end + 1, i].sum(), rel=1e-5
            )
    assert not any("episode" in info for info in records[5][3])


def test_episodes_can_end_at_lidar_frames_for_good(stored):
    plain, cut = roll(make(stored, obs_mode="statistics")), roll(make(stored, True, obs_mode="statistics"))
    for k, (before, after) in enumerate(zip(plain, cut, strict=True)):
        np.testing.assert_array_equal(before[0], after[0])
        np.testing.assert_array_equal(before[1], after[1])
        assert after[2].all() == (k > 0 and k % 5 == 0) and after[2].any() == after[2].all()
        if after[2].all():
            assert not any(info["TimeLimit.truncated"] for info in after[3])
            if k % SLICES:
                np.testing.assert_array_equal(after[3][1]["terminal_observation"], after[0][1])


def test_rewards_can_be_divided_by_the_cost(stored):
    arguments = {"obs_mode": "statistics", "trigger_cost": (0.01, 1.0)}
    plain, scaled = make(stored, **arguments), make(stored, cost_offset=0.05, **arguments)
    rng = np.random.default_rng(0)
    for env in (plain, scaled):
        env.seed(1)
        env.reset()
    for _ in range(2 * SLICES):  # past an end, where the costs are drawn anew
        costs = plain.env.trigger_costs
        actions = rng.integers(2, size=ENVS)
        expected = plain.step(actions)[1] / (costs + 0.05)
        assert scaled.step(actions)[1] == pytest.approx(expected, rel=1e-5)


def test_rewards_can_count_from_those_of_frames_of_every_slice(stored):
    always = make(stored, relative=True, trigger_cost=0.5)
    always.seed(1)
    always.reset()
    for k in range(1, 2 * SLICES + 1):  # past an end
        expected = -0.5 if k % 5 else 0.0  # nothing but the trigger's cost
        assert always.step(np.ones(ENVS, int))[1] == pytest.approx(np.full(ENVS, expected), abs=1e-6)


def test_relative_rewards_differ_by_what_no_decision_changes(stored):
    differences = []
    for actions in (0, 1):
        plain, relative = make(stored), make(stored, relative=True)
        for env in (plain, relative):
            env.seed(1)
            env.reset()
        chosen = np.full(ENVS, actions)
        steps = [(plain.step(chosen)[1], relative.step(chosen)[1]) for _ in range(SLICES)]
        differences.append([before - after for before, after in steps])
    np.testing.assert_allclose(differences[0], differences[1], atol=1e-6)
    assert np.ptp(differences[0]) > 0.01


@pytest.mark.parametrize("obs_mode", ["dict", "statistics"])
def test_every_lidar_interval_draws_its_cost(stored, obs_mode):
    env = make(stored, True, 0.05, obs_mode=obs_mode, trigger_cost=(0.01, 1.0))
    env.seed(1)

    def shown(observations):
        return observations["trigger_cost"][:, 0] if obs_mode == "dict" else observations[:, -1]

    before = shown(env.reset())
    for k in range(1, 2 * SLICES + 1):
        costs = env.env.trigger_costs
        np.testing.assert_array_equal(before, cost_coordinate(costs))
        observations, rewards, _, infos = env.step(np.ones(ENVS, int))
        if k % 5:
            assert (rewards < -costs / (costs + 0.05) + 1e-6).all()  # the trigger, and some error
            np.testing.assert_array_equal(shown(observations), before)
        else:
            assert (shown(observations) != before).all()
            last = [info["terminal_observation"] for info in infos]
            told = [seen["trigger_cost"][0] if obs_mode == "dict" else seen[-1] for seen in last]
            np.testing.assert_array_equal(told, before)
        before = shown(observations)


def test_statistics_of_a_mirrored_image_are_the_mirrored_statistics(stored):
    (image, *_), *_ = roll(make(stored), steps=1)[1]
    state = np.arange(4, dtype=np.float32)

    def seen(frame):
        memory = ActivityMemory()
        memory.see(slice_statistics(frame), False)
        memory.act(False)
        memory.see(slice_statistics(frame[::-1]), True)
        return np.concatenate([state, memory.observed(), [np.float32(0.7)]]).astype(np.float32)

    frame = image[0]
    np.testing.assert_array_equal(mirrored(seen(frame)), seen(frame[:, ::-1]))
    assert (mirrored(seen(frame)) != seen(frame)).any()
    np.testing.assert_array_equal(mirrored(mirrored(seen(frame))), seen(frame))


@pytest.mark.parametrize("obs_mode", ["image", "dict", "statistics"])
def test_every_second_environment_is_mirrored(stored, obs_mode):
    for k, (plain, shown) in enumerate(
        zip(
            roll(make(stored, obs_mode=obs_mode)),
            roll(make(stored, mirror=True, obs_mode=obs_mode)),
            strict=True,
        )
    ):
        for i in range(ENVS):
            mine, theirs = (
                (record[0] if obs_mode != "dict" else record[0]["event_frame"])[i]
                for record in (shown, plain)
            )
            np.testing.assert_array_equal(mine, mirrored(theirs) if i % 2 else theirs)
            if k == SLICES:
                last, expected = (record[3][i]["terminal_observation"] for record in (shown, plain))
                if obs_mode == "dict":
                    last, expected = last["event_frame"], expected["event_frame"]
                np.testing.assert_array_equal(last, mirrored(expected) if i % 2 else expected)


@pytest.mark.parametrize("obs_mode", ["image", "dict"])
def test_pictures_are_those_of_the_frames_and_remember_since_the_held_depth(stored, obs_mode):
    env = batched(stored, obs_mode=obs_mode)
    pictures = ReplayVecEnv(env, mirror=True, pictures=True)
    plain, records = roll(make(stored, mirror=True, obs_mode=obs_mode)), roll(pictures)
    rng = np.random.default_rng(3)
    sums = np.zeros((ENVS, 30, 40), int)
    for k, (seen, shown) in enumerate(zip(plain, records, strict=True)):
        frames, found = seen[0], shown[0]
        if obs_mode == "dict":
            np.testing.assert_array_equal(found["state"], frames["state"])
            frames, found = frames["event_frame"], found["event_frame"]
        assert found.shape == (ENVS, 3 if obs_mode == "dict" else 2, 30, 40)
        np.testing.assert_array_equal(found[:, :2], picture(frames[:, 0]))
        space = pictures.observation_space
        assert (space["event_frame"] if obs_mode == "dict" else space).contains(found[0])
        index = k % SLICES + 1  # of the slice that is seen, which the next actions are for
        sums = (0 if index == 1 else sums) + found[:, 1].astype(int)
        sums[:] *= index % 5 != 0  # a LiDAR frame arrives
        if obs_mode == "dict":
            np.testing.assert_array_equal(found[:, 2], np.minimum(sums, 127))
        for i in np.flatnonzero(shown[2]):
            last, before = shown[3][i]["terminal_observation"], records[k - 1][0]
            np.testing.assert_equal(
                last["event_frame"] if obs_mode == "dict" else last,
                before["event_frame"][i] if obs_mode == "dict" else before[i],
            )
        sums[rng.integers(2, size=ENVS) == 1] = 0


def test_pictures_need_event_frames(stored):
    with pytest.raises(ValueError, match="expected obs_mode 'image' or 'dict'"):
        ReplayVecEnv(batched(stored, obs_mode="statistics"), pictures=True)


def test_the_cost_can_be_set_while_running(stored):
    env = make(stored, cost_offset=1.0, trigger_cost=0.1)
    env.seed(0)
    env.reset()
    held = env.step(np.zeros(ENVS, int))[1]
    assert (held > -1).all()
    env.env_method("set_trigger_cost", 50.0)
    assert env.step(np.ones(ENVS, int))[1] == pytest.approx(np.full(ENVS, -50 / 51), abs=0.1)
    with pytest.raises(ValueError, match="indices"):
        env.env_method("set_trigger_cost", 1.0, indices=[0])


def test_the_rate_counts_lidar_and_extrapolated_frames(stored):
    env = make(stored)
    env.seed(0)
    env.reset()
    assert np.isnan(env.take_rate())
    for k in range(1, 6):
        env.step(np.full(ENVS, int(k in (2, 5))))
    assert env.take_rate() == pytest.approx(20.0)  # slice 2, and slice 5 by the LiDAR
    for _ in range(SLICES - 5):
        env.step(np.ones(ENVS, int))
    assert env.take_rate() == pytest.approx(50.0)


def test_wrong_use_is_refused(stored):
    with pytest.raises(ValueError, match="autoreset mode"):
        ReplayVecEnv(batched(stored, autoreset_mode=AutoresetMode.NEXT_STEP))
    with pytest.raises(ValueError, match="cost_offset: found 0"):
        make(stored, cost_offset=0)
