"""Training by reinforcement: files of numbers, curves that repeat, checkpoints, constraints, bad input."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from gymnasium.vector import AutoresetMode

from agents.rl import load_trigger
from agents.rl_networks import ARCHITECTURES
from agents.rl_training import training
from agents.rl_training.constraint import RateConstraint
from agents.rl_training.hyperparameters import ENV_ID, FOLDER, read_hyperparameters, scheduled
from agents.rl_training.models import make_model
from agents.rl_training.training import LAST, Options, train
from agents.rl_training.validation import Validation, play_together
from agents.sb3_vec_env import ReplayVecEnv
from nl_env.batched_replay import BatchedReplayEnv
from nl_env.trace_files import default_folder, open_traces
from nl_env.training.log import LOG_FILE
from nl_env.training.run import BEST
from nl_env.weight_files import Card, load_network, read_card
from scripts import train_rl

CARD = Card(what="test", architecture="trigger-network", data={"sequences": 2})
SMALL_PPO = {"n_steps": 5, "batch_size": 10, "n_epochs": 1, "learning_rate": "lin_1e-2"}
SMALL_DQN = {"learning_starts": 8, "batch_size": 8, "buffer_size": 60, "target_update_interval": 12}


@pytest.fixture(scope="module")
def validation(stored):
    return Validation.of(list(open_traces(default_folder(stored, "warp")).values()))


@pytest.fixture
def learn(stored, validation, tmp_path, monkeypatch):
    """Trains for a few steps in ``tmp_path / name`` and returns that folder."""
    monkeypatch.setattr(training, "LOG_EVERY", 20)

    def environment(numbers):
        env = BatchedReplayEnv(
            numbers.envs,
            data=stored,
            extrapolator="warp",
            obs_mode=numbers.obs_mode,
            trigger_cost=numbers.trigger_cost,
            autoreset_mode=AutoresetMode.SAME_STEP,
        )
        pictures = numbers.obs_mode != "statistics"
        return ReplayVecEnv(
            env, end_at_lidar=True, cost_offset=0.05, relative=True, mirror=True, pictures=pictures
        )

    def run(
        name, file="ppo-statistics", resume=False, timesteps=120, options=None, algorithm=None, **changes
    ):
        numbers = read_hyperparameters(FOLDER / f"{file}.yml")
        small = algorithm or (SMALL_PPO if file.startswith("ppo") else SMALL_DQN)
        numbers = replace(
            numbers, timesteps=timesteps, envs=2, algorithm={**numbers.algorithm, **small}, **changes
        )
        folder = tmp_path / name
        folder.mkdir(exist_ok=True)
        chosen = replace(Options(algorithm=file.split("-")[0], stages=4), **(options or {}))
        train(chosen, numbers, environment, validation, folder, CARD, resume=resume, quiet=True)
        return folder

    return run


def curve(folder):
    return (folder / LOG_FILE).read_text()


@pytest.mark.parametrize("file", ["ppo-statistics", "dqn-statistics", "qrdqn-statistics"])
def test_the_same_seed_gives_the_same_curve_and_another_seed_another(learn, file):
    first, again = learn("first", file), learn("again", file)
    assert curve(first) == curve(again)
    assert (first / BEST).read_bytes() == (again / BEST).read_bytes()
    other = learn("other", file, options={"seed": 1})
    assert curve(first) != curve(other)


@pytest.mark.parametrize("file", ["ppo-statistics", "dqn-statistics"])
def test_a_killed_training_goes_on_as_if_it_had_never_stopped(learn, file, monkeypatch):
    whole = learn("whole", file)
    save, saved = training.checkpoint.save, []

    def save_and_die(*arguments):
        save(*arguments)
        saved.append(arguments)
        if len(saved) == 2:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(training.checkpoint, "save", save_and_die)
        learn("killed", file)
    killed = learn("killed", file, resume=True)
    assert curve(killed) == curve(whole)
    assert (killed / BEST).read_bytes() == (whole / BEST).read_bytes()
    card = read_card(killed / BEST)
    learn("killed", file, resume=True)  # nothing is left to do
    assert read_card(killed / BEST) == card and curve(killed) == curve(whole)


@pytest.mark.parametrize("file", ["ppo-dict", "ppo-image"])
def test_policies_on_pictures_train_and_load(learn, file):
    folder = learn("pictures", file, timesteps=40)
    policy = load_trigger(folder / BEST)
    assert policy.obs_mode == file.removeprefix("ppo-")
    assert (policy.trigger_cost is None) == (file == "ppo-image")


def test_the_card_says_what_was_trained_and_measured(learn):
    folder = learn("card")
    network, card = load_network(folder / BEST, ARCHITECTURES)
    assert card.data == CARD.data and card.options == network.options
    assert card.training["options"]["algorithm"] == "ppo" and card.training["steps_in_all"] == 120
    found = card.metrics["validation"]
    assert len(found["curve"]["trigger_cost"]) == len(found["curve"]["rate_hz"]) == 12
    groups = [json.loads(line)["group"] for line in curve(folder).splitlines()]
    assert groups.count("validation") == 4 and "train" in groups
    assert list((folder / "tensorboard").glob("events*"))


def test_dear_triggers_are_given_up(learn, validation):
    numbers = {"n_steps": 15, "batch_size": 60, "n_epochs": 4, "learning_rate": 0.02, "ent_coef": 0.0}
    folder = learn("dear", timesteps=1200, trigger_cost=50.0, algorithm=numbers, options={"stages": 1})
    network, card = load_network(folder / BEST, ARCHITECTURES)
    assert play_together(network, validation.traces).rate.mean() == pytest.approx(10.0)
    assert card.metrics["validation"]["rate_hz"] == [10.0]


def test_a_target_rate_is_kept_on_validation(learn, validation):
    folder = learn("rate", trigger_cost=0.1, options={"target_rate": 20.0})
    network, card = load_network(folder / BEST, ARCHITECTURES)
    rate = float(play_together(network, validation.traces).rate.mean())
    assert card.metrics["validation"]["target_hz"] == 20.0
    assert card.metrics["validation"]["rate_hz"] == [pytest.approx(rate, abs=1e-3)]
    assert rate <= 20.0
    assert card.training["trigger_cost"] != 0.1  # it was adapted


class Rates:
    """Stands for environments in which a given rate was measured."""

    def __init__(self):
        self.charged = []
        self.rate = 0.0

    def take_rate(self):
        return self.rate

    def set_trigger_cost(self, cost):
        self.charged.append(cost)


def test_the_multiplier_rises_with_too_many_triggers_and_falls_with_too_few():
    env = Rates()
    constraint = RateConstraint(env, rate_hz=30.0, cost=0.1, speed=2.0)
    constraint.model = type("Model", (), {"logger": type("Log", (), {"record": lambda *_: None})()})()
    constraint.num_timesteps = 0
    constraint._on_training_start()
    for rate in (40.0, 20.0, 30.0):
        env.rate = rate
        constraint.num_timesteps += 50_000
        constraint._on_rollout_end()
    assert env.charged == pytest.approx([0.1, 0.1 * np.exp(1.0), 0.1, 0.1])
    env.rate, constraint.num_timesteps = 50.0, 10_000_000
    constraint._on_rollout_end()
    assert env.charged[-1] == 100.0  # never beyond what can be shown


def test_another_run_is_not_resumed(learn):
    folder = learn("run")
    with pytest.raises(ValueError, match="run with other settings: options"):
        learn("run", resume=True, options={"seed": 1})
    with pytest.raises(ValueError, match="run with other settings: hyperparameters"):
        learn("run", resume=True, timesteps=180)
    (folder / LAST).write_bytes((folder / LAST).read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"found no checkpoint in .*last\.pt"):
        learn("run", resume=True)
    with pytest.raises(FileNotFoundError, match=r"found no .*last\.pt"):
        learn("nothing", resume=True)


def test_a_target_rate_needs_one_cost(learn):
    with pytest.raises(ValueError, match="target_rate: found 30"):
        learn("both", options={"target_rate": 30.0})


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.yml")), ids=lambda path: path.stem)
def test_every_file_of_hyperparameters_fits_its_algorithm_and_the_zoo(path, stored):
    numbers = read_hyperparameters(path)
    env = ReplayVecEnv(
        BatchedReplayEnv(
            2,
            data=stored,
            extrapolator="warp",
            obs_mode=numbers.obs_mode,
            trigger_cost=numbers.trigger_cost,
            autoreset_mode=AutoresetMode.SAME_STEP,
        ),
        pictures=numbers.obs_mode != "statistics",
    )
    model = make_model(path.stem.split("-")[0], numbers, env, seed=0)
    assert model.policy.activation_fn is not None
    entry = yaml.safe_load(path.read_text())[ENV_ID]
    assert not any("(" in str(value) for value in entry.values())  # nothing that the Zoo would evaluate
    assert path.stem in train_rl.__doc__


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [", "found no YAML"),
        ("CartPole-v1: {}", r"found entries \['CartPole-v1'\]"),
        ("nl_env/Replay-v0: {n_envs: 2}", "found no env_kwargs, n_timesteps, policy"),
        (
            "nl_env/Replay-v0: {n_envs: 0, n_timesteps: 5, policy: MlpPolicy, env_kwargs: {}}",
            r"n_envs: found 0",
        ),
        (
            "nl_env/Replay-v0: {n_envs: 1, n_timesteps: 5, policy: MlpPolicy, env_kwargs: {sound: 1}}",
            "env_kwargs: found 'sound'",
        ),
        (
            "nl_env/Replay-v0: {n_envs: 1, n_timesteps: 5, policy: P, env_kwargs: {}, policy_kwargs: dict()}",
            "strings are not evaluated",
        ),
    ],
)
def test_bad_files_of_hyperparameters_are_named(tmp_path, text, message):
    path = tmp_path / "mine.yml"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"mine\.yml.*{message}"):
        read_hyperparameters(path)


def test_schedules():
    falling = scheduled({"learning_rate": "lin_0.5", "clip_range": 0.2})
    assert falling["learning_rate"](0.5) == 0.25 and falling["clip_range"] == 0.2
    for wrong in ("cos_0.1", "lin_", "0.1"):
        with pytest.raises(ValueError, match=f"learning_rate: found '{wrong}'"):
            scheduled({"learning_rate": wrong})


def test_the_command_trains_and_refuses(stored, tmp_path, capsys):
    out = tmp_path / "out"
    file = tmp_path / "ppo-tiny.yml"
    entry = yaml.safe_load((FOLDER / "ppo-statistics.yml").read_text())[ENV_ID]
    file.write_text(yaml.safe_dump({ENV_ID: {**entry, **SMALL_PPO, "n_envs": 2, "n_timesteps": 60}}))
    command = [str(file), "--recordings", str(stored), "--validation", str(stored), "--extrapolator", "warp"]
    command += ["--stages", "2", "--out", str(out)]
    assert train_rl.main(command) == 0
    assert "regret" in json.loads(capsys.readouterr().out.splitlines()[0])
    assert load_trigger(out / BEST).trigger_cost == 0.1
    assert train_rl.main(command) == 2
    assert "already holds files" in capsys.readouterr().err
    assert train_rl.main([*command, "--resume"]) == 0
    begun = tmp_path / "begun"
    assert train_rl.main([*command[:-1], str(begun), "--resume"]) == 0
    assert (begun / BEST).read_bytes() == (out / BEST).read_bytes()
    assert train_rl.main([*command, "--overwrite", "--sequences", "1"]) == 0
    assert json.loads((out / BEST).with_suffix(".json").read_text())["data"]["training"]["sequences"] == 1
    assert train_rl.main(["no-such-file", "--out", str(tmp_path / "x")]) == 2
    assert "no-such-file" in capsys.readouterr().err
