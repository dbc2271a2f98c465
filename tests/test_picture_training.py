"""Supervised training of trigger networks on pictures of the events."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from agents.catalogue import make_policy
from agents.decisions import states
from agents.picture_training import PictureDecisions, train_pictures
from agents.rl_training.validation import Validation
from agents.sb3_vec_env import ReplayVecEnv
from agents.supervised import OBJECTIVES, ValueTraining
from nl_env.batched_replay import BatchedReplayEnv
from nl_env.evaluation import play
from nl_env.trace_files import default_folder, open_traces
from nl_env.weight_files import read_card
from scripts import train_value

SMALL = ValueTraining(steps=6, batch=4, evaluate_every=3, hidden=(8,), cost_low=0.01, cost_high=1.0)


@pytest.fixture(scope="module")
def traces(stored):
    return list(open_traces(default_folder(stored, "warp")).values())


@pytest.fixture(scope="module")
def decisions(traces):
    return PictureDecisions.of(traces)


@pytest.mark.parametrize("mirror", [False, True])
def test_enumerated_decisions_are_what_the_environment_shows(stored, decisions, mirror):
    seeds = sorted(open_traces(default_folder(stored, "warp")))
    env = BatchedReplayEnv(
        2, data=stored, extrapolator="warp", obs_mode="dict", sequences=seeds[:1], autoreset_mode="SameStep"
    )
    shown = ReplayVecEnv(env, mirror=True, pictures=True)
    shown.seed(0)
    observations = shown.reset()
    rng, held = np.random.default_rng(1), [0, 0]
    places = {place: i for i, place in enumerate(states(5))}
    place = int(mirror)  # every second environment is mirrored
    looked_at = 0
    for k in range(1, 15):
        interval, offset = divmod(k, 5)
        if offset == 0:
            held = [0, 0]
        else:
            state = places[offset, held[place]]
            pictures = decisions.shown(np.array([interval]), np.array([mirror]))
            np.testing.assert_array_equal(observations["event_frame"][place], pictures[0, state])
            np.testing.assert_array_equal(observations["state"][place], decisions.state[interval, state])
            looked_at += 1
        actions = rng.integers(2, size=2)
        held = [offset if action and offset else h for action, h in zip(actions, held, strict=True)]
        observations = shown.step(actions)[0]
    assert looked_at == 12


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_every_objective_trains_a_network_that_is_told_the_cost(decisions, traces, objective):
    reports = []
    trained = train_pictures(
        decisions,
        Validation.of(traces),
        replace(SMALL, objective=objective),
        lambda *seen: reports.append(seen),
    )
    assert trained.network.conditioned and trained.network.cost_range == (0.01, 1.0)
    assert [step for step, _, _ in reports] == [3, 6]
    assert trained.best.criterion == min(regret for _, _, regret in reports)
    assert all(np.isfinite(loss) for _, loss, _ in reports)


def test_the_same_seed_gives_the_same_weights_and_another_seed_others(decisions, traces):
    validation = Validation.of(traces)
    first, again, other = (
        train_pictures(decisions, validation, replace(SMALL, seed=seed)).network.state_dict()
        for seed in (0, 0, 1)
    )
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["last.weight"], other["last.weight"])


def test_what_pays_is_learnt(decisions, traces):
    """Frames go stale at once in every second interval, and where that is the picture shows."""
    stale = np.arange(len(decisions.errors)) % 2 == 1
    errors = np.full_like(decisions.errors, np.nan)
    for k in range(5):
        for h in range(k + 1):
            errors[:, k, h] = np.where(stale, 0.05 * (k > h), 0.0)
    pictures = np.where(stale[:, None, None, None, None], 20, 0) * np.ones_like(decisions.pictures)
    lesson = replace(decisions, errors=errors, pictures=pictures.astype(np.int8))
    options = replace(SMALL, objective="clone", steps=60, batch=16, evaluate_every=60, learning_rate=1e-2)
    network = train_pictures(lesson, Validation.of(traces), options).network
    shown = torch.from_numpy(lesson.shown(np.array([0, 1]), np.zeros(2, bool))).flatten(0, 1)
    told = torch.cat([torch.from_numpy(lesson.state[:2]).flatten(0, 1), torch.full((20, 1), 0.5)], dim=1)
    with torch.no_grad():
        margins = network(network.encode(shown), told).view(2, 10)
    assert (margins[0] < 0).all() and (margins[1] > 0).all()


def test_the_command_writes_weights_that_play(stored, traces, tmp_path, capsys):
    tables = str(default_folder(stored, "warp"))
    command = ["--pictures", "--objective", "clone", "--data", tables, "--validation", tables]
    command += ["--steps", "4", "--batch", "4", "--evaluate-every", "2", "--out", str(tmp_path / "out")]
    assert train_value.main(command) == 0
    weights = tmp_path / "out" / "value.safetensors"
    assert "regret" in capsys.readouterr().out
    card = read_card(weights)
    assert card.architecture == "trigger-network" and card.training["objective"] == "clone"
    assert json.dumps(card.data["train"]["sequences"]) == json.dumps([trace.seed for trace in traces])
    record = play(make_policy(f"value-pictures@{weights}:0.05", 0), traces[0], "pictures")
    assert 10 <= record.effective_rate <= 50
    assert train_value.main(command) == 2
    assert "out: found" in capsys.readouterr().err
