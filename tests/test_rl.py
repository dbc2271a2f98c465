"""Networks of reinforcement-trained policies, the shipped form of the policies, and playing many at once."""

import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from stable_baselines3 import DQN, PPO

from agents.rl import StatisticsTrigger, cost_for_rate, load_trigger
from agents.rl_networks import TriggerNetwork
from agents.rl_training.hyperparameters import FOLDER, read_hyperparameters
from agents.rl_training.models import decider, make_model, split, standardise
from agents.rl_training.validation import Validation, play_schedules, play_together
from agents.rules import Always, Evenly, Never, Periodic
from agents.sb3_vec_env import ReplayVecEnv
from nl_env.batched_replay import BatchedReplayEnv
from nl_env.evaluation import play
from nl_env.trace_files import default_folder, open_traces
from nl_env.weight_files import Card, write_weights

SMALL = {
    "statistics": {"hidden": [6, 5]},
    "dict": {"hidden": [6], "height": 120, "width": 160},
    "image": {"hidden": [6], "height": 120, "width": 160},
}
COSTS = (0.01, 1.0)


def network(mode, conditioned=True, seed=0, **changes):
    torch.manual_seed(seed)
    conditioned = conditioned and mode != "image"
    cost_range = COSTS if conditioned else ()
    return TriggerNetwork(mode, conditioned, cost_range=cost_range, **{**SMALL[mode], **changes}).eval()


def balanced(made, traces, costs=None):
    """``made`` with a last bias that makes it trigger here and there."""
    with torch.no_grad():
        made.encoder.scale.fill_(5.0)
        low, high = -64.0, 64.0
        for _ in range(20):
            middle = (low + high) / 2
            made.last.bias.fill_(middle)
            often = play_together(made, traces, costs).rate.mean() > 30
            low, high = (low, middle) if often else (middle, high)
    return made


def save(made, path, **changes):
    card = Card(what="test", architecture="trigger-network", options=made.options, **changes)
    write_weights(path, made.state_dict(), card)
    return path


@pytest.fixture(scope="module")
def traces(stored):
    return list(open_traces(default_folder(stored, "warp")).values())


@pytest.fixture
def environment(stored):
    def make(numbers, envs=2):
        env = BatchedReplayEnv(
            envs,
            data=stored,
            extrapolator="warp",
            obs_mode=numbers.obs_mode,
            trigger_cost=numbers.trigger_cost,
            autoreset_mode=AutoresetMode.SAME_STEP,
        )
        return ReplayVecEnv(env, end_at_lidar=True, pictures=numbers.obs_mode != "statistics")

    return make


@pytest.mark.parametrize(
    "name", ["ppo-statistics", "dqn-statistics", "qrdqn-statistics", "ppo-dict", "ppo-image"]
)
def test_the_decider_does_what_the_trained_model_does(name, environment):
    numbers = read_hyperparameters(FOLDER / f"{name}.yml")
    env = environment(numbers)
    model = make_model(name.split("-")[0], numbers, env, seed=1)
    env.seed(0)
    observations = [env.reset()]
    rng = np.random.default_rng(0)
    for _ in range(12):
        observations.append(env.step(rng.integers(2, size=2))[0])
    standardise(model, observations[-1])
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape))
    made = decider(model, numbers)
    for seen in observations:
        images, vector = split(seen)
        with torch.no_grad():
            encoded = None if images is None else made.encode(torch.from_numpy(images))
            margins = made(encoded, None if vector is None else torch.from_numpy(vector))
            values = preferences(model, model.policy.obs_to_tensor(seen)[0])
        torch.testing.assert_close(margins, values[:, 1] - values[:, 0], atol=1e-4, rtol=1e-4)
        np.testing.assert_array_equal((margins > 0).numpy(), model.predict(seen, deterministic=True)[0])
    assert margins.std() > 0.01
    env.close()


def preferences(model, seen):
    """``(n, 2)`` logits or values of both actions, as the model has them."""
    if isinstance(model, PPO):
        return model.policy.get_distribution(seen).distribution.logits
    return model.q_net(seen) if isinstance(model, DQN) else model.quantile_net(seen).mean(dim=1)


def test_standardised_numbers_have_mean_0_and_deviation_1(environment):
    numbers = read_hyperparameters(FOLDER / "ppo-statistics.yml")
    model = make_model("ppo", numbers, environment(numbers), seed=0)
    sample = np.random.default_rng(0).uniform(0.2, 0.7, (500, 101)).astype(np.float32)
    standardise(model, sample)
    seen = model.policy.pi_features_extractor(torch.from_numpy(sample))
    torch.testing.assert_close(seen.mean(dim=0), torch.zeros(101), atol=1e-4, rtol=0)
    torch.testing.assert_close(seen.std(dim=0), torch.ones(101), atol=1e-3, rtol=0)


@pytest.mark.parametrize("mode", SMALL)
def test_playing_together_equals_playing_one_by_one(mode, traces, tmp_path):
    made = network(mode)
    costs = [0.01, 0.2, 1.0] if made.conditioned else None
    path = save(balanced(made, traces, costs), tmp_path / "policy.safetensors")
    points = play_together(made, traces, costs)
    for i, cost in enumerate(costs or [None]):
        policy = load_trigger(path, trigger_cost=cost)
        for j, trace in enumerate(traces):
            record = play(policy, trace, "rl")
            assert record.effective_rate == pytest.approx(points.rate[i, j])
            assert record.held["log_mae"] == pytest.approx(points.error[i, j], rel=1e-12)
    assert 10 < points.rate.mean() < 50


def test_biases_make_a_network_trigger_more_or_less(traces):
    made = balanced(network("statistics", conditioned=False), traces)
    points = play_together(made, traces, biases=[-1e3, 0.0, 1e3])
    assert points.rate[0] == pytest.approx(10.0) and points.rate[2] == pytest.approx(50.0)
    assert 10 < points.rate[1].mean() < 50


def test_schedules_are_played_as_policies_are(traces):
    policies = [Never(), Always(), Periodic(2), Evenly(30)]
    points = play_schedules(policies, traces)
    for i, policy in enumerate(policies):
        for j, trace in enumerate(traces):
            record = play(policy, trace, "schedule")
            assert record.effective_rate == pytest.approx(points.rate[i, j])
            assert record.held["log_mae"] == pytest.approx(points.error[i, j], rel=1e-12)


def test_regret_is_1_for_regular_schedules_and_lower_for_better_ones(traces):
    validation = Validation.of(traces)
    regular = play_schedules(
        [*map(Periodic, (1, 2, 3, 4, 6, 8)), *map(Evenly, (15, 20, 25, 30, 35, 40, 45))], traces
    )
    assert validation.regret(regular) == pytest.approx(1.0)
    assert validation.floor < validation.periodic
    assert validation.regret(play_schedules([Never()], traces)) > 1.0


def test_validation_needs_sequences_of_one_length(traces):
    with pytest.raises(ValueError, match="expected one for all"):
        Validation.of([])


def test_a_policy_answers_single_observations_and_batches_alike(tmp_path):
    made = network("statistics")
    with torch.no_grad():
        made.last.bias.zero_()
        made.last.weight.mul_(10)
    policy = load_trigger(save(made, tmp_path / "p.safetensors"), trigger_cost=0.3)
    assert isinstance(policy, StatisticsTrigger)
    batch = np.random.default_rng(0).normal(size=(40, 101)).astype(np.float32)
    actions, _ = policy.predict(batch)
    assert actions.tolist() == [int(policy.predict(row)[0]) for row in batch]
    with torch.no_grad():
        margins = made(None, torch.from_numpy(batch)).numpy()
    np.testing.assert_allclose(policy.margin(batch), margins, atol=1e-5)
    assert 0 < actions.mean() < 1


def test_costs_and_rates_out_of_range_are_refused(tmp_path):
    curve = {"trigger_cost": [0.01, 0.1, 1.0], "rate_hz": [46.0, 30.0, 14.0], "log_mae": [0.1, 0.2, 0.3]}
    path = save(network("statistics"), tmp_path / "p.safetensors", metrics={"validation": {"curve": curve}})
    assert load_trigger(path).trigger_cost == 0.1
    assert load_trigger(path, rate_hz=30.0).trigger_cost == pytest.approx(0.1)
    assert load_trigger(path, rate_hz=22.0).trigger_cost == pytest.approx(np.sqrt(0.1))
    for cost in (0.005, 1.5, float("nan")):
        with pytest.raises(ValueError, match="trigger_cost: found"):
            load_trigger(path, trigger_cost=cost)
    for rate in (13.0, 47.0):
        with pytest.raises(ValueError, match=r"rate_hz: found .*, expected 14 to 46"):
            load_trigger(path, rate_hz=rate)
    with pytest.raises(ValueError, match="at most one"):
        load_trigger(path, trigger_cost=0.1, rate_hz=30.0)
    with pytest.raises(ValueError, match="found no validation curve"):
        cost_for_rate(Card("test", "trigger-network"), 30.0, path)


def test_a_policy_of_one_cost_takes_neither(tmp_path):
    path = save(network("statistics", conditioned=False), tmp_path / "p.safetensors")
    assert load_trigger(path).trigger_cost is None
    for arguments in ({"trigger_cost": 0.1}, {"rate_hz": 30.0}):
        with pytest.raises(ValueError, match="trained for one trigger cost"):
            load_trigger(path, **arguments)


def test_files_that_do_not_fit_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.safetensors"):
        load_trigger(tmp_path / "none.safetensors")
    made, path = network("statistics"), tmp_path / "p.safetensors"
    card = Card(what="test", architecture="trigger-network", options=made.options)
    tensors = made.state_dict()
    write_weights(path, {name: tensor for name, tensor in tensors.items() if name != "last.bias"}, card)
    with pytest.raises(ValueError, match=r"p\.safetensors.*missing: last\.bias"):
        load_trigger(path)
    write_weights(path, {**tensors, "extra": torch.zeros(1)}, card)
    with pytest.raises(ValueError, match=r"p\.safetensors.*unexpected: extra"):
        load_trigger(path)
    for options in ({**made.options, "obs_mode": "sound"}, {**made.options, "cost_range": []}):
        write_weights(path, tensors, Card(what="test", architecture="trigger-network", options=options))
        with pytest.raises(ValueError, match=r"options .*p\.safetensors"):
            load_trigger(path)


def test_observations_of_another_mode_or_resolution_are_refused(tmp_path):
    image = np.full((1, 120, 160), 128, np.uint8)
    told = load_trigger(save(network("statistics"), tmp_path / "s.safetensors"))
    for wrong in (image, np.zeros(100, np.float32), np.zeros(101)):
        with pytest.raises(ValueError, match=r"observation: found .*statistics"):
            told.predict(wrong)
    state = np.zeros(4, np.float32)
    seeing = load_trigger(save(network("dict"), tmp_path / "d.safetensors"))
    for wrong in (image, {"event_frame": image, "state": state}):
        with pytest.raises(ValueError, match=r"observation: found .*trigger_cost"):
            seeing.predict(wrong)
    plain = load_trigger(save(network("image"), tmp_path / "i.safetensors"))
    with pytest.raises(ValueError, match="found event frames of 240x320, expected 120x160"):
        plain.predict(np.full((1, 240, 320), 128, np.uint8))


def test_networks_refuse_what_they_cannot_be():
    with pytest.raises(ValueError, match="obs_mode 'image'"):
        TriggerNetwork("image", True, [4], height=120, width=160, cost_range=COSTS)
    with pytest.raises(ValueError, match="hidden"):
        TriggerNetwork("statistics", False, [])
    with pytest.raises(ValueError, match="activation"):
        TriggerNetwork("statistics", False, [4], activation="gelu")
    with pytest.raises(ValueError, match="multiples of 4 of at least 32 pixels"):
        TriggerNetwork("image", False, [4], height=16, width=160)
    with pytest.raises(ValueError, match="shows no image"):
        network("statistics").encode(torch.zeros(1, 2, 30, 40))
