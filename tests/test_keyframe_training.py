"""Data, tasks and the training script of the keyframe detectors, on sequences of a fraction of a second."""

import hashlib
import importlib.util
import json
import pickle
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from agents.keyframe_cnn import KeyframeCNN
from agents.keyframe_data import JoinedSlices, Slices, build_slices, slice_dtype
from agents.keyframe_networks import FrameDetector, Perception, Recall, TemporalDetector
from agents.keyframe_training import (
    KeyframeTask,
    PerceptionTask,
    RecallTask,
    SampleOptions,
    augment,
    calibrate,
    detect,
    look,
)
from nl_env.config import SPLITS, DrivingConfig, SceneConfig, to_dict
from nl_env.recording import record_sequence
from nl_env.streams import SyntheticStream
from nl_env.training import TrainingOptions, seeded, train
from nl_env.weight_files import Card, read_card, read_tensors

SHAPE = (120, 160)
K = 20
CONFIG = DrivingConfig(resolution="quarter", scene=SceneConfig(scenario="highway", duration_s=0.4))
PLAIN = SampleOptions(flip=False, invert=False, noise=0.0)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """One recorded sequence and its manifest, as scripts/record.py leaves them."""
    folder = tmp_path_factory.mktemp("recordings")
    seed = SPLITS["train"][0]
    record_sequence(folder / f"{seed}.h5", CONFIG, seed)
    stream = SyntheticStream(CONFIG)
    stream.reset(seed)
    entry = {"seed": seed, "file": f"{seed}.h5", "description": stream.describe()}
    manifest = {"split": "train", "seeds": [seed], "sequences": [entry], "config": to_dict(CONFIG)}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder


def made_up(folder, sequences=4, seed=0, burst=3):
    """Slices in which a keyframe lasts ``burst`` slices; the first shows many events, the others few.

    ``folder`` gets the manifest of the recordings that they could be from, ``folder``-slices the slices.
    """
    rng = np.random.default_rng(seed)
    slices = folder.with_name(folder.name + "-slices")
    folder.mkdir()
    (slices / "sequences").mkdir(parents=True)
    seeds = list(range(seed, seed + sequences))
    for number in seeds:
        rows = np.zeros(K, slice_dtype(SHAPE))
        starts = rng.random(K) < 0.2
        rows["speed"] = np.convolve(starts, np.ones(burst))[:K] > 0
        rows["frame"] = rng.integers(0, 2, rows["frame"].shape) * np.where(starts, 5, 1)[:, None, None]
        rows["frame"][..., 80:] //= 2
        rows["actors"][starts, :, :, :10] = True
        rows["motion"] = np.stack([0.5 + starts, np.full(K, 0.3)], axis=1)
        rows["lidar"] = np.arange(1, K + 1) % 5 == 0
        np.save(slices / "sequences" / f"{number}.npy", rows)
    entries = [{"seed": n, "file": f"{n}.h5", "description": {"weather": "ClearNoon"}} for n in seeds]
    manifest = {"split": "train", "seeds": seeds, "sequences": entries, "config": to_dict(CONFIG)}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    identity = {
        "manifest_sha256": hashlib.sha256((folder / "manifest.json").read_bytes()).hexdigest(),
        "split": "train",
        "seeds": seeds,
        "weathers": ["ClearNoon"] * sequences,
        "config": to_dict(CONFIG),
    }
    (slices / "settings.json").write_text(json.dumps(identity))
    return Slices(slices)


def test_slices_are_those_of_the_live_stream(recordings, tmp_path):
    data = build_slices(recordings, tmp_path / "slices")
    stream = SyntheticStream(CONFIG)
    stream.reset(data.seeds[0])
    rows = data.sequence(0)
    assert (len(data), data.length, data.shape) == (1, K, SHAPE)
    assert data.weathers == [stream.describe()["weather"]]
    for k in range(1, K + 1):
        sample = stream.advance()
        np.testing.assert_array_equal(rows[k - 1]["frame"], sample.event_frame)
        assert rows[k - 1]["lidar"] == (sample.lidar is not None)
        motion = [sample.state.speed / 10, sample.state.twist[4] / 0.5]
        np.testing.assert_allclose(rows[k - 1]["motion"], motion, rtol=1e-6)
        assert data.causes(0)[k - 1].tolist() == [
            sample.state.speed > 10,
            sample.state.shortest_distance < 8,
            sample.state.new_actors > 0,
        ]


def test_building_again_only_opens_and_other_recordings_are_refused(recordings, tmp_path):
    folder = tmp_path / "slices"
    data = build_slices(recordings, folder)
    file = folder / "sequences" / f"{data.seeds[0]}.npy"
    before = file.stat().st_mtime_ns
    build_slices(recordings, folder)
    assert file.stat().st_mtime_ns == before
    changed = tmp_path / "changed"
    changed.mkdir()
    manifest = json.loads((recordings / "manifest.json").read_text())
    (changed / "manifest.json").write_text(json.dumps({**manifest, "note": "other"}))
    with pytest.raises(ValueError, match="manifest_sha256"):
        build_slices(changed, folder)
    with pytest.raises(FileNotFoundError, match=r"manifest\.json"):
        build_slices(tmp_path, tmp_path / "other")


def test_slices_pickle_as_a_path_and_name_damaged_files(tmp_path):
    data = made_up(tmp_path / "made")
    data.sequence(0)
    copied = pickle.dumps(data)
    assert len(copied) < 1000
    np.testing.assert_array_equal(pickle.loads(copied).sequence(0), data.sequence(0))
    file = tmp_path / "made-slices" / "sequences" / "0.npy"
    file.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"0\.npy"):
        Slices(data.folder).sequence(0)
    np.save(file, np.zeros(3))
    with pytest.raises(ValueError, match=r"0\.npy"):
        Slices(data.folder).sequence(0)
    with pytest.raises(FileNotFoundError, match=r"settings\.json"):
        Slices(tmp_path)


def test_joined_folders_are_one_source_and_the_card_lists_each(tmp_path):
    parts = [made_up(tmp_path / "one", sequences=2), made_up(tmp_path / "two", sequences=3, seed=7)]
    both = JoinedSlices(parts)
    assert (len(both), both.seeds, len(both.weathers)) == (5, [0, 1, 7, 8, 9], 5)
    for number, (part, within) in enumerate([(0, 0), (0, 1), (1, 0), (1, 1), (1, 2)]):
        np.testing.assert_array_equal(both.sequence(number), parts[part].sequence(within))
        np.testing.assert_array_equal(both.causes(number), parts[part].causes(within))
    assert both.summary["sequences"] == 5
    assert both.summary["folders"] == [part.summary for part in parts]
    assert JoinedSlices(parts[:1]).summary == parts[0].summary
    task = PerceptionTask(both, parts[0], PLAIN)
    assert task.size == 5 * 7  # 20 starts, every third
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(both)).sequence(4), parts[1].sequence(2))


def test_folders_that_do_not_fit_together_are_named(tmp_path):
    first = made_up(tmp_path / "first", sequences=2)
    with pytest.raises(ValueError, match=r"sequence 1 in .*second-slices"):
        JoinedSlices([first, made_up(tmp_path / "second", sequences=2, seed=1)])
    other = made_up(tmp_path / "other", sequences=1, seed=5)
    marker = other.folder / "settings.json"
    marker.write_text(marker.read_text().replace('"cutoff_hz": 2000.0', '"cutoff_hz": 30.0'))
    with pytest.raises(ValueError, match=r"found events .*30\.0.* in .*other-slices.*expected .*2000\.0"):
        JoinedSlices([first, Slices(other.folder)])
    with pytest.raises(ValueError, match="found no folder"):
        JoinedSlices([])


def test_windows_cover_the_sequence_and_labels_belong_to_frames(tmp_path):
    data = made_up(tmp_path / "made", burst=1)
    task = KeyframeTask(data, data, replace(PLAIN, window=4, stride=3))
    assert task.size == 4 * 6  # 17 starts, every third
    seen = set()
    for step in range(40):
        frames, labels = task.batch(np.arange(task.size), np.random.default_rng(step))
        assert frames.shape == (task.size, 4, *SHAPE) and labels.shape == (task.size, 4, 4)
        bright = frames.max(axis=(2, 3)) == 5
        np.testing.assert_array_equal(bright, labels[..., 0])
        seen |= {task.window(index, np.random.default_rng(step))[1].start for index in range(6)}
    assert seen == set(range(17))
    first = task.batch(np.array([3, 5]), np.random.default_rng(0))
    again = task.batch(np.array([3, 5]), np.random.default_rng(0))
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, other)


def test_augmentation_moves_events_and_leaves_the_data_alone():
    rng = np.random.default_rng(0)
    frames = rng.integers(-127, 128, (3, 8, 10)).astype(np.int8)
    kept = frames.copy()
    found = set()
    for _ in range(100):
        changed = augment(frames, rng, replace(PLAIN, flip=True, invert=True))
        for flipped in (False, True):
            for sign in (-1, 1):
                if np.array_equal(changed, sign * (frames[..., ::-1] if flipped else frames)):
                    found.add((flipped, sign))
    assert len(found) == 4
    noisy = [augment(frames, rng, replace(PLAIN, noise=0.5)).astype(int) - frames for _ in range(40)]
    assert {0, 1, -1} <= {int(v) for change in noisy for v in np.unique(change)}
    assert all(np.mean(change != 0) <= 0.5 for change in noisy)
    np.testing.assert_array_equal(frames, kept)


def test_the_loss_is_cross_entropy_and_weights_new_actors(tmp_path):
    data = made_up(tmp_path / "made")
    task = KeyframeTask(data, data, replace(PLAIN, new_weight=3.0, cause_weight=0.5))
    logits = torch.tensor([[[0.0, 1.0, 1.0, 1.0]], [[2.0, 1.0, 1.0, 1.0]]])
    labels = torch.tensor([[[1, 0, 0, 1]], [[0, 0, 0, 0]]], dtype=torch.uint8)
    loss, parts = task.loss(lambda frames: logits, (torch.zeros(2, 1, *SHAPE, dtype=torch.int8), labels))
    label = (3 * np.log(2) + np.log1p(np.exp(2))) / 2
    causes = (5 * np.log1p(np.exp(1)) + np.log1p(np.exp(-1))) / 6
    assert float(parts["label"]) == pytest.approx(label, rel=1e-5)
    assert float(loss) == pytest.approx(label + 0.5 * causes, rel=1e-5)


QUICK = TrainingOptions(
    steps=60, batch_size=8, learning_rate=0.02, amp="off", device="cpu", threads=1, evaluate_every=20
)
SMALL = {"channels": (4, 4, 4), "hidden": 8, "memory_size": 8}


def trained(half, task, options, folder):
    """Train one half of a detector in place and return what validation says of it."""
    result = train(half, task, options, folder, Card("a test", "t"), quiet=True, tensorboard=False)
    half.load_state_dict(read_tensors(result.weights))
    return task.evaluate(half.eval())


def test_perception_learns_where_actors_are_and_how_the_ego_moves(tmp_path):
    data = made_up(tmp_path / "made", sequences=6)
    with seeded(1):
        network = TemporalDetector(*SHAPE, **SMALL)
    task = PerceptionTask(data, data, replace(PLAIN, flip=True))
    before = task.evaluate(Perception(network).eval())
    after = trained(Perception(network), task, QUICK, tmp_path / "perception")
    assert after["loss"] < 0.5 * before["loss"]
    assert after["auroc_cells"] > 0.9


def test_mirroring_moves_actors_and_turns_the_other_way(tmp_path):
    data = made_up(tmp_path / "made")
    task = PerceptionTask(data, data, replace(PLAIN, flip=True, stride=1))
    plain = PerceptionTask(data, data, replace(PLAIN, stride=1))
    frames, maps, motions = task.batch(np.arange(task.size), np.random.default_rng(0))
    mirrored = 0
    for place, (frame, covered, motion) in enumerate(zip(frames, maps, motions, strict=True)):
        expected = [array[0] for array in plain.batch(np.array([place]), np.random.default_rng(0))]
        if motion[1] == expected[2][1]:
            np.testing.assert_array_equal(frame, expected[0])
            continue
        mirrored += 1
        np.testing.assert_array_equal(frame, expected[0][:, ::-1])
        np.testing.assert_array_equal(covered, expected[1][..., ::-1])
        assert (motion[0], motion[1]) == (expected[2][0], -expected[2][1])
    assert 0.3 < mirrored / task.size < 0.7


def test_memory_learns_what_one_frame_does_not_show(tmp_path):
    """A burst is visible in its first slice only: from single frames, most of it cannot be told."""
    data = made_up(tmp_path / "made", sequences=8)
    with seeded(1):
        network = TemporalDetector(*SHAPE, **SMALL)
    options = replace(QUICK, steps=40)
    trained(Perception(network), PerceptionTask(data, data, PLAIN), options, tmp_path / "perception")
    perception = {n: t.clone() for n, t in network.state_dict().items() if n.split(".")[0] in PERCEIVING}
    single = RecallTask(network, data, data, replace(PLAIN, window=1))
    options = replace(QUICK, steps=150, learning_rate=0.03)
    alone = trained(Recall(network), single, options, tmp_path / "single")
    task = RecallTask(network, data, data, replace(PLAIN, window=K, stride=1))
    remembered = trained(Recall(network), task, options, tmp_path / "recall")
    assert remembered["ranking_error"] < 0.05 < alone["ranking_error"]
    whole = KeyframeTask(data, data, PLAIN).evaluate(network.eval())
    assert whole == pytest.approx(remembered, abs=1e-3)  # in one piece, from frames: the same
    for name, tensor in perception.items():
        assert torch.equal(network.state_dict()[name], tensor), name


PERCEIVING = ("quarter", "eighth", "sixteenth", "context", "maps", "motion")


def test_looking_at_mirrored_frames(tmp_path):
    data = made_up(tmp_path / "made", sequences=1)
    with seeded(0):
        network = TemporalDetector(*SHAPE, **SMALL).eval()
    frames = np.ascontiguousarray(data.sequence(0)["frame"].astype(np.float32)[..., ::-1])
    with torch.inference_mode():
        expected = network.summarise(*network.perceive(torch.from_numpy(frames))).numpy()
    np.testing.assert_allclose(look(network, data, mirrored=True)[0], expected, atol=1e-5)
    assert not np.allclose(look(network, data)[0], expected, atol=1e-3)


def test_detections_carry_scores_causes_and_lidar(tmp_path):
    data = made_up(tmp_path / "made", sequences=2)
    with seeded(0):
        network = FrameDetector(*SHAPE).eval()
    found = detect(network, data)
    assert [d.seed for d in found] == data.seeds
    for number, detection in enumerate(found):
        scores = KeyframeCNN(network).score_sequence(data.sequence(number)["frame"])
        np.testing.assert_array_equal(detection.scores, scores)
        np.testing.assert_array_equal(detection.causes, data.causes(number))
        assert detection.lidar.tolist() == [k % 5 == 0 for k in range(1, K + 1)]
    thresholds = calibrate(found, rate_hz=30.0)
    assert thresholds["default"] == thresholds["matching"]


@pytest.mark.parametrize(
    ("make", "argument"),
    [
        (lambda data: SampleOptions(window=0), "window:"),
        (lambda data: SampleOptions(noise=2.0), "noise:"),
        (lambda data: KeyframeTask(data, data, SampleOptions(window=K + 1)), "window: found 21"),
    ],
)
def test_bad_arguments_are_named(tmp_path, make, argument):
    data = made_up(tmp_path / "made", sequences=1)
    with pytest.raises(ValueError, match=argument):
        make(data)


@pytest.mark.parametrize("recipe", ["cnn", "temporal"])
def test_the_script_trains_calibrates_and_resumes(tmp_path, recipe, capsys):
    made_up(tmp_path / "train")
    made_up(tmp_path / "val", seed=9)
    script = training_script()
    command = f"{recipe} --data {tmp_path}/train --validation {tmp_path}/val --out {tmp_path}/out"
    options = (
        "--training.steps 2 --training.batch-size 4 --memory-training.steps 2 --memory-sampling.window 9"
    )
    arguments = [*command.split(), *options.split()]
    assert script.main(arguments) == 0
    weights = tmp_path / "out" / "best.safetensors"
    card = read_card(weights)
    assert card.data["training"]["sequences"] == 4 and card.data["validation"]["first_seed"] == 9
    assert KeyframeCNN.load(weights).threshold == card.metrics["thresholds"]["default"]
    assert set(card.metrics["at_thresholds"]) == {"f1", "rate", "matching", "even"}
    before = weights.read_bytes()
    assert script.main(arguments) == 2
    assert "already holds a run" in capsys.readouterr().err
    assert script.main([*arguments, "--resume"]) == 0
    assert weights.read_bytes() == before


def test_the_script_takes_several_folders(tmp_path, capsys):
    for number, name in enumerate(("one", "two", "val")):
        made_up(tmp_path / name, sequences=2, seed=10 * number)
    script = training_script()
    folders = f"--data {tmp_path}/one {tmp_path}/two --validation {tmp_path}/val"
    options = (
        "--training.steps 2 --training.batch-size 4 --memory-training.steps 2 --memory-sampling.window 9"
    )
    assert script.main(f"temporal {folders} {options} --out {tmp_path}/out".split()) == 0
    data = read_card(tmp_path / "out" / "best.safetensors").data
    assert [part["first_seed"] for part in data["training"]["folders"]] == [0, 10]
    assert data["validation"]["first_seed"] == 20
    (tmp_path / "two" / "manifest.json").unlink()
    assert script.main(f"cnn {folders} --out {tmp_path}/cnn".split()) == 2
    assert str(tmp_path / "two") in capsys.readouterr().err
    assert not (tmp_path / "cnn").exists()


def training_script():
    path = Path(__file__).parents[1] / "scripts" / "train_keyframe.py"
    spec = importlib.util.spec_from_file_location("train_keyframe", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
