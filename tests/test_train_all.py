import json
import time
from types import SimpleNamespace

import pytest
import torch

from nl_env.steps import Runner, Step
from nl_env.weight_files import Card, read_card, read_tensors, write_weights
from scripts import (
    frontier,
    precompute,
    record,
    reproduce,
    ship,
    train_all,
    train_extrapolator,
    train_keyframe,
    train_rl,
    train_value,
)
from scripts.ship import POLICIES
from scripts.train_all import ABLATIONS, NETWORKS, STAGES, Options, Plan


@pytest.fixture
def plan(tmp_path):
    return Plan(Options(out=tmp_path / "runs", weights=tmp_path / "weights", seeds=2))


def write_trained(plan, figure=0.1):
    """Weights of every network and the tables that measured them."""
    for network in NETWORKS:
        for seed in range(plan.options.seeds):
            path = plan.trained(network, seed)
            path.parent.mkdir(parents=True, exist_ok=True)
            command = f"train --out {train_all.ROOT}/runs/x"
            card = Card(network.name, "a", training={"command": command}, metrics={"validation": seed})
            write_weights(path, {"x": torch.full((3,), float(seed))}, card)
    mean = {"log_mae": {"mean": figure}}
    write_table(plan, "table-rates", {"ours": {"mean": mean}, "paper's network": {"mean": mean}})
    rows = {name: {"f1": {"mean": figure}} for name in ("keyframe-cnn", "keyframe-cnn-temporal")}
    write_table(plan, "table-keyframe", {"splits": {"test": {"rows": rows}}})


def write_table(plan, name, figures):
    plan.results(name).parent.mkdir(parents=True, exist_ok=True)
    plan.results(name).write_text(json.dumps({"command": "python x", "figures": figures}))


def test_every_seed_of_every_network_is_trained_into_the_folder_that_the_tables_read(plan):
    steps = [step for stage in ("pairs", "train") for step in plan.steps(stage)]
    trained = {step.command[step.command.index("--out") + 1] for step in steps if "--out" in step.command}
    assert trained == {str(plan.trained(n, seed).parent) for n in NETWORKS for seed in (0, 1)}
    read = {part for step in plan.steps("tables") for part in step.command if part.endswith(".safetensors")}
    assert read == {str(plan.trained(n, seed)) for n in NETWORKS for seed in (0, 1)}
    assert {step.name for step in plan.steps("tables")} == {network.table for network in NETWORKS} | {
        "table-weather",
        "table-end-to-end",
    }


def test_ablations_are_trained_and_measured_on_request(tmp_path):
    plan = Plan(Options(out=tmp_path, stages=("ablations", "tables")))
    assert len(plan.steps("ablations")) == len(ABLATIONS)
    table = next(step for step in plan.steps("tables") if step.name == "table-ablation")
    for step in plan.steps("ablations"):
        folder = step.command[step.command.index("--out") + 1]
        assert f"{folder}/extrapolator.safetensors" in table.command


def after(command, option):
    return command[command.index(option) + 1]


def test_every_policy_is_trained_on_the_stored_traces_and_takes_part_in_the_frontier(plan):
    stored = {
        after(step.command, "--data"): after(step.command, "--out") for step in plan.steps("precompute")
    }
    assert set(stored) == {str(folder) for folder in plan.data.values()}
    trained = set()
    for step in plan.steps("policies"):
        command = step.command
        if "--data" in command:
            assert after(command, "--data") == stored[str(plan.data["train"])]
            assert after(command, "--validation") == stored[str(plan.data["val"])]
        else:
            assert after(command, "--recordings") == str(plan.data["train"])
            assert (
                str(train_rl.default_folder(plan.data["train"], after(command, "--extrapolator")))
                in stored.values()
            )
        trained.add(after(command, "--out"))
    (step,) = plan.steps("frontier")
    assert after(step.command, "--data") == stored[str(plan.data["test"])]
    taking_part = {part.partition("@")[2].rpartition(":")[0] for part in step.command if "@" in part}
    wanted = {policy.weights(plan.options.out, seed) for policy in POLICIES for seed in (0, 1)}
    assert taking_part == {str(path) for path in wanted}
    assert trained == {str(path.parent) for path in wanted}


def test_every_planned_command_is_understood_by_its_script(tmp_path, monkeypatch):
    """Parsed by the scripts themselves, with the work replaced."""
    done = []

    def work(*arguments):
        done.append(arguments)
        return SimpleNamespace(
            metrics={"at_thresholds": {}, "validation": {}}, training={"steps": 1, "steps_in_all": 1}
        )

    for module in (record, train_keyframe, precompute, train_value, train_rl, frontier):
        monkeypatch.setattr(module, "run", work)
    for command in ("PairsCommand", "Ours", "Paper"):
        monkeypatch.setattr(getattr(train_extrapolator, command), "run", work)
    for table in ("TableKeyframe", "TableWeather", "TableRates", "TableAblation", "TableEndToEnd"):
        monkeypatch.setattr(getattr(reproduce, table), "run", work)
    scripts = {
        f"scripts/{module.__name__.split('.')[-1]}.py": module
        for module in (
            *(record, train_extrapolator, train_keyframe, reproduce),
            *(precompute, train_value, train_rl, frontier),
        )
    }
    plan = Plan(Options(out=tmp_path, stages=STAGES, seeds=1, device="cpu"))
    steps = [step for stage in STAGES for step in plan.steps(stage)]
    for step in steps:
        assert scripts[step.command[0]].main(step.command[1:]) == 0, step
    assert len(done) == len(steps)


def test_finished_steps_are_not_repeated_and_changed_ones_are(tmp_path):
    code = f"open({str(tmp_path / 'count')!r}, 'a').write('x')"
    runner = Runner(tmp_path / "steps", tmp_path)
    step = Step("count", ("-c", code))
    for _ in range(2):
        runner.run([step], 1)
    assert (tmp_path / "count").read_text() == "x"
    runner.run([Step("count", ("-c", code, "more"))], 1)
    assert (tmp_path / "count").read_text() == "xx"


def test_a_failed_step_is_named_and_done_again(tmp_path):
    runner = Runner(tmp_path / "steps", tmp_path)
    good, bad = Step("good", ("-c", "print('fine')")), Step("bad", ("-c", "raise SystemExit(3)"))
    with pytest.raises(RuntimeError, match="failed: bad"):
        runner.run([bad, good], 2)
    assert runner.finished(good) and not runner.finished(bad)
    assert (tmp_path / "steps" / "good.log").read_text() == "fine\n"


def test_an_interrupt_starts_nothing_more(tmp_path, monkeypatch):
    started = []

    def interrupted(runner, step):
        started.append(step.name)
        if step.name == "one":
            raise KeyboardInterrupt
        time.sleep(0.5)  # already under way when the interrupt arrives
        return True

    monkeypatch.setattr(Runner, "_run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        Runner(tmp_path, tmp_path).run([Step("one", ()), Step("two", ()), Step("three", ())], 1)
    assert started[0] == "one" and "three" not in started


def test_the_first_seed_is_shipped_with_what_was_measured(plan):
    write_trained(plan)
    train_all.ship(plan)
    for network in NETWORKS:
        path = plan.options.weights / f"{network.name}.safetensors"
        assert read_tensors(path)["x"].tolist() == [0.0] * 3
        card = read_card(path)
        assert card.metrics["validation"] == 0
        assert card.training["command"] == "train --out runs/x"
        (found,) = card.metrics["test"]["figures"].values()
        assert found == {"mean": 0.1}


def test_nothing_too_large_or_unmeasured_is_shipped(plan, monkeypatch):
    write_trained(plan)
    monkeypatch.setattr(ship, "MAX_BYTES", 50)
    with pytest.raises(ValueError, match=r"unet-0.*expected at most 50"):
        train_all.ship(plan)
    monkeypatch.undo()
    plan.results("table-keyframe").unlink()
    with pytest.raises(FileNotFoundError, match="table-keyframe"):
        train_all.ship(plan)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--stages", "cook"], "stages: found 'cook'"),
        (["--seeds", "0"], "seeds: found 0"),
        (["--device", "tpu"], "device: found 'tpu'"),
    ],
)
def test_bad_options_are_refused_before_any_work(tmp_path, capsys, arguments, message):
    assert train_all.main([*arguments, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
