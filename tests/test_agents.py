import numpy as np
import pytest
from analytic_stream import WallStream

from agents import (
    Always,
    EventRate,
    EventRateHysteresis,
    GreedyDepthChange,
    KeyframeRule,
    Never,
    Periodic,
    RandomTrigger,
)
from agents.base import TraceTruth
from nl_env.env import AdaptiveDepthEnv
from nl_env.observations import OBS_MODES, make_observation, state_vector

SHAPE = (40, 50)
STATE = state_vector(0.2, 0.2, 10, 2000, 0)

POLICIES = [
    Never(),
    Always(),
    Periodic(3, phase=1),
    RandomTrigger(0.5, seed=4),
    EventRate(0.1),
    EventRate(0.3, measure="count"),
    EventRateHysteresis(0.05, 0.2),
]


def frame(active):
    """An event frame with a share ``active`` of pixels at -2 events."""
    events = np.zeros(SHAPE, np.int16)
    events.reshape(-1)[: round(active * events.size)] = -2
    return events


def run(policy, actives, mode="image"):
    """Actions over a sequence of frames."""
    state, actions = None, []
    for active in actives:
        action, state = policy.predict(make_observation(mode, frame(active), STATE), state)
        actions.append(int(action))
    return actions


def test_constant_and_periodic():
    assert run(Never(), [0.5] * 3) == [0, 0, 0]
    assert run(Always(), [0.0] * 3) == [1, 1, 1]
    assert run(Periodic(3), [0.0] * 7) == [0, 0, 1, 0, 0, 1, 0]
    assert run(Periodic(3, phase=1), [0.0] * 7) == [1, 0, 0, 1, 0, 0, 1]


@pytest.mark.parametrize("mode", OBS_MODES)
def test_event_rate_sees_the_same_in_every_observation_mode(mode):
    assert run(EventRate(0.1), [0.05, 0.1, 0.2], mode) == [0, 0, 1]
    assert run(EventRate(0.3, measure="count"), [0.1, 0.2], mode) == [0, 1]


@pytest.mark.parametrize("mode", OBS_MODES)
def test_hysteresis_keeps_its_state_between_the_thresholds(mode):
    assert run(EventRateHysteresis(0.1, 0.3), [0.2, 0.4, 0.2, 0.05, 0.2], mode) == [0, 1, 1, 0, 0]


def test_random_rate_and_repeatability():
    actions = run(RandomTrigger(0.3, seed=1), [0.0] * 2000)
    assert abs(np.mean(actions) - 0.3) < 0.04
    assert actions == run(RandomTrigger(0.3, seed=1), [0.0] * 2000)
    assert actions != run(RandomTrigger(0.3, seed=2), [0.0] * 2000)
    assert run(RandomTrigger(0.0), [0.0] * 50) == [0] * 50
    assert run(RandomTrigger(1.0), [0.0] * 50) == [1] * 50


@pytest.mark.parametrize("policy", POLICIES, ids=lambda p: type(p).__name__)
@pytest.mark.parametrize("mode", OBS_MODES)
def test_single_and_batched_predictions_have_sb3_shapes(policy, mode):
    one = make_observation(mode, frame(0.25), STATE)
    batch = {k: np.stack([v] * 3) for k, v in one.items()} if mode == "dict" else np.stack([one] * 3)
    action, state = policy.predict(one)
    actions, states = policy.predict(batch)
    assert np.shape(action) == () and action in (0, 1)
    assert actions.shape == (3,) and actions.dtype == np.int64
    assert len(state) == 1 and len(states) == 3
    assert not policy.privileged


@pytest.mark.parametrize(
    "policy", [Periodic(3), EventRateHysteresis(0.1, 0.3)], ids=lambda p: type(p).__name__
)
def test_batched_environments_are_independent_and_reset_alone(policy):
    first, second = [0.4, 0.2, 0.2, 0.2, 0.4, 0.2], [0.2, 0.2, 0.4, 0.2, 0.05, 0.2]
    restart = 3
    state, columns = None, []
    for k, (a, b) in enumerate(zip(first, second, strict=True)):
        start = np.array([k == restart, False])
        batch = np.stack([make_observation("image", frame(active), STATE) for active in (a, b)])
        actions, state = policy.predict(batch, state, episode_start=start)
        columns.append(actions)
    left, right = np.array(columns).T
    assert left.tolist() == run(policy, first[:restart]) + run(policy, first[restart:])
    assert right.tolist() == run(policy, second)


def test_the_given_state_is_not_modified():
    policy = Periodic(2)
    _, state = policy.predict(make_observation("image", frame(0), STATE))
    before = state.copy()
    policy.predict(make_observation("image", frame(0), STATE), state)
    np.testing.assert_array_equal(state, before)


@pytest.mark.parametrize(
    ("make", "argument"),
    [
        (lambda: Periodic(0), "n:"),
        (lambda: Periodic(3, phase=3), "phase:"),
        (lambda: RandomTrigger(1.5), "p:"),
        (lambda: EventRate(float("nan")), "threshold:"),
        (lambda: EventRate(0.1, measure="rate"), "active, count"),
        (lambda: EventRateHysteresis(0.3, 0.1), "low:"),
        (lambda: GreedyDepthChange(-1), "threshold:"),
    ],
)
def test_bad_arguments_are_named(make, argument):
    with pytest.raises(ValueError, match=argument):
        make()


@pytest.mark.parametrize("shape", [(50,), (40, 50), (1, 1, 1, 40, 50)])
def test_observations_of_other_shapes_are_refused(shape):
    with pytest.raises(ValueError, match="observation: found shape"):
        Always().predict(np.zeros(shape, np.uint8))


def roll(policy, env):
    """Actions and ``triggered`` flags of one live sequence."""
    observation, _ = env.reset(seed=1)
    policy.bind(env)
    state, infos, truncated = None, [], False
    while not truncated:
        action, state = policy.predict(observation, state)
        observation, _, _, truncated, info = env.step(action)
        infos.append({**info, "action": int(action)})
    return infos


class Table:
    """A trace by hand: ``errors["log_mae"][k, a] = 0.01 a``."""

    lidar = np.arange(21) % 5 == 0
    keyframe = np.arange(21) == 3
    errors = {"log_mae": np.tile(0.01 * np.arange(5), (21, 1))}  # noqa: RUF012


def test_keyframe_rule_live_and_on_a_trace():
    env = AdaptiveDepthEnv(WallStream(speed=9.0), extrapolator="repeat")
    assert [info["action"] for info in roll(KeyframeRule(), env)] == [int(k == 3) for k in range(1, 21)]
    policy = KeyframeRule()
    policy.begin(Table())
    assert run(policy, [0.0] * 20) == [int(k == 3) for k in range(1, 21)]


def test_greedy_triggers_when_the_held_depth_is_too_old():
    policy = GreedyDepthChange(0.015)
    policy.begin(Table())
    # Two slices after a frame the error is .02: the LiDAR at 5 restarts the count, so does each trigger.
    assert [k for k, a in enumerate(run(policy, [0.0] * 20), 1) if a] == [2, 4, 7, 9, 12, 14, 17, 19]


def test_greedy_live_bounds_the_error_it_can_avoid():
    threshold = 0.008
    env = AdaptiveDepthEnv(WallStream(), extrapolator="repeat")
    for info in roll(GreedyDepthChange(threshold), env):
        assert info["action"] or info["log_mae"] <= threshold


def test_privileged_policies_say_so_and_what_they_need():
    for policy in (KeyframeRule(), GreedyDepthChange(0.1)):
        assert policy.privileged
        with pytest.raises(RuntimeError, match="bind"):
            policy.predict(np.zeros((1, *SHAPE), np.uint8))
        policy.begin(Table())
        with pytest.raises(ValueError, match="batch of 2"):
            policy.predict(np.zeros((2, 1, *SHAPE), np.uint8))
    with pytest.raises(TypeError, match="AdaptiveDepthEnv"):
        KeyframeRule().bind(WallEnv())


class WallEnv:
    unwrapped = WallStream()


def test_trace_truth_reads_the_table():
    truth = TraceTruth(Table())
    assert truth.holding_error(4, 3) == pytest.approx(0.03)
    assert truth.lidar(10) and not truth.lidar(11)
