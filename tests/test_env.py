import math
import pickle

import gymnasium as gym
import numpy as np
import pytest
from analytic_stream import WallStream

from nl_env import rewards
from nl_env.config import SPLITS
from nl_env.env import AdaptiveDepthEnv
from nl_env.ledger import DepthLedger
from nl_env.observations import (
    OBS_MODES,
    cost_coordinate,
    event_frames,
    image_observation,
    observation_space,
    signed_observation,
    state_vector,
)
from nl_env.statistics import ACTIVITY_FIELDS, ActivityMemory, slice_statistics
from nl_env.types import SLICE_US, Extrapolation
from nl_env.viewer import HEIGHT, WIDTH

INFO_TYPES = {
    "t": int,
    "lidar": bool,
    "triggered": bool,
    "depth_age": int,
    "log_mae": float,
    "imae": float,
    "bad_25": float,
    "rmse": float,
    "abs_rel": float,
    "held_depth_source": str,
    "ego_speed": float,
    "shortest_distance": float,
    "new_actors": int,
    "keyframe": bool,
    "keyframe_speed": bool,
    "keyframe_distance": bool,
    "keyframe_new": bool,
    "event_count": int,
    "active_fraction": float,
    "effective_rate": float,
    "reward/error": float,
    "reward/trigger": float,
}


class Truth:
    """An extrapolator that returns the exact depth of the wall stream and records its inputs."""

    history = 2
    odometry = True

    def __init__(self, stream):
        self.stream = stream
        self.calls = []
        self.resets = 0

    def reset(self):
        self.resets += 1

    def __call__(self, inputs):
        self.calls.append(inputs)
        return Extrapolation(self.stream.render(inputs.t)[1])


def make(stream=None, **arguments):
    return AdaptiveDepthEnv(stream or WallStream(), **{"extrapolator": "repeat", **arguments})


def play(env, actions, seed=1):
    """Infos of t = 0 and every step."""
    _, info = env.reset(seed=seed)
    return [info, *(env.step(action)[4] for action in actions)]


def test_holding_ages_and_lidar_renews():
    infos = play(make(), [0] * 20)
    assert [i["t"] for i in infos] == [k * SLICE_US for k in range(21)]
    assert [i["depth_age"] // SLICE_US for i in infos] == [k % 5 for k in range(21)]
    assert [i["lidar"] for i in infos] == [k % 5 == 0 for k in range(21)]
    assert not any(i["triggered"] for i in infos)
    assert all((i["log_mae"] == 0) == i["lidar"] for i in infos)
    assert infos[-1]["effective_rate"] == pytest.approx(10.0)


def test_error_of_the_held_depth_is_the_distance_driven():
    """Half of the wall's pixels would do: with no square and no sky, every pixel is at distance - speed t."""
    stream = WallStream(speed=10.0, distance=40.0)
    stream.render = lambda t: (
        np.full((48, 64), 0.5, np.float32),
        np.full((48, 64), 40 - 1e-5 * t, np.float32),
    )
    for k, info in enumerate(play(make(stream), [0] * 4)):
        true = 40 - 0.2 * k
        assert info["rmse"] == pytest.approx(0.2 * k, abs=1e-5)
        assert info["abs_rel"] == pytest.approx(0.2 * k / true, abs=1e-6)
        assert info["log_mae"] == pytest.approx(math.log(40 / true), abs=1e-6)
        assert info["imae"] == pytest.approx(1000 * (1 / true - 1 / 40), abs=1e-4)


def test_a_trigger_produces_the_depth_of_its_own_slice():
    stream = WallStream()
    infos = play(make(stream, extrapolator=Truth(stream)), [0, 1, 0, 1, 1, 0])
    assert [i["triggered"] for i in infos] == [False, False, True, False, True, False, False]
    assert [i["depth_age"] // SLICE_US for i in infos] == [0, 1, 0, 1, 0, 0, 1]
    sources = [i["held_depth_source"] for i in infos]
    assert sources == ["lidar", "lidar", "extrapolated", "extrapolated", "extrapolated", "lidar", "lidar"]
    assert infos[2]["log_mae"] == infos[4]["log_mae"] == 0
    assert infos[1]["log_mae"] > 0 and infos[3]["log_mae"] > 0


def test_an_action_at_a_lidar_slice_is_free_and_without_effect():
    env, other = make(), make()
    env.reset(seed=1), other.reset(seed=1)
    for k in range(1, 11):
        _, reward, _, _, info = env.step(int(k % 5 == 0))
        _, reward_held, _, _, info_held = other.step(0)
        assert reward == reward_held and info == info_held


def test_reward_is_the_sum_of_its_named_parts():
    env = make(error="rmse", error_scale=2.0, trigger_cost=0.3)
    env.reset(seed=1)
    for action in (0, 1, 1, 0, 1):
        _, reward, _, _, info = env.step(action)
        assert type(reward) is float
        assert reward == info["reward/error"] + info["reward/trigger"]
        assert info["reward/error"] == -info["rmse"] / 2.0
        assert info["reward/trigger"] == (-0.3 if info["triggered"] else 0.0)


def test_delta_metrics_are_turned_into_errors_and_nan_costs_nothing():
    env = make(error="delta_1", error_scale=1.0)
    _, info = env.reset(seed=1)
    assert info["reward/error"] == 0.0
    assert rewards.components(math.nan, 1.0, False, 0.1) == {"error": 0.0, "trigger": 0.0}


def test_the_observation_shows_the_slice_the_next_action_acts_on():
    stream, reference = WallStream(), WallStream()
    env = make(stream, obs_mode="signed")
    observation, _ = env.reset(seed=1)
    reference.reset(1)
    sample = reference.advance()
    for k in range(1, 20):
        np.testing.assert_array_equal(observation[0], np.clip(sample.event_frame, -128, 127))
        assert env.sample.index == k
        observation, _, _, truncated, info = env.step(0)
        assert info["event_count"] == sample.event_count and not truncated
        np.testing.assert_array_equal(env.true_depth, sample.depth)
        sample = reference.advance()
    last, _, terminated, truncated, _ = env.step(0)
    assert truncated and not terminated
    np.testing.assert_array_equal(last, observation)


def test_state_vector_counts_time_since_lidar_and_depth():
    env = make(obs_mode="dict")
    observation, _ = env.reset(seed=1)
    rows = [observation["state"]]
    for action in (0, 1, 0, 0, 0, 1):
        rows.append(env.step(action)[0]["state"])
    since_lidar, since_depth, _, last_action = np.array(rows).T
    np.testing.assert_allclose(since_lidar, [0.2, 0.4, 0.6, 0.8, 0, 0.2, 0.4], rtol=1e-6)
    np.testing.assert_allclose(since_depth, [0.2, 0.4, 0.2, 0.4, 0, 0.2, 0.2], rtol=1e-6)
    np.testing.assert_array_equal(last_action, [0, 0, 1, 0, 0, 0, 1])


def test_observation_encodings():
    frame = np.array([[0, 1, -1], [127, 128, -128], [-129, 30000, -30000]], np.int16)
    image, signed = image_observation(frame), signed_observation(frame)
    assert image.dtype == np.uint8 and signed.dtype == np.int8
    assert image[0].tolist() == [[128, 129, 127], [255, 255, 0], [0, 255, 0]]
    assert signed[0].tolist() == [[0, 1, -1], [127, 127, -128], [-128, 127, -128]]
    for observation in (image, signed, {"event_frame": image}):
        np.testing.assert_array_equal(event_frames(observation), signed[0])
    assert state_vector(0.5, 0.25, 300, 100, 1).tolist() == [0.5, 0.25, 0.75, 1.0]


def test_state_vectors_of_a_batch_equal_the_single_ones():
    since_lidar, since_depth, last = np.array([0.2, 0.4]), np.array([0.2, 0.0]), np.array([0, 1])
    batch = state_vector(since_lidar, since_depth, np.array([300, 7]), 100, last)
    singles = [state_vector(0.2, 0.2, 300, 100, 0), state_vector(0.4, 0.0, 7, 100, 1)]
    np.testing.assert_array_equal(batch, singles)


def test_statistics_are_the_state_and_the_activity_since_the_depth_frames():
    pictures, numbers = make(obs_mode="dict"), make(obs_mode="statistics")
    (picture, _), (seen, _) = pictures.reset(seed=1), numbers.reset(seed=1)
    memory, actions = ActivityMemory(), [0, 1, 0, 0, 1, 1, 0]
    for action in actions:
        memory.see(slice_statistics(picture["event_frame"][0]), pictures.sample.lidar is not None)
        np.testing.assert_array_equal(seen[:4], picture["state"])
        np.testing.assert_array_equal(seen[4:], memory.observed())
        picture, _, _, _, info = pictures.step(action)
        seen = numbers.step(action)[0]
        memory.act(info["triggered"])
    assert seen.shape == (4 + ACTIVITY_FIELDS,) and memory.windows.any(axis=1).all()


def test_the_last_observation_shows_the_last_slice_after_its_action():
    env = make(WallStream(slices=3), obs_mode="statistics")
    env.reset(seed=1)
    env.step(0)
    before = env.step(0)[0]
    after = env.step(1)[0]
    _, since_depth, since_lidar, _ = after[4:].reshape(4, -1)
    np.testing.assert_array_equal(after[4:].reshape(4, -1)[0], before[4:].reshape(4, -1)[0])
    assert not since_depth.any() and since_lidar.any()


def test_costs_are_drawn_for_each_episode_and_shown():
    env, again = (make(obs_mode="statistics", trigger_cost=(0.01, 10.0)) for _ in range(2))
    costs = []
    for seed in (5, None, None, None):
        observation, _ = env.reset(seed=seed)
        np.testing.assert_array_equal(observation, again.reset(seed=seed)[0])
        costs.append(env.trigger_cost)
        assert observation in env.observation_space
        assert observation[-1] == cost_coordinate(env.trigger_cost)
        observation, _, _, _, info = env.step(1)
        assert info["reward/trigger"] == -env.trigger_cost and observation[-1] == cost_coordinate(costs[-1])
        again.step(1)
    assert len(set(costs)) == 4 and all(0.01 <= cost <= 10.0 for cost in costs)


def test_costs_are_uniform_in_the_logarithm():
    env = make(WallStream(slices=1), obs_mode="dict", trigger_cost=(0.001, 10.0))
    env.reset(seed=1)
    logarithms = []
    for _ in range(200):
        observation, _ = env.reset()
        logarithms.append(math.log10(env.trigger_cost))
        assert observation["trigger_cost"] == cost_coordinate(env.trigger_cost)
    counts = np.histogram(logarithms, bins=4, range=(-3, 1))[0]
    assert counts.sum() == 200 and counts.min() > 25


def test_a_reset_can_set_the_cost_of_its_episode():
    for range_or_number in (0.1, (0.1, 1.0)):
        env = make(obs_mode="dict", trigger_cost=range_or_number)
        env.reset(seed=1, options={"trigger_cost": 20})
        assert env.trigger_cost == 20.0 and env.step(1)[1] < -20
        env.reset(seed=1)
        assert 0.1 <= env.trigger_cost <= 1.0


def test_the_cost_can_be_adapted_while_an_episode_runs():
    env = make(trigger_cost=0.1)
    env.reset(seed=1)
    assert env.step(1)[4]["reward/trigger"] == -0.1
    env.set_trigger_cost(0.4)
    assert env.step(1)[4]["reward/trigger"] == -0.4
    env.reset(seed=1)
    assert env.trigger_cost == 0.4
    with pytest.raises(ValueError, match="draws its cost"):
        make(obs_mode="dict", trigger_cost=(0.1, 1.0)).set_trigger_cost(0.4)
    with pytest.raises(ValueError, match="cost: found -1"):
        env.set_trigger_cost(-1)


def test_cost_coordinates_span_the_allowed_costs():
    assert cost_coordinate(np.array([1e-4, 0.1, 100.0, 1e-9, 1e9])) == pytest.approx([0, 0.5, 1, 0, 1])
    assert cost_coordinate(0.1).dtype == np.float32


@pytest.mark.parametrize("mode", ["image", "signed"])
def test_modes_without_a_place_for_the_cost_refuse_a_range(mode):
    with pytest.raises(ValueError, match=f"trigger_cost: found a range of costs with obs_mode '{mode}'"):
        make(obs_mode=mode, trigger_cost=(0.1, 1.0))
    with pytest.raises(ValueError, match="trigger_cost"):
        observation_space(mode, (48, 64), costs=True)


@pytest.mark.parametrize("mode", OBS_MODES)
def test_observations_fit_their_space_and_are_fresh(mode):
    env = make(obs_mode=mode)
    first, _ = env.reset(seed=1)
    copies = [pickle.dumps(first)]
    seen = [first]
    for _ in range(5):
        seen.append(env.step(1)[0])
        copies.append(pickle.dumps(seen[-1]))
    assert all(observation in env.observation_space for observation in seen)
    assert [pickle.dumps(observation) for observation in seen] == copies


def test_info_has_the_same_keys_and_types_every_step():
    for info in play(make(), [1, 0] * 10):
        assert {key: type(value) for key, value in info.items()} == INFO_TYPES


def test_extrapolator_sees_the_lidar_history_and_the_events_since():
    stream = WallStream()
    extrapolator = Truth(stream)
    env = make(stream, extrapolator=extrapolator)
    play(env, [0, 1, 0, 0, 0, 0, 0, 1])
    first, second = extrapolator.calls
    assert extrapolator.resets == 1
    assert list(first.lidar_times) == [0] and list(second.lidar_times) == [0, 5 * SLICE_US]
    assert (first.t, second.t) == (2 * SLICE_US, 8 * SLICE_US)
    assert len(first.bins) == 2 and len(second.bins) == 3 and first.bins[0].shape == (5, 48, 64)
    assert [pose[0, 3] for pose in second.poses] == pytest.approx([0.0, 1.0, 1.6])
    np.testing.assert_array_equal(second.lidar_frames[1], env.prior_depth)


def test_an_extrapolator_of_the_wrong_shape_is_named():
    stream = WallStream()
    extrapolator = Truth(stream)
    extrapolator.stream = WallStream(size=(36, 36))
    extrapolator.stream.reset(1)
    with pytest.raises(ValueError, match="extrapolator: found depth of shape"):
        play(make(stream, extrapolator=extrapolator), [1])


def test_same_seed_same_everything_and_other_seed_differs():
    actions = [0, 1] * 10
    assert play(make(), actions) == play(make(), actions)
    assert play(make(), actions) != play(make(), actions, seed=2)


def test_unseeded_resets_draw_new_training_sequences_reproducibly():
    class Seeds(WallStream):
        def reset(self, seed):
            self.seeds = [*getattr(self, "seeds", []), seed]
            return super().reset(seed)

    streams = [Seeds(), Seeds()]
    for stream in streams:
        env = make(stream)
        env.reset(seed=7)
        for _ in range(5):
            env.reset()
        env.reset(options={"sequence": SPLITS["test"][0]})
    first, second = streams
    assert first.seeds == second.seeds
    assert first.seeds[0] == 7 and first.seeds[-1] == SPLITS["test"].start
    assert len(set(first.seeds)) == 7
    assert all(seed in SPLITS["train"] and type(seed) is int for seed in first.seeds[1:-1])


@pytest.mark.parametrize("cut", [0, 7])
def test_a_pickled_environment_continues_identically(cut):
    env = make()
    env.reset(seed=3)
    for _ in range(cut):
        env.step(1)
    copy = pickle.loads(pickle.dumps(env))
    for _ in range(20 - cut):
        expected, found = env.step(1), copy.step(1)
        np.testing.assert_array_equal(expected[0], found[0])
        assert expected[1:] == found[1:]


@pytest.mark.parametrize("action", [2, -1, 0.5, None, "1", np.array([1]), np.array(1.0), np.float32(1), [0]])
def test_bad_actions_are_refused_and_change_nothing(action):
    env, untouched = make(), make()
    env.reset(seed=1), untouched.reset(seed=1)
    with pytest.raises(ValueError, match="action: found"):
        env.step(action)
    assert env.step(1)[1:] == untouched.step(1)[1:]


@pytest.mark.parametrize("action", [1, True, np.int64(1), np.uint8(1), np.array(1)])
def test_integer_actions_of_any_kind_work(action):
    assert play(make(), [action])[-1]["triggered"] is True


def test_calls_out_of_order_say_what_to_do():
    env = make()
    for call in (lambda: env.step(0), env.render, lambda: env.depth, lambda: env.sample):
        with pytest.raises(gym.error.ResetNeeded, match="reset"):
            call()
    play(env, [0] * 20)
    with pytest.raises(gym.error.ResetNeeded, match="ended at slice 20"):
        env.step(0)
    env.reset()
    env.step(0)
    env.close()
    env.close()
    for call in (lambda: env.step(0), env.reset, env.render):
        with pytest.raises(gym.error.ClosedEnvironmentError, match="closed"):
            call()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"obs_mode": "rgb"}, "'image', 'signed', 'dict'"),
        ({"error": "mse"}, "'log_mae'"),
        ({"render_mode": "ascii"}, "'rgb_array'"),
        ({"extrapolator": "magic"}, "warp"),
        ({"error_scale": 0.0}, "error_scale"),
        ({"trigger_cost": -1.0}, "trigger_cost"),
        ({"trigger_cost": (0.1,), "obs_mode": "dict"}, "expected a number or a pair"),
        ({"trigger_cost": (1.0, 0.1), "obs_mode": "dict"}, "lowest cost first"),
        ({"trigger_cost": (0.0, 0.1), "obs_mode": "dict"}, r"trigger_cost: found 0.0, .* \[0.0001, 100"),
        ({"trigger_cost": ("a", "b"), "obs_mode": "dict"}, "trigger_cost: found 'a'"),
    ],
)
def test_bad_arguments_list_the_valid_ones(arguments, message):
    with pytest.raises(ValueError, match=message):
        make(**arguments)


def test_unknown_arguments_and_options_are_refused():
    with pytest.raises(TypeError, match="lidar"):
        make(lidar=3)
    with pytest.raises(ValueError, match="options key: found 'seed'"):
        make().reset(options={"seed": 3})
    with pytest.raises(ValueError, match="sequence"):
        make().reset(options={"sequence": -3})
    with pytest.raises(ValueError, match=r"options\['trigger_cost'\]: found -1"):
        make().reset(options={"trigger_cost": -1})
    with pytest.raises(ValueError, match=r"options\['trigger_cost'\]: found 1000"):
        make(obs_mode="dict", trigger_cost=(0.1, 1.0)).reset(options={"trigger_cost": 1000})


def test_rgb_array_is_a_panel_that_changes_and_depth_array_the_held_depth():
    env = make(render_mode="rgb_array")
    env.reset(seed=1)
    first = env.render()
    env.step(0)
    second = env.render()
    assert first.shape == second.shape == (HEIGHT, WIDTH, 3) and first.dtype == np.uint8
    assert (first != second).any() and first.std() > 10

    env = make(render_mode="depth_array")
    env.reset(seed=1)
    np.testing.assert_array_equal(env.render(), env.depth)
    assert env.render() is not env.depth


def test_human_mode_opens_a_window_without_a_display(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = make(render_mode="human")
    env.reset(seed=1)
    env.step(1)
    assert env.render() is None
    assert env.metadata == AdaptiveDepthEnv.metadata
    env.close()


def test_ledger_counts_frames_and_refuses_gaps():
    ledger = DepthLedger(5)
    for k in range(1, 11):
        assert ledger.act(k, k % 5 == 0, 1) == (k % 5 != 0)
    assert (ledger.lidar_frames, ledger.triggers, ledger.effective_rate) == (2, 8, 50.0)
    with pytest.raises(ValueError, match="index: found 13, expected 11"):
        ledger.act(13, False, 0)
