import errno
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from torch import nn
from toy_training import OPTIONS, Toy, ToyTask, run

from nl_env.training import TrainingOptions, seeded
from nl_env.training.batches import Batches
from nl_env.training.log import Log
from nl_env.weight_files import load_network, read_card, read_tensors

ROOT = Path(__file__).parents[1]


class Interruption(BaseException):
    """Nothing may catch it, as nothing catches SIGKILL."""


def interrupt():
    raise Interruption


def tensors_of(folder):
    return {
        name: {key: value.numpy().tobytes() for key, value in read_tensors(folder / name).items()}
        for name in ("last.safetensors", "best.safetensors")
    }


def log_of(folder):
    lines = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    return [line for line in lines if line["group"] == "validation"]


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    result = run(folder)
    return folder, result


def test_learns_and_leaves_weights_with_a_card(uninterrupted):
    folder, result = uninterrupted
    validations = log_of(folder)
    assert [line["step"] for line in validations] == [*range(3, 25, 3)]
    assert result.progress.best == pytest.approx(min(line["mse"] for line in validations), rel=1e-5)
    assert validations[-1]["mse"] < 0.7 * validations[0]["mse"]
    network, card = load_network(result.weights, {"toy": Toy})
    assert card == result.card == read_card(folder / "best.safetensors")
    assert card.training["steps"] == result.progress.best_step
    assert card.training["steps_in_all"] == 24
    assert card.training["options"]["learning_rate"] == OPTIONS.learning_rate
    with torch.no_grad():
        assert ToyTask().evaluate(network) == pytest.approx(result.progress.best_metrics, rel=1e-4)
    assert card.metrics["validation"] == result.progress.best_metrics


def test_killed_at_a_step_and_resumed_gives_the_same_bytes(uninterrupted, tmp_path):
    killed = subprocess.run(
        [sys.executable, str(ROOT / "tests" / "toy_training.py"), str(tmp_path), "13"],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
    )
    assert killed.returncode == -signal.SIGKILL
    assert max(line["step"] for line in log_of(tmp_path)) == 12
    result = run(tmp_path, resume=True)
    assert tensors_of(tmp_path) == tensors_of(uninterrupted[0])
    assert log_of(tmp_path) == log_of(uninterrupted[0])
    assert result.progress.best_metrics == uninterrupted[1].progress.best_metrics


@pytest.mark.parametrize(
    ("optimiser", "ema", "amp"), [("adamw", 0.0, "off"), ("nadam", 0.9, "off"), ("adamw", 0.9, "bf16")]
)
def test_stopped_again_and_again(optimiser, ema, amp, tmp_path):
    options = {"optimiser": optimiser, "ema": ema, "amp": amp}
    options |= {"steps": 12, "patience": 3, "checkpoint_every": 2}
    whole, pieces = tmp_path / "whole", tmp_path / "pieces"
    expected = run(whole, **options)
    for _ in range(20):  # at most four steps at a time, of which some are lost
        try:
            result = run(pieces, ToyTask(5, interrupt), resume=True, **options)
            break
        except Interruption:
            pass
    assert tensors_of(pieces) == tensors_of(whole)
    assert result.progress.stale == expected.progress.stale


def test_stopped_before_the_first_checkpoint_starts_over(uninterrupted, tmp_path):
    with pytest.raises(Interruption):
        run(tmp_path, ToyTask(4, interrupt))
    assert not (tmp_path / "last.safetensors").exists()
    run(tmp_path, resume=True)
    assert tensors_of(tmp_path) == tensors_of(uninterrupted[0])
    assert log_of(tmp_path) == log_of(uninterrupted[0])


def test_a_finished_run_is_not_trained_further(uninterrupted):
    folder, result = uninterrupted
    before = tensors_of(folder)
    again = run(folder, ToyTask(1, interrupt), resume=True)
    assert again == result
    assert tensors_of(folder) == before


class WorseAndWorse(ToyTask):
    def evaluate(self, model):
        return {"mse": float(self.steps)}


def test_patience_ends_training_and_keeps_the_best(tmp_path):
    result = run(tmp_path, WorseAndWorse(), patience=2, ema=0.0)
    assert (result.progress.step, result.progress.best_step, result.progress.best) == (9, 3, 3.0)
    assert result.progress.finished
    again = run(tmp_path, WorseAndWorse(1, interrupt), patience=2, ema=0.0, resume=True)
    assert again.progress == result.progress


def test_another_seed_gives_other_weights_and_threads_of_the_caller_are_kept(uninterrupted, tmp_path):
    before, state = torch.get_num_threads(), torch.get_rng_state()
    run(tmp_path, seed=4)
    assert tensors_of(tmp_path) != tensors_of(uninterrupted[0])
    assert torch.get_num_threads() == before
    assert torch.equal(torch.get_rng_state(), state)


def test_worker_processes_make_the_same_batches(tmp_path):
    options = {"steps": 6, "evaluate_every": 0}
    here, there = tmp_path / "here", tmp_path / "there"
    run(here, **options)
    run(there, loader_workers=1, **options)
    assert tensors_of(there) == tensors_of(here)


@pytest.mark.parametrize("at", [2, 9])
def test_a_loss_that_is_not_finite_stops_training(at, tmp_path):
    class Poisoned(ToyTask):
        def batch(self, indices, rng):
            self.steps += 1
            images, targets = super().batch(indices, rng)
            return images, targets * (np.float32(np.nan) if self.steps == at else np.float32(1))

        def loss(self, model, batch):
            squared = (model(batch[0]) - batch[1]).square().mean()
            return squared, {}

    found = "holds step 5" if at > 5 else "there is no checkpoint yet"
    with pytest.raises(FloatingPointError, match=rf"found loss nan.* at step {at}.*{found}"):
        run(tmp_path, Poisoned())
    if at > 5:
        with safe_open(tmp_path / "last.safetensors", "pt") as file:
            assert json.loads(file.metadata()["training_state"])["progress"]["step"] == 5
        assert all(tensor.isfinite().all() for tensor in read_tensors(tmp_path / "last.safetensors").values())


def test_a_full_disk_keeps_the_previous_checkpoint(uninterrupted, tmp_path, monkeypatch):
    write, saved = Path.write_bytes, []

    def full(path, data):
        if b"training_state" in data[:4000]:
            saved.append(path)
            if len(saved) == 3:
                write(path, data[: len(data) // 2])
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(path, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(
        OSError, match=r"cannot write .*last\.safetensors.*No space left.*previous checkpoint is kept"
    ):
        run(tmp_path)
    monkeypatch.undo()
    assert not list(tmp_path.glob(".*"))
    with safe_open(tmp_path / "last.safetensors", "pt") as file:
        assert json.loads(file.metadata()["training_state"])["progress"]["step"] == 10
    run(tmp_path, resume=True)
    assert tensors_of(tmp_path) == tensors_of(uninterrupted[0])


def test_a_run_is_not_overwritten_unasked(tmp_path):
    run(tmp_path, steps=2)
    with pytest.raises(FileExistsError, match="already holds a run"):
        run(tmp_path, steps=2)
    with pytest.raises(ValueError, match="resume and overwrite"):
        run(tmp_path, resume=True, overwrite=True)
    with pytest.raises(ValueError, match=r"other settings: options\.seed is 3, asked 5"):
        run(tmp_path, steps=2, seed=5, resume=True)
    assert run(tmp_path, steps=3, overwrite=True).progress.step == 3


def test_a_damaged_checkpoint_is_explained(tmp_path):
    run(tmp_path, steps=2)
    last = tmp_path / "last.safetensors"
    data = last.read_bytes()
    last.write_bytes(data[:-100])
    with pytest.raises(ValueError, match=r"found no safetensors data in .*last\.safetensors"):
        run(tmp_path, steps=2, resume=True)
    last.write_bytes((tmp_path / "best.safetensors").read_bytes())
    with pytest.raises(ValueError, match="expected a training checkpoint"):
        run(tmp_path, steps=2, resume=True)


def test_a_criterion_must_be_there_and_finite(tmp_path):
    class Silent(ToyTask):
        def evaluate(self, model):
            return {"mae": 1.0}

    with pytest.raises(ValueError, match="found mse nan"):
        run(tmp_path, Silent())
    empty = ToyTask()
    empty.size = 0
    with pytest.raises(ValueError, match="found 0 training samples"):
        run(tmp_path / "empty", empty)


def test_every_epoch_sees_every_sample_once():
    batches = Batches(ToyTask(), batch_size=4, seed=0)
    seen = np.concatenate([batches.indices(step) for step in range(27)])  # six epochs of 18
    epochs = seen.reshape(6, 18)
    assert (np.sort(epochs, axis=1) == np.arange(18)).all()
    assert not (epochs[0] == epochs[1]).all()
    larger = Batches(ToyTask(), batch_size=40, seed=0).indices(0)
    assert (larger == seen[:40]).all()


def test_ahead_of_a_step_in_the_middle():
    batches = Batches(ToyTask(), batch_size=4, seed=0)
    produced = list(batches.ahead(5, 9, workers=0))
    assert len(produced) == 4
    for step, batch in enumerate(produced, 5):
        assert all(torch.equal(a, b) for a, b in zip(batch, batches[step], strict=True))


def test_errors_of_the_source_come_through(tmp_path):
    class Broken(ToyTask):
        def batch(self, indices, rng):
            raise OSError("no such recording")

    with pytest.raises(OSError, match="no such recording"):
        run(tmp_path, Broken())


class TwoOutputs(nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(4, 4)

    def forward(self, x):
        y = self.layer(x)
        self.seen = y.dtype
        return {"y": y, "more": (y, [y.argmax(1)])}


def test_losses_see_float32_also_from_a_bf16_network(tmp_path):
    from nl_env.training.run import _InFloat32

    network = TwoOutputs()
    outputs = _InFloat32(network, torch.device("cpu"), bf16=True)(torch.ones(2, 4))
    assert network.seen == torch.bfloat16
    assert outputs["y"].dtype == outputs["more"][0].dtype == torch.float32
    assert outputs["more"][1][0].dtype == torch.int64


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"optimiser": "sgd"}, "optimiser: found 'sgd'"),
        ({"learning_rate": -1}, "learning_rate"),
        ({"batch_size": 0}, "batch_size: found 0"),
        ({"ema": 1.0}, "ema"),
        ({"epochs": 0}, "epochs: found 0"),
        ({"clip_gradient": float("nan")}, "clip_gradient"),
    ],
)
def test_options_are_checked(change, message):
    with pytest.raises(ValueError, match=message):
        TrainingOptions(**change)


def test_rates():
    options = TrainingOptions(learning_rate=2.0, warmup_steps=10, final_rate=0.1)
    assert options.rate(0, 1000) == pytest.approx(0.2, rel=1e-3)
    assert options.rate(500, 1000) == pytest.approx(2 * 0.55)
    assert options.rate(999, 1000) == pytest.approx(0.2, rel=1e-3)
    assert TrainingOptions(schedule="constant", learning_rate=0.5).rate(700, 1000) == 0.5
    assert TrainingOptions(epochs=2, batch_size=8).total_steps(100) == 25
    assert TrainingOptions(steps=7).total_steps(100) == 7


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a CUDA device")
def test_cuda_is_refused_where_there_is_none(tmp_path):
    with pytest.raises(ValueError, match="device: found 'cuda'"):
        run(tmp_path, device="cuda")


def test_seeded_leaves_the_generator():
    state = torch.get_rng_state()
    with seeded(1):
        first = torch.rand(3)
    with seeded(1):
        assert torch.equal(torch.rand(3), first)
    assert torch.equal(torch.get_rng_state(), state)


def test_the_log_speaks_in_lines_or_in_a_bar(tmp_path, capsys, monkeypatch):
    def speak():
        log = Log(tmp_path, first=2, total=10, tensorboard=False, quiet=False)
        for step in (3, 4):
            log.step(step)
            log.scalars(step, "train", {"loss": 0.5})
        log.scalars(4, "validation", {"mse": 0.25})
        log.close()
        return capsys.readouterr().err

    lines = speak()
    assert re.fullmatch(r"step 4/10, \d+\.\d min left: validation mse 0\.25\n", lines)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    bar = speak()
    assert "step 4: validation mse 0.25" in bar and "4/10" in bar and "loss 0.5" in bar


def test_a_log_is_cut_where_a_run_resumes(tmp_path):
    lines = [json.dumps({"step": step, "group": "train", "loss": 1.0}) for step in (5, 10, 15)]
    (tmp_path / "log.jsonl").write_text("\n".join(lines) + '\n{"step": 2')
    Log(tmp_path, first=10, total=20, tensorboard=False, quiet=True).close()
    assert (tmp_path / "log.jsonl").read_text().splitlines() == lines[:2]


def test_tensorboard_events(tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log = Log(tmp_path, first=0, total=2, tensorboard=True, quiet=True)
    log.scalars(1, "validation", {"mse": 0.5})
    log.close()
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [(event.step, event.value) for event in events.Scalars("validation/mse")] == [(1, 0.5)]
