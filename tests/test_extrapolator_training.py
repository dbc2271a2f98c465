import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from short_recordings import record

from nl_env.depth.examples import Augmentation, augmented
from nl_env.depth.features import EVENTS
from nl_env.depth.learned_networks import load_learned
from nl_env.depth.motion import se3_log
from nl_env.depth.motion_network import MotionNetwork
from nl_env.depth.pairs import PAPER_GAPS, PairOptions, build_pairs
from nl_env.depth.paper_training import PaperLoss, PaperTask
from nl_env.depth.refine import RefineNetwork
from nl_env.depth.training import (
    MotionMix,
    MotionTask,
    RefineLoss,
    RefineTask,
    estimated_motions,
    scores,
    standing,
)
from nl_env.depth.unet import load_unet
from nl_env.depth.warp import warp

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

import train_extrapolator

NONE = Augmentation(flip=0, noise=0, threshold=1, start=0, jitter=0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    record(folder / "train", (3, 4), 0.64)
    record(folder / "val", (5,), 0.64, "val")
    return folder


@pytest.fixture(scope="module")
def pairs(folder):
    return build_pairs(folder / "train", folder / "cut", PairOptions(2, PAPER_GAPS))


def rng(seed=0):
    return np.random.default_rng(seed)


def test_examples_believe_in_the_last_interval_or_in_odometry(pairs):
    believed, true = pairs.example(3), pairs.example(3, odometry=True)
    np.testing.assert_array_equal(true.motion, pairs[3]["true_motion"])
    np.testing.assert_array_equal(true.scene.last_motion, pairs[3]["true_last_motion"])
    expected = 2 * se3_log(np.array(pairs[3]["last_motion"]))  # 200 ms after 100 ms
    np.testing.assert_allclose(se3_log(believed.motion), expected, atol=1e-9)
    assert standing(believed).stack()[0].tobytes() == standing(true).stack()[0].tobytes()


def test_a_mirrored_example_is_the_mirror_image(pairs):
    plain = augmented(pairs.example(4), NONE, rng())
    mirrored = augmented(pairs.example(4), Augmentation(1, 0, 1, 0, 0), rng())
    np.testing.assert_array_equal(mirrored.truth, plain.truth[:, ::-1])
    a, b = plain.stack(), mirrored.stack()[:, :, ::-1]
    b[-3] *= -1  # flow to the right
    close = np.isclose(a, b, atol=1e-3).mean()
    assert close > 0.99


def test_noise_changes_events_alone_and_follows_its_generator(pairs):
    noisy = Augmentation(flip=0, noise=0.05, threshold=1.5, start=0, jitter=0)
    one, same, other = (augmented(pairs.example(4), noisy, rng(seed)).stack() for seed in (1, 1, 2))
    plain = pairs.example(4).stack()
    assert one.tobytes() == same.tobytes() != other.tobytes()
    assert (one[EVENTS] != plain[EVENTS]).any()
    one[EVENTS] = plain[EVENTS]
    np.testing.assert_array_equal(one, plain)


def test_a_start_knows_no_motion(pairs):
    started = augmented(pairs.example(4), Augmentation(0, 0, 1, 1, 0), rng())
    assert started.scene.previous is None
    np.testing.assert_array_equal(started.motion, np.eye(4))


def test_the_motion_task_measures_the_flow_that_is_left(pairs):
    task = MotionTask(pairs, pairs, NONE)
    batch = [torch.from_numpy(array) for array in task.batch(np.arange(5), rng())]
    silent = torch.zeros(5, 2, 30, 40)
    _, parts = task.loss(lambda stack: silent, tuple(batch))
    torch.testing.assert_close(parts["left_over"], parts["before"])
    network = MotionNetwork((8, 8, 8)).eval()
    with torch.no_grad():
        metrics = task.evaluate(network)
    assert metrics["before"] > 0 and metrics["left_over"] != metrics["before"]
    motions = estimated_motions(network, pairs)
    assert motions.shape == (len(pairs), 4, 4) and np.isfinite(motions).all()


def test_the_refine_task_scores_an_untrained_network_as_the_warp_it_starts_from(pairs):
    network = RefineNetwork((8, 8)).eval()
    task = RefineTask(pairs, pairs, augmentation=NONE, odometry=True)
    with torch.no_grad():
        ours = task.evaluate(network)

    def warped(index):
        chosen = pairs.example(index, odometry=True)
        depth = warp(chosen.scene.prior, pairs.camera, chosen.motion, pairs.max_depth)
        return depth, depth

    expected = scores(pairs, warped)
    for name in ("log_mae", "imae", "bad_25"):
        assert ours[name] == pytest.approx(expected[name], rel=1e-3)
    assert ours["missed_return"] == pytest.approx(expected["missed_return"])


def test_the_refine_loss_is_lowest_for_the_truth(pairs):
    task = RefineTask(pairs, pairs, augmentation=NONE, mix=MotionMix(1.0, 0.0))
    stack, truth = (torch.from_numpy(array) for array in task.batch(np.arange(3), rng()))
    log_truth = torch.where(truth > 0, truth.clamp(min=1.0), 200.0).log()
    code = (log_truth - 3.0) / 1.5
    sure = 20 * ((truth > 0) * 2.0 - 1)
    wrong = ((stack[:, 0] * 1.5 + 3.0) - log_truth).abs() > RefineLoss().wrong
    gate, gate_if = (20 * (each * 2.0 - 1) for each in (wrong, wrong | (stack[:, 1] == 0)))
    perfect = torch.stack([code, sure, code, code, gate, code, gate_if], dim=1)
    total, parts = task.loss(lambda _: perfect, (stack, truth))
    assert total < 1e-3
    for channel in range(7):
        worse = perfect.clone()
        worse[:, channel] = -worse[:, channel] + 0.3
        assert task.loss(lambda _, worse=worse: worse, (stack, truth))[0] > total + 1e-3
    assert set(parts) >= {"log_depth", "returned", "gates"}


def test_scores_want_every_gap(pairs):
    with pytest.raises(ValueError, match="every"):
        scores(pairs, lambda index: (pairs.example(index).scene.prior,) * 2, every=5)
    repeat = scores(pairs, lambda index: (pairs.example(index).scene.prior,) * 2)
    assert all(value == pytest.approx(1.0) for value in repeat.values())


def test_the_paper_task_learns_from_what_the_paper_shows_its_network(pairs):
    task = PaperTask(pairs, pairs, NONE, PaperLoss("paper"))
    prior, voxel, truth = task.batch(np.array([4]), rng())
    known = pairs.example(4)
    np.testing.assert_array_equal(prior[0, 0], known.scene.prior)
    np.testing.assert_array_equal(voxel[0], known.scene.voxel)
    np.testing.assert_array_equal(truth[0, 0], known.truth)
    loss, _ = task.loss(lambda prior, voxel: torch.from_numpy(truth), (None, None, torch.from_numpy(truth)))
    assert float(loss) == pytest.approx(0, abs=1e-4)


def test_bad_options_are_named():
    for make in (
        lambda: Augmentation(flip=2),
        lambda: Augmentation(threshold=0.5),
        lambda: RefineLoss(knee=0),
        lambda: MotionMix(0.8, 0.3),
        lambda: PaperLoss("mine"),
        lambda: train_extrapolator.Paper(variant="mine"),
    ):
        with pytest.raises(ValueError, match="found"):
            make()


def command(folder, kind, out, *more):
    data = [f"--data={folder / 'train'}", f"--validation={folder / 'val'}", f"--pairs={folder / 'pairs'}"]
    return [kind, *data, "--instants=2", "--workers=0",
            f"--out={out}", "--judge-every=1", *more]  # fmt: skip


SHORT = ("--motion.steps=2", "--motion.batch-size=2", "--refine.steps=2", "--refine.batch-size=2",
         "--channels", "8", "8", "--motion-channels", "8", "8", "8")  # fmt: skip


def test_our_training_leaves_weights_that_load_and_a_finished_one_resumes_to_the_same(folder, tmp_path):
    assert train_extrapolator.main(command(folder, "ours", tmp_path / "run", *SHORT, "--estimate")) == 0
    weights = tmp_path / "run" / train_extrapolator.WEIGHTS
    first = weights.read_bytes()
    networks = load_learned(weights)
    assert networks.motion is not None and networks.refine is not None and networks.events
    card = json.loads(weights.with_suffix(".json").read_text())
    assert card["training"]["command"].startswith("python scripts/train_extrapolator.py ours")
    assert card["metrics"]["refine"]["validation"]["log_mae"] > 0
    assert card["data"]["train"]["sequences"] == 2
    assert (
        train_extrapolator.main(command(folder, "ours", tmp_path / "run", *SHORT, "--estimate", "--resume"))
        == 0
    )
    assert weights.read_bytes() == first


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (["--parts=refine", "--no-events"], (False, True, False, False)),
        (["--parts=motion"], (True, False, True, True)),
        (["--odometry"], (False, True, True, True)),
        (["--heads=1", "--fine=8"], (False, True, True, True)),
    ],
)
def test_ablations_leave_out_what_they_say(folder, tmp_path, flags, expected):
    assert train_extrapolator.main(command(folder, "ours", tmp_path / "run", *SHORT, *flags)) == 0
    networks = load_learned(tmp_path / "run" / train_extrapolator.WEIGHTS)
    found = networks.motion is not None, networks.refine is not None, networks.warped, networks.events
    assert found == expected


def test_networks_trained_apart_are_joined_and_judged(folder, tmp_path):
    parts = {"motion": ["--parts=motion"], "refine": []}
    for name, flags in parts.items():
        assert train_extrapolator.main(command(folder, "ours", tmp_path / name, *SHORT, *flags)) == 0
    given = [f"--{name}={tmp_path / name / train_extrapolator.WEIGHTS}" for name in parts]
    assert train_extrapolator.main(command(folder, "join", tmp_path / "joined", *given)) == 0
    joined = load_learned(tmp_path / "joined" / train_extrapolator.WEIGHTS)
    for name in parts:
        alone = getattr(load_learned(tmp_path / name / train_extrapolator.WEIGHTS), name)
        for key, tensor in alone.state_dict().items():
            torch.testing.assert_close(getattr(joined, name).state_dict()[key], tensor, rtol=0, atol=0)
    card = json.loads((tmp_path / "joined/extrapolator.json").read_text())
    assert set(card["metrics"]["validation"]) == {"estimated", "continued"}
    swapped = [given[0].replace("--motion", "--refine"), given[1].replace("--refine", "--motion")]
    assert train_extrapolator.main(command(folder, "join", tmp_path / "no", *swapped)) == 2


def test_the_papers_network_is_trained_by_the_same_command(folder, tmp_path):
    short = ("--training.steps=1", "--training.batch-size=2", "--variant=event-frame")
    assert train_extrapolator.main(command(folder, "paper", tmp_path / "run", *short)) == 0
    assert load_unet(tmp_path / "run" / train_extrapolator.WEIGHTS).options.inputs == "frame"


def test_errors_are_said_in_one_line(folder, tmp_path, capsys):
    assert train_extrapolator.main(command(tmp_path, "ours", tmp_path / "run")) == 2
    assert "manifest.json" in capsys.readouterr().err
