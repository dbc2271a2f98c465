import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from analytic_stream import WallStream

from agents.activity import STATISTICS_FIELDS
from agents.catalogue import make_policy, parse_policy
from agents.decisions import Decisions, collect, states
from agents.keyframe_cnn import KeyframeCNN
from agents.keyframe_networks import FrameDetector
from agents.oracle import priced_schedule
from agents.schedules import Scheduler, Scripted
from agents.supervised import OBJECTIVES, ValueTraining
from agents.value_network import ValueNetwork
from agents.value_policy import TriggerValue
from agents.value_training import evaluate, oracle_curve, plan, play_out, train
from nl_env.depth.extrapolators import make_extrapolator
from nl_env.evaluation import play
from nl_env.statistics import slice_statistics
from nl_env.trace_files import write_trace
from nl_env.trace_source import TraceSource
from nl_env.traces import trace_sequence
from nl_env.weight_files import card_path, read_card
from scripts import train_value


@pytest.fixture(scope="module")
def trace():
    return trace_sequence(WallStream(slices=23), make_extrapolator("linear"), 3)


class Watcher:
    """Triggers at given slices and keeps the observations."""

    obs_mode = "statistics"

    def __init__(self, triggers):
        self.triggers = triggers
        self.seen = []

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        k = 1 if state is None else state + 1
        self.seen.append(observation)
        return int(k in self.triggers), k


def test_enumerated_decisions_are_what_a_policy_sees(trace):
    decisions = collect([trace])
    assert decisions.observations.shape == (4, 10, STATISTICS_FIELDS)
    places = {place: i for i, place in enumerate(states(5))}
    watcher = Watcher({2, 3, 6, 8, 14, 16, 17, 19})
    play(watcher, trace, "watcher")
    held = 0
    for k in range(1, 20):
        interval, offset = divmod(k, 5)
        if offset == 0:
            held = 0
            continue
        expected = decisions.observations[interval, places[offset, held]]
        np.testing.assert_array_equal(watcher.seen[k - 1], expected)
        if k in watcher.triggers:
            held = offset


def test_a_mirror_swaps_left_and_right():
    images = np.full((11, 30, 40), 128, np.uint8)
    images[1:, :10, :10] = 140
    plain = made_up(images)
    mirrored = made_up(images[:, :, ::-1].copy())
    np.testing.assert_array_equal(plain.mirrored().observations, mirrored.observations)
    assert (plain.observations != mirrored.observations).any()
    np.testing.assert_array_equal(plain.mirrored().mirrored().observations, plain.observations)


def made_up(images, errors=None):
    """Decisions of a trace by hand."""
    count = len(images)
    return collect(
        [
            SimpleNamespace(
                seed=0,
                lidar_period=5,
                slices=count - 1,
                images=images,
                statistics=slice_statistics(images),
                event_count=np.count_nonzero(images != 128, axis=(1, 2)),
                errors={"log_mae": np.zeros((count, 5)) if errors is None else errors},
            )
        ]
    )


def random_errors(count, seed=0):
    """Errors ``(n, 5, 5)`` that grow with the age of the held frame."""
    rng = np.random.default_rng(seed)
    errors = np.full((count, 5, 5), np.nan)
    for k in range(5):
        for h in range(k + 1):
            errors[:, k, h] = 0.01 * rng.random(count) + 0.01 * (k - h) * rng.random(count)
    return errors


@pytest.mark.parametrize("price", [0.0, 0.004, 0.02])
def test_planning_finds_the_optimal_oracles_schedule(price):
    errors = random_errors(30)
    hold, trigger = plan(
        torch.from_numpy(np.nan_to_num(errors)), torch.full((30,), price, dtype=torch.float64)
    )
    total, count = play_out(errors, (trigger < hold).numpy())
    table = np.full((150, 5), np.nan)
    for k in range(5):
        for h in range(k + 1):
            table[k::5, k - h] = errors[:, k, h]
    best = priced_schedule(table, 5, price)
    assert count.sum() == best.sum()
    first = torch.minimum(hold[:, 0], trigger[:, 0]).numpy()
    assert total + price * count == pytest.approx(first)


def test_a_plan_with_probabilities_is_the_expectation():
    errors = random_errors(1)
    probabilities = torch.rand((1, 10), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    price = torch.tensor([0.003], dtype=torch.float64)
    hold, trigger = plan(torch.from_numpy(np.nan_to_num(errors)), price, probabilities)
    expected = hold[:, 0] + probabilities[:, 0] * (trigger[:, 0] - hold[:, 0])
    rng, draws = np.random.default_rng(0), 20_000
    chosen = rng.random((draws, 10)) < probabilities.numpy()
    total, count = play_out(np.repeat(errors, draws, axis=0), chosen)
    assert np.mean(total + 0.003 * count) == pytest.approx(float(expected), rel=0.01)


def activity_decides(count, seed):
    """Decisions in which one number of the observation says whether errors grow at all in the interval."""
    rng = np.random.default_rng(seed)
    moving = rng.random(count) < 0.5
    errors = np.full((count, 5, 5), np.nan)
    for k in range(5):
        for h in range(k + 1):
            errors[:, k, h] = 0.005 + np.where(moving, 0.01 * (k - h), 0.0)
    observations = rng.random((count, 10, STATISTICS_FIELDS)).astype(np.float32)
    observations[:, :, 0], observations[:, :, 1] = np.array([(k / 5, (k - h) / 5) for k, h in states(5)]).T
    observations[:, :, 20] = np.where(moving, 0.8, 0.2)[:, None] + 0.05 * rng.standard_normal((count, 10))
    return Decisions(observations, errors, np.zeros(count, np.int64))


@pytest.fixture(scope="module")
def learnable():
    return activity_decides(400, 0), activity_decides(200, 1)


def short(objective):
    return ValueTraining(
        objective=objective, hidden=(16,), steps=300, batch=64, learning_rate=1e-2, evaluate_every=50
    )


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_every_objective_learns_when_to_trigger(objective, learnable):
    data, validation = learnable
    trained = train(data, validation, short(objective))
    blind = train(data, validation, ValueTraining(objective=objective, hidden=(16,), steps=1, batch=8))
    assert trained.best.excess < 0.5 * blind.best.excess
    again = evaluate(trained.network, validation, oracle_curve(validation), 0)
    assert again.excess == pytest.approx(trained.best.excess)  # the best evaluation's weights are kept


def test_same_seed_same_weights(learnable):
    data, validation = learnable
    options = [ValueTraining(hidden=(8,), steps=20, batch=16, seed=seed, dropout=0.2) for seed in (4, 4, 5)]
    first, second, other = (train(data, validation, o).network.state_dict() for o in options)
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert any(not torch.equal(first[name], other[name]) for name in first)


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tables")
    source = TraceSource("0" * 64, "linear", "", False, 10, 0, 1.0)
    for seed in (7, 8):
        write_trace(
            folder / f"{seed}.safetensors",
            trace_sequence(WallStream(slices=23), make_extrapolator("linear"), seed),
            source,
        )
    return folder


def command(tables, out, *more):
    return [
        *("--data", str(tables), "--validation", str(tables), "--out", str(out)),
        *("--steps", "20", "--batch", "4", "--hidden", "8", "--evaluate-every", "10"),
        *more,
    ]


@pytest.fixture(scope="module")
def weights(tables, tmp_path_factory):
    out = tmp_path_factory.mktemp("value")
    for objective in ("planned", "reduction"):
        assert train_value.main(command(tables, out / objective, "--objective", objective)) == 0
    return out


def test_the_script_writes_weights_that_load_and_a_card_that_tells(weights, trace):
    path = weights / "planned" / "value.safetensors"
    card = read_card(path)
    assert card.data["train"]["sequences"] == [7, 8]
    assert card.training["command"].startswith("python scripts/train_value.py --data")
    assert len(card.metrics["history"]) == 2
    for cost in (0.002, 0.1, 2.0):
        policy = make_policy(f"value-planned@{path}:{cost}", seed=0)
        assert policy.trigger_cost == cost
        record = play(policy, trace, "planned")
        assert not [k for k in record.triggers if k % 5 == 0]
    assert parse_policy(f"value-planned@{path}") == ("value-planned", 0.1, str(path))


def test_numpy_gives_what_the_network_gives():
    torch.manual_seed(0)
    network = ValueNetwork(True, (16, 8), cost_range=(1e-3, 1.0)).eval()
    network.mean.uniform_()
    network.scale.uniform_(0.5, 3)
    seen = np.random.default_rng(0).random((5, STATISTICS_FIELDS + 1), dtype=np.float32)
    with torch.inference_mode():
        expected = network(torch.from_numpy(seen)).numpy()
    policy = TriggerValue(network, 0.1)
    assert policy.score(seen) == pytest.approx(expected, abs=1e-5)
    seen[0, 0] = 0.0  # a LiDAR frame arrives
    actions, _ = policy.predict(seen)
    assert actions.tolist() == [0, *(expected[1:] > 0).astype(int)]
    single, _ = policy.predict(seen[1])
    assert single == actions[1]


def test_bad_parameters_weights_and_observations_are_refused(weights, tmp_path):
    planned, reduction = (weights / name / "value.safetensors" for name in ("planned", "reduction"))
    with pytest.raises(ValueError, match=r"trigger_cost: found 50\.0"):
        TriggerValue.load(planned, 50.0)
    with pytest.raises(ValueError, match="threshold: found -1"):
        TriggerValue.load(reduction, -1)
    with pytest.raises(FileNotFoundError, match=r"train_value\.py makes one"):
        TriggerValue.load(tmp_path / "nothing.safetensors")
    with pytest.raises(ValueError, match="the trigger cost included"):
        TriggerValue.load(planned).predict(np.zeros(STATISTICS_FIELDS, np.float32))
    with pytest.raises(ValueError, match='obs_mode "statistics"'):
        TriggerValue.load(planned).predict(np.zeros((1, 120, 160), np.uint8))
    other = tmp_path / "other.safetensors"
    other.write_bytes(reduction.read_bytes())
    card = json.loads(card_path(planned).read_text())
    card["sha256"] = read_card(reduction).sha256
    card_path(other).write_text(json.dumps(card))
    with pytest.raises(ValueError, match=r"other\.safetensors' does not fit ValueNetwork"):
        TriggerValue.load(other)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--objective", "guess"], "objective: found 'guess'"),
        (["--steps", "0"], "steps: found 0"),
        (["--cost-low", "5"], "cost_low: found 5.0"),
        (["--sequences", "0"], "sequences: found 0"),
        (["--data", "nowhere"], "nowhere"),
    ],
)
def test_bad_options_are_refused(tables, tmp_path, capsys, arguments, message):
    assert train_value.main([*command(tables, tmp_path / "out"), *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_training_is_not_overwritten_unasked(weights, tables, capsys):
    before = (weights / "planned" / "value.safetensors").read_bytes()
    assert train_value.main(command(tables, weights / "planned")) == 2
    assert "overwrite" in capsys.readouterr().err
    assert train_value.main(command(tables, weights / "planned", "--overwrite")) == 0
    assert (weights / "planned" / "value.safetensors").read_bytes() == before  # the same training


def test_decisions_of_different_lidars_are_not_mixed(trace):
    other = trace_sequence(WallStream(slices=23, lidar_period=10), make_extrapolator("linear"), 3)
    with pytest.raises(ValueError, match=r"LiDAR periods \[5, 10\]"):
        collect([trace, other])


def test_a_schedule_at_once_is_the_one_of_single_predictions(weights, trace):
    long = trace_sequence(WallStream(slices=50, distance=60.0), make_extrapolator("linear"), 3)
    path = weights / "planned" / "value.safetensors"
    names = ["accumulated:0.2", "accumulated-weighted:0.1", "keyframe-rule", "periodic:3"]
    names += [f"value-planned@{path}:{cost}" for cost in (0.001, 0.03, 1.0)]
    names += [f"value-reduction@{weights / 'reduction' / 'value.safetensors'}:0.001"]
    scheduler, scripted = Scheduler(long), 0
    for name in names:
        policy = make_policy(name, seed=0)
        at_once = scheduler.scripted(policy)
        scripted += isinstance(at_once, Scripted)
        assert play(at_once, long, name).triggers == play(policy, long, name).triggers
    assert scripted == 6
    assert Scheduler(trace).scripted(make_policy("accumulated:0.2", 0)).obs_mode == "statistics"  # 23 slices


def test_a_detector_scores_a_sequence_at_once():
    network = FrameDetector(48, 64, pool=1).eval()
    long = trace_sequence(WallStream(slices=20), make_extrapolator("repeat"), 3)
    scores = KeyframeCNN(network).score_sequence(long.images[1:].astype(np.int16) - 128)
    policy = KeyframeCNN(network, float(np.median(scores)) + 1e-6)
    at_once = Scheduler(long).scripted(policy)
    assert isinstance(at_once, Scripted)
    assert play(at_once, long, "detector").triggers == play(policy, long, "detector").triggers
