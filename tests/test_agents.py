import re
from pathlib import Path

import numpy as np
import pytest
from analytic_stream import WallStream

from agents import (
    Accumulated,
    Always,
    EventRate,
    EventRateHysteresis,
    FixedSchedule,
    GreedyDepthChange,
    KeyframeRule,
    Never,
    Periodic,
    RandomTrigger,
    SpeedAge,
)
from agents.activity import STATISTICS_FIELDS, activity
from agents.base import TraceTruth
from agents.catalogue import FAMILIES
from nl_env.depth.extrapolators import make_extrapolator
from nl_env.env import AdaptiveDepthEnv
from nl_env.evaluation import play
from nl_env.observations import (
    OBS_MODES,
    image_observation,
    make_observation,
    state_vector,
    statistics_observation,
)
from nl_env.statistics import MEASURES, ActivityMemory, slice_statistics
from nl_env.traces import trace_sequence

FRAME_MODES = tuple(mode for mode in OBS_MODES if mode != "statistics")
"""The modes that hold an event frame."""
SHAPE = (40, 50)
STATE = state_vector(0.2, 0.2, 10, 2000, 0)

POLICIES = [
    Never(),
    Always(),
    Periodic(3, phase=1),
    FixedSchedule("0110"),
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


def test_a_fixed_schedule_repeats_after_every_lidar_frame():
    assert run(FixedSchedule("0100"), [0.0] * 10) == [0, 1, 0, 0, 0] * 2
    assert run(FixedSchedule("1"), [0.0] * 4) == [1, 0] * 2  # a LiDAR frame at every other slice


@pytest.mark.parametrize("mode", FRAME_MODES)
def test_event_rate_sees_the_same_in_every_observation_mode(mode):
    assert run(EventRate(0.1), [0.05, 0.1, 0.2], mode) == [0, 0, 1]
    assert run(EventRate(0.3, measure="count"), [0.1, 0.2], mode) == [0, 1]


@pytest.mark.parametrize("mode", FRAME_MODES)
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
@pytest.mark.parametrize("mode", FRAME_MODES)
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
        (lambda: FixedSchedule("0120"), "pattern:"),
        (lambda: FixedSchedule(""), "pattern:"),
        (lambda: SpeedAge(-0.1), "metres:"),
        (lambda: Accumulated(float("inf")), "threshold:"),
        (lambda: Accumulated(0.1, measure="count"), "measure:"),
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
    if policy.privileged:
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
    ego_speed = np.where(np.arange(21) < 10, 10.0, 0.0)
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


def test_speed_age_triggers_after_a_way_and_not_while_standing():
    policy = SpeedAge(0.35)  # 10 m/s are 0.2 m a slice
    policy.begin(Table())
    assert [k for k, a in enumerate(run(policy, [0.0] * 20), 1) if a] == [2, 4, 7, 9]
    live = roll(SpeedAge(0.35), AdaptiveDepthEnv(WallStream(), extrapolator="repeat"))
    assert [k for k, info in enumerate(live, 1) if info["action"]] == [2, 4, 7, 9, 12, 14, 17, 19]


def test_greedy_live_bounds_the_error_it_can_avoid():
    threshold = 0.008
    env = AdaptiveDepthEnv(WallStream(), extrapolator="repeat")
    for info in roll(GreedyDepthChange(threshold), env):
        assert info["action"] or info["log_mae"] <= threshold


def test_privileged_policies_say_so_and_what_they_need():
    for policy in (KeyframeRule(), GreedyDepthChange(0.1), SpeedAge(0.1)):
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


def observe(memory, since_lidar=0.4):
    """A statistics observation of an accumulator."""
    return statistics_observation(state_vector(since_lidar, 0.2, 10, 2000, 0), memory.observed())


@pytest.mark.parametrize(("measure", "per_slice"), [("active", 1.0), ("magnitude", 2.0)])
def test_activity_comes_back_from_an_observation(measure, per_slice):
    memory, numbers = ActivityMemory(), slice_statistics(image_observation(frame(1.0))[0])
    memory.see(numbers, True)
    for _ in range(3):
        memory.see(numbers, False)
    seen = observe(memory)[None]
    assert activity(seen, "slice", measure) == pytest.approx(per_slice, rel=1e-5)
    assert activity(seen, "since_depth", measure) == pytest.approx(3 * per_slice, rel=1e-5)
    assert activity(seen, "last_interval", measure) == pytest.approx(per_slice, rel=1e-5)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("measure", MEASURES)
def test_accumulated_is_send_on_delta(measure, weighted):
    trace = trace_sequence(WallStream(), make_extrapolator("repeat"), 1)
    regions = np.moveaxis(trace.statistics.reshape(-1, len(MEASURES), 12), 1, 0)
    per_slice = regions[MEASURES.index(measure)].mean(axis=1)
    threshold = (1.2 if weighted else 1.6) * per_slice[1:].mean()
    expected, total = [], 0.0
    for k in range(1, trace.slices + 1):
        total = 0.0 if trace.lidar[k] else total + per_slice[k]
        if (np.sqrt(total * per_slice[k]) if weighted else total) > threshold:
            expected.append(k)
            total = 0.0
    assert 3 < len(expected) < 12
    policy = Accumulated(threshold, measure, weighted)
    assert play(policy, trace, "accumulated").triggers == tuple(expected)
    live = roll(policy, AdaptiveDepthEnv(WallStream(), extrapolator="repeat", obs_mode="statistics"))
    assert [k for k, info in enumerate(live, 1) if info["action"]] == expected


def test_statistics_in_a_batch_and_what_is_refused():
    memory = ActivityMemory()
    memory.see(slice_statistics(image_observation(frame(0.5))[0]), False)
    busy, arriving, quiet = observe(memory), observe(memory, since_lidar=0.0), observe(ActivityMemory())
    actions, _ = Accumulated(0.5).predict(np.stack([busy, arriving, quiet]))
    assert actions.tolist() == [1, 0, 0]
    told = np.append(busy, np.float32(0.5))  # an environment that shows the cost
    assert Accumulated(0.5).predict(told)[0] == 1
    for wrong in (busy[:-1], busy.astype(np.float64), np.zeros((1, *SHAPE), np.uint8)):
        with pytest.raises(ValueError, match=f'obs_mode "statistics", with n = {STATISTICS_FIELDS}'):
            Accumulated(0.5).predict(wrong)


def test_the_example_policies_of_the_documentation():
    page = (Path(__file__).parents[1] / "docs" / "policies.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    names = {"__name__": "example"}
    exec(compile(block, "docs/policies.md", "exec"), names)
    assert run(names["LowerHalf"](), [0.1, 0.9]) == [0, 1]
    trace = trace_sequence(WallStream(), make_extrapolator("repeat"), 1)
    record = play(names["Impatient"](), trace, "impatient")
    assert record.triggers == tuple(k for k in range(1, 21) if k % 5 == 3)


def test_every_family_is_documented():
    page = (Path(__file__).parents[1] / "docs" / "policies.md").read_text(encoding="utf-8")
    assert set(FAMILIES) <= set(re.findall(r"`([a-z-]+)`", page.partition("## Write one")[0]))
