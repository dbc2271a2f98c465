import itertools

import numpy as np
import pytest
from analytic_stream import WallStream

from agents.oracle import oracle_curve
from agents.rules import Always, KeyframeRule, Never, Periodic, RandomTrigger
from nl_env.comparison import (
    PolicyInfo,
    SequenceResult,
    compare,
    evaluate_sequence,
    pooled_floor,
)
from nl_env.depth.metrics import METRIC_NAMES
from nl_env.env import AdaptiveDepthEnv
from nl_env.evaluation import EnergyModel, EpisodeRecord, estimate_mean, play, resample_sequences, summarise
from nl_env.frame_rates import rate_by_kind, rate_by_speed, rate_over_time
from nl_env.observations import COST_MODES, OBS_MODES
from nl_env.traces import code_depth, trace_sequence
from nl_env.types import Extrapolation

SPEED = 10.0
SLICE_S = 0.02


class PlainWall(WallStream):
    """Nothing but a wall: one depth for the whole image."""

    def render(self, t_us):
        depth = self.distance - self.speed * t_us * 1e-6
        return np.full(self.camera.shape, 0.5, np.float32), np.full(self.camera.shape, depth, np.float32)


class Approach:
    """Brings the last LiDAR frame closer at ``speed``: exact for a wall approached at that speed."""

    history = 1
    odometry = False

    def __init__(self, speed=SPEED):
        self.speed = speed

    def reset(self):
        pass

    def __call__(self, inputs):
        prior = inputs.lidar_frames[-1]
        moved = np.float32(self.speed * (inputs.t - inputs.lidar_times[-1]) * 1e-6)
        return Extrapolation(np.where(prior > 0, prior - moved, np.float32(0)))


class Script:
    """Triggers at given slices and keeps what it saw."""

    def __init__(self, triggers):
        self.triggers = triggers
        self.seen = []

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        k = 1 if state is None else state + 1
        self.seen.append(observation)
        return int(k in self.triggers), k


@pytest.fixture(scope="module")
def trace():
    return trace_sequence(WallStream(slices=23), Approach(speed=7.0), 3, keep_frames=True)


def wall_depth(k):
    return 40.0 - SPEED * k * SLICE_S


def test_errors_of_an_exact_extrapolator_are_those_of_its_age():
    errors = trace_sequence(PlainWall(slices=12), Approach(), 0).errors["log_mae"]
    assert errors.shape == (13, 5)
    for k, age in itertools.product(range(13), range(5)):
        if age > k % 5:
            assert np.isnan(errors[k, age])
        else:
            expected = np.log(wall_depth(k - age) / wall_depth(k))
            assert errors[k, age] == pytest.approx(expected, abs=1e-4)


def test_repeating_the_lidar_frame_is_never_younger():
    errors = trace_sequence(PlainWall(slices=9), Approach(speed=0.0), 0).errors["log_mae"]
    assert errors[9, :5] == pytest.approx(np.log(wall_depth(5) / wall_depth(9)), abs=1e-4)


class Together(Approach):
    """Makes several frames at once, and remembers how many."""

    def __init__(self):
        super().__init__()
        self.counts = []

    def batch(self, inputs):
        self.counts.append(len(inputs))
        return [super(Together, self).__call__(one) for one in inputs]

    def __call__(self, inputs):
        raise AssertionError("one at a time")


def test_an_extrapolator_that_can_makes_the_frames_of_an_interval_together():
    together = Together()
    found = trace_sequence(WallStream(slices=23), together, 3, keep_frames=True)
    assert together.counts == [4, 4, 4, 4, 3]
    alone = trace_sequence(WallStream(slices=23), Approach(), 3, keep_frames=True)
    for name, table in alone.errors.items():
        np.testing.assert_array_equal(found.errors[name], table)
    np.testing.assert_array_equal(found.frames.produced, alone.frames.produced)
    rare = Together()
    trace_sequence(WallStream(slices=20, lidar_period=10), rare, 3)
    assert rare.counts == [4, 4, 1, 4, 4, 1]


def test_columns_and_frames_of_a_trace(trace):
    assert trace.slices == 23
    assert np.flatnonzero(trace.lidar).tolist() == [0, 5, 10, 15, 20]
    assert np.flatnonzero(trace.keyframe_new).tolist() == [3]
    assert (trace.ego_speed == SPEED).all()
    assert trace.images.dtype == np.uint8 and (trace.images[0] == 128).all()
    assert trace.frames.truth.shape == trace.frames.events.shape == (24, 48, 64)
    assert np.array_equal(trace.frames.produced[trace.lidar], trace.frames.truth[trace.lidar])
    assert (trace.frames.produced[4] != trace.frames.truth[4]).any()


def test_depth_codes_are_logarithmic():
    codes = code_depth(np.array([0.0, 0.2, 1.0, np.sqrt(200.0), 200.0], np.float32), 200.0)
    assert codes.tolist() == [0, 1, 1, 128, 255]


@pytest.mark.parametrize("obs_mode", OBS_MODES)
def test_playing_a_trace_equals_stepping_the_environment(obs_mode, trace):
    triggers = {1, 3, 4, 5, 8, 16, 23}
    live, replayed = Script(triggers), Script(triggers)
    env = AdaptiveDepthEnv(WallStream(slices=23), extrapolator=Approach(speed=7.0), obs_mode=obs_mode)
    observation, _ = env.reset(seed=3)
    infos, state, truncated = [], None, False
    while not truncated:
        action, state = live.predict(observation, state)
        observation, _, _, truncated, info = env.step(action)
        infos.append(info)

    record = play(replayed, trace, "script", obs_mode=obs_mode)
    for name in ("log_mae", "imae", "bad_25", "rmse", "abs_rel"):
        assert record.held[name] == pytest.approx(np.mean([info[name] for info in infos]), rel=1e-12)
    assert record.triggers == tuple(k for k, info in enumerate(infos, 1) if info["triggered"])
    assert record.effective_rate == infos[-1]["effective_rate"]
    for seen, expected in zip(replayed.seen, live.seen, strict=True):
        pairs = [(seen, expected)] if obs_mode != "dict" else [(seen[key], expected[key]) for key in expected]
        for a, b in pairs:
            assert a.dtype == b.dtype and np.array_equal(a, b)


@pytest.mark.parametrize("obs_mode", COST_MODES)
def test_a_policy_says_what_it_wants_to_see(obs_mode, trace):
    policy = Script({2})
    policy.obs_mode, policy.trigger_cost = obs_mode, 0.3
    env = AdaptiveDepthEnv(
        WallStream(slices=23), extrapolator=Approach(), obs_mode=obs_mode, trigger_cost=(0.1, 1.0)
    )
    expected, _ = env.reset(seed=3, options={"trigger_cost": 0.3})
    play(policy, trace, "script")
    if obs_mode == "dict":
        assert policy.seen[0].keys() == expected.keys()
        assert all(np.array_equal(policy.seen[0][key], expected[key]) for key in expected)
    else:
        np.testing.assert_array_equal(policy.seen[0], expected)


def test_a_policy_that_wants_a_cost_needs_a_mode_that_shows_it(trace):
    policy = Script({2})
    policy.trigger_cost = 0.3
    with pytest.raises(ValueError, match="obs_mode 'image'"):
        play(policy, trace, "script")
    policy.obs_mode = "sound"
    with pytest.raises(ValueError, match="obs_mode: found 'sound'"):
        play(policy, trace, "script")


def test_counts_rates_and_energy_of_a_known_schedule(trace):
    record = play(Script({3, 5, 7}), trace, "script", energy=EnergyModel(2.0, 3.0, 5.0))
    assert record.triggers == (3, 7)  # slice 5 has a LiDAR frame
    assert record.effective_rate == pytest.approx((4 + 2) / (23 * SLICE_S))
    keyframes = set(np.flatnonzero(trace.keyframe & ~trace.lidar).tolist())
    assert record.true_positives == len(keyframes & {3, 7})
    assert record.false_positives == len({3, 7} - keyframes)
    assert record.false_negatives == len(keyframes - {3, 7})
    assert record.energy_j == pytest.approx(4 * 2 + 2 * 3 + 23 * SLICE_S * 5)
    fresh = trace.errors["log_mae"][[3, 7], 0]
    assert record.produced["log_mae"] == pytest.approx(fresh.mean())
    assert np.isnan(play(Never(), trace, "never").produced["log_mae"])


def test_privileged_policies_get_the_trace(trace):
    record = play(KeyframeRule(), trace, "rule")
    assert set(record.triggers) == set(np.flatnonzero(trace.keyframe & ~trace.lidar).tolist()) - {0}
    assert record.false_positives == record.false_negatives == 0


def test_bad_input_to_play(trace):
    with pytest.raises(ValueError, match=r"obs_mode: found 'rgb'.*'image', 'signed', 'dict'"):
        play(Never(), trace, "never", obs_mode="rgb")
    policy = Script(set())
    policy.predict = lambda *args, **kwargs: (2, None)
    with pytest.raises(ValueError, match="policy 'two': found action 2 at slice 1, expected 0 or 1"):
        play(policy, trace, "two")


def record(held, produced=np.nan, counts=(0, 0, 0), policy="p", triggers=(1,)):
    return EpisodeRecord(
        policy=policy,
        seed=0,
        duration_s=1.0,
        triggers=triggers,
        effective_rate=10.0 + held,
        held=dict.fromkeys(METRIC_NAMES, held),
        produced=dict.fromkeys(METRIC_NAMES, produced),
        true_positives=counts[0],
        false_positives=counts[1],
        false_negatives=counts[2],
        energy_j=8.0,
    )


def test_summary_of_hand_made_records():
    records = [record(1.0, np.nan, (3, 1, 0)), record(2.0, 0.5, (0, 1, 2)), record(6.0, 0.7, (1, 0, 0))]
    summary = summarise(records, resample_sequences(3, np.random.default_rng(0)))
    assert summary.held["log_mae"].mean == pytest.approx(3.0)
    assert summary.produced["log_mae"].mean == pytest.approx(0.6)  # the first never triggered
    assert (summary.rate_min, summary.rate_max) == (11.0, 16.0)
    assert summary.precision.mean == pytest.approx(4 / 6)
    assert summary.recall.mean == pytest.approx(4 / 6)
    assert summary.f1.mean == pytest.approx(8 / 12)
    assert summary.power_w.mean == 8.0
    # A resample of three is all the smallest with probability 1/27 > 2.5 %.
    assert (summary.held["log_mae"].low, summary.held["log_mae"].high) == (1.0, 6.0)


def test_bootstrap_interval_covers_as_often_as_it_says():
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(100):
        values = rng.normal(size=40)
        estimate = estimate_mean(values, resample_sequences(40, rng))
        covered += estimate.low <= 0.0 <= estimate.high
    assert 86 <= covered <= 100


def test_one_sequence_has_an_interval_of_no_width_and_never_a_made_up_number():
    summary = summarise([record(2.0)], resample_sequences(1, np.random.default_rng(0)))
    assert summary.held["rmse"].low == summary.held["rmse"].high == 2.0
    assert np.isnan(summary.produced["rmse"].mean) and np.isnan(summary.f1.low)


def test_summaries_refuse_mixtures():
    resamples = resample_sequences(2, np.random.default_rng(0))
    with pytest.raises(ValueError, match=r"records: found policies \['a', 'b'\]"):
        summarise([record(1.0, policy="a"), record(1.0, policy="b")], resamples)
    with pytest.raises(ValueError, match=r"resamples: found shape \(2000, 2\), expected \(n, 1\)"):
        summarise([record(1.0)], resamples)


def test_pooled_floor_is_the_best_split_of_triggers():
    rng = np.random.default_rng(5)
    floors = [rng.random(n) for n in (3, 1, 4)]
    best = np.full(6, np.inf)
    for counts in itertools.product(*(range(len(floor)) for floor in floors)):
        total = sum(floor[n] for floor, n in zip(floors, counts, strict=True))
        best[sum(counts)] = min(best[sum(counts)], total)
    assert pooled_floor(floors) == pytest.approx(best)


POLICIES = {
    "never": Never,
    "always": Always,
    "periodic:3": lambda: Periodic(3),
    "random:0.4": lambda: RandomTrigger(0.4, 7),
    "keyframe-rule": KeyframeRule,
}


def results(slices=60, seeds=(0, 1, 2)):
    found = []
    for seed in seeds:
        stream = WallStream(slices=slices, speed=6.0 + 4.0 * seed, distance=60.0)
        trace = trace_sequence(stream, Approach(speed=9.0), seed, keep_frames=seed == 0)
        policies = {name: make() for name, make in POLICIES.items()}
        found.append(evaluate_sequence(trace, policies, lambda e, p: oracle_curve(e, p)[1], EnergyModel()))
    return found


def infos():
    return [PolicyInfo(name, name, None, True, True, False) for name in POLICIES]


def test_no_policy_is_below_the_floor():
    comparison = compare({}, infos(), results(), np.random.default_rng(0))
    saved = [estimate.mean for estimate in comparison.saved]
    never, always = (comparison.summaries[i].held["log_mae"].mean for i in (0, 1))
    assert saved[:2] == pytest.approx([0.0, never - always], abs=1e-12)
    assert comparison.saved[0].low == pytest.approx(comparison.saved[0].high, abs=1e-12)
    above = [comparison.above_floor(i) for i in range(len(POLICIES))]
    assert min(above) > -1e-12
    assert max(above) > 1e-4
    assert above[:2] == pytest.approx(
        [0.0, 0.0], abs=1e-12
    )  # there is only one way to do nothing or everything
    assert comparison.floor_rates[[0, -1]] == pytest.approx([10.0, 50.0])


def test_a_sequence_result_survives_its_file(tmp_path):
    (result,) = results(slices=20, seeds=(0,))
    result.save(tmp_path / "0.npz")
    loaded = SequenceResult.load(tmp_path / "0.npz")
    np.testing.assert_equal(
        [vars(r) for r in loaded.records], [vars(r) for r in result.records]
    )  # nan equals nan here
    for name in ("ego_speed", "keyframe", "lidar", "floor", "errors"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(result, name))
    np.testing.assert_array_equal(loaded.frames.produced, result.frames.produced)
    assert loaded.description == result.description


def test_compare_refuses_what_cannot_be_averaged():
    short, long = results(slices=20, seeds=(0,)), results(slices=25, seeds=(1,))
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match=r"sequences of \[20, 25\] slices"):
        compare({}, infos(), short + long, rng)
    with pytest.raises(ValueError, match="found none"):
        compare({}, infos(), [], rng)
    with pytest.raises(ValueError, match=r"expected \['never'\]"):
        compare({}, infos()[:1], short, rng)


def test_frame_rate_curves():
    sequences = results(slices=120)
    always, never = list(POLICIES).index("always"), list(POLICIES).index("never")
    assert rate_over_time(sequences[0], always) == pytest.approx(50.0)
    assert rate_over_time(sequences[0], never)[25:95] == pytest.approx(10.0)
    curve = rate_by_speed(sequences, never)
    assert curve.speed.tolist() == [6.25, 11.25, 13.75]  # speeds 6, 10 and 14 m/s in bins of 2.5
    assert curve.rate == pytest.approx(10.0)
    assert curve.windows.tolist() == [2, 2, 2]
    kinds = rate_by_kind(sequences, always, "scenario")
    assert (kinds.kind, kinds.rate, kinds.sequences) == (("wall",), (50.0,), (3,))
    assert rate_by_kind(sequences, always, "weather").kind == ()  # the streams do not say
