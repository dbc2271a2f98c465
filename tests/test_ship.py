"""Shipping trigger policies: the best seed, with the frontier's figures, and nothing stale."""

import json

import pytest
import torch

from nl_env.trace_source import file_digest
from nl_env.weight_files import Card, read_card, read_tensors, write_weights
from scripts import ship
from scripts.ship import POLICIES, Options, best_of, frontier_figures, ship_policies

INTERVAL = {"mean": 0.3, "low": 0.2, "high": 0.4}
POINT = {"rate": 20.0, "error": {"mean": 0.02, "low": 0.01, "high": 0.03}, "saved": INTERVAL}
CRITERIA = (0.3, 0.1, 0.2)
"""Of seeds 0, 1 and 2."""


def metrics(policy, number):
    """``number`` where the card of a training has what it is chosen by."""
    for name in reversed(policy.criterion):
        number = {name: number}
    return number


def draw_frontier(options):
    """Results and settings as ``scripts/frontier.py`` leaves them."""
    trained = {p: [p.weights(options.runs, seed) for seed in range(options.seeds)] for p in POLICIES}
    names = [f"{policy.family}@{path}:0.3" for policy, paths in trained.items() for path in paths]
    curve = {"runs": 3, "regret": INTERVAL, "regret_low": 0.28, "regret_high": 0.31, "matched": [POINT]}
    results = {
        "settings": {
            "policies": names,
            "every": 2,
            "seed": 0,
            "sequences": None,
            "data": "test-tables-unet",
        },
        "deciding_metric": "log_mae",
        "sequences": [{"seed": 1}, {"seed": 2}],
        "frontier": [{"family": policy.family, **curve} for policy in POLICIES],
    }
    digests = {str(path): file_digest(path) for paths in trained.values() for path in paths}
    options.frontier.mkdir(parents=True, exist_ok=True)
    (options.frontier / "results.json").write_text(json.dumps(results))
    (options.frontier / "settings.json").write_text(json.dumps({"weights": digests}))
    return results


@pytest.fixture
def options(tmp_path):
    """Three trainings of every policy, and their frontier."""
    options = Options(tmp_path / "runs", tmp_path / "frontier", tmp_path / "weights")
    for policy in POLICIES:
        for seed, criterion in enumerate(CRITERIA):
            path = policy.weights(options.runs, seed)
            path.parent.mkdir(parents=True)
            command = f"python x --out {ship.ROOT}/runs/x"
            card = Card("x", "a", training={"command": command}, metrics=metrics(policy, criterion))
            write_weights(path, {"x": torch.full((3,), float(seed))}, card)
    draw_frontier(options)
    return options


def test_the_best_seed_on_validation_is_shipped_with_the_figures_of_the_frontier(options):
    paths = ship_policies(options)
    assert [path.stem for path in paths] == [policy.family for policy in POLICIES]
    for policy, path in zip(POLICIES, paths, strict=True):
        assert read_tensors(path)["x"].tolist() == [1.0] * 3
        card = read_card(path)
        assert card.training["command"] == "python x --out runs/x"
        test = card.metrics.pop("test")
        assert card.metrics == metrics(policy, 0.1)
        assert test["figures"]["regret"] == INTERVAL and test["figures"]["runs"] == 3
        assert test["figures"]["matched"] == [{"rate": 20.0, "log_mae": POINT["error"]}]
        assert f"{policy.family}@{policy.weights(options.runs, 2)}:0.3" in test["command"]
        assert "2 sequences" in test["note"]


def test_a_single_family_can_be_shipped(options, capsys):
    arguments = ["--runs", str(options.runs), "--frontier", str(options.frontier), "--families", "rl"]
    assert ship.main([*arguments, "--weights", str(options.weights)]) == 0
    assert [path.name for path in options.weights.iterdir() if path.suffix != ".json"] == ["rl.safetensors"]
    assert "rl-qrdqn-statistics-1" in capsys.readouterr().out


def test_nothing_is_shipped_unless_all_can_be(options):
    policy = POLICIES[-1]
    path = policy.weights(options.runs, 2)
    write_weights(path, {"x": torch.zeros(3)}, read_card(path))
    with pytest.raises(ValueError, match=r"rl-qrdqn-statistics-2.* changed after .*frontier"):
        ship_policies(options)
    draw_frontier(options)
    path.unlink()
    with pytest.raises(FileNotFoundError, match=r"found no file .*rl-qrdqn-statistics-2"):
        ship_policies(options)
    assert not options.weights.exists()


def test_every_seed_must_have_been_measured(options):
    policy = POLICIES[0]
    source, further = policy.weights(options.runs, 2), policy.weights(options.runs, 3)
    further.parent.mkdir()
    write_weights(further, read_tensors(source), read_card(source))
    with pytest.raises(ValueError, match=r"found no .*value-reduction-3.*expected all seeds"):
        ship_policies(Options(options.runs, options.frontier, options.weights, 4, (policy.family,)))


def test_cards_and_results_without_the_numbers_are_refused(options):
    path = POLICIES[0].weights(options.runs, 0)
    with pytest.raises(ValueError, match=r"found None for validation\.regret beside .*value-reduction-0"):
        best_of([path], ("validation", "regret"))
    results = draw_frontier(options)
    with pytest.raises(ValueError, match="found no curve of 'value-dreamt'"):
        frontier_figures(results, "value-dreamt")
    with pytest.raises(ValueError, match="found no curve of 'rl'"):
        frontier_figures({**results, "frontier": None}, "rl")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--families", "oracle"], "families: found 'oracle'"),
        (["--seeds", "0"], "seeds: found 0"),
        (["--frontier", "nowhere"], "nowhere"),
    ],
)
def test_bad_options_are_named(options, capsys, arguments, message):
    assert ship.main([*arguments, "--runs", str(options.runs), "--weights", str(options.weights)]) == 2
    assert message in capsys.readouterr().err
