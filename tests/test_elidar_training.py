"""Both trainings learn from ELiDAR's files: extrapolators from its pairs, detectors from its event frames."""

import json
import pickle
import shutil

import h5py
import numpy as np
import pytest
import torch
from elidar_files import Source, export, write_pairs

from agents import elidar_frames
from agents.elidar_frames import open_elidar_frames, open_elidar_sequences
from agents.keyframe_cnn import KeyframeCNN, block_length
from agents.keyframe_networks import TemporalDetector
from agents.keyframe_training import KeyframeTask, SampleOptions, calibrate, detect
from nl_env.depth.elidar_pairs import ElidarOptions, find_last_motions, held_out, open_elidar_pairs
from nl_env.depth.examples import Augmentation
from nl_env.depth.learned_networks import load_learned
from nl_env.depth.motion import continued, estimate_motion, se3_log
from nl_env.depth.paper_training import PaperTask
from nl_env.depth.training import MotionMix, RefineTask
from nl_env.depth.unet import load_unet
from nl_env.elidar import ExtrapolationData, SlicingData, elidar_in, find_files, previous_frame
from nl_env.elidar.layout import RAW_FOLDER, SLICING_FILE
from nl_env.weight_files import Card, write_weights
from scripts import train_extrapolator, train_keyframe

SIZE = (40, 48)
NAMED = [
    ("Town01_Opt_00", "train", Source(1, slices=60, size=SIZE)),
    ("Town02_Opt_ClearNoon", "train", Source(2, slices=60, size=SIZE)),
    ("Town03_Opt_WetNoon", "test", Source(3, slices=60, size=SIZE)),
]
NONE = Augmentation(flip=0, noise=0, threshold=1, start=0, jitter=0)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return export(tmp_path_factory.mktemp("export"), NAMED)


@pytest.fixture(scope="module")
def pairs(data, tmp_path_factory):
    """Training pairs and held-out ones."""
    folder = tmp_path_factory.mktemp("pairs") / "motions"
    return open_elidar_pairs(find_files(data), ElidarOptions(), folder)


@pytest.mark.parametrize(
    ("ticks", "frame", "expected"),
    [
        ([0, 4, 10, 30], 0, None),
        ([0, 4, 10, 30], 1, None),  # 20 ms before is not a LiDAR interval
        ([0, 4, 10, 30], 2, 0),
        ([0, 4, 10, 30], 3, 2),
        ([0, 4, 10, 34], 3, 2),
        ([0, 10, 25], 2, 1),  # the later of two
        ([0, 10, 51], 2, None),
        ([0, 60, 100], 2, 1),
    ],
)
def test_the_previous_frame_is_the_one_nearest_to_100_ms_before(ticks, frame, expected):
    assert previous_frame(np.array(ticks), frame) == expected


def test_held_out_sequences_are_spread_and_at_least_one():
    names = [f"{k:02d}" for k in range(64)]
    chosen = held_out(names, 0.1)
    assert len(chosen) == 6
    assert set(np.diff([int(name) for name in chosen])) <= {10, 11}
    assert held_out(["a", "b", "c"], 0.1) == ["b"]
    with pytest.raises(ValueError, match="held_out: found 1 training sequence, expected at least 2"):
        held_out(["a"], 0.1)


def test_an_example_holds_what_the_release_says(data, pairs):
    training, validation = pairs
    assert [list(part.data.sequences) for part in pairs] == [["Town01_Opt_00"], ["Town02_Opt_ClearNoon"]]
    assert len(training) + len(validation) == len(
        ExtrapolationData(*find_files(data).require_pairs(), split="train")
    )
    with_previous = 0
    for index in range(0, len(training), 3):
        pair, found = training.data[index], training.example(index)
        name, row = training.data.place(index)
        ticks, prior = training.data.ticks[name], int(training.data.sequences[name].prior[row])
        np.testing.assert_array_equal(found.scene.prior, pair.prior)
        np.testing.assert_array_equal(found.scene.voxel, pair.voxel)
        np.testing.assert_array_equal(found.truth, pair.truth)
        assert found.scene.gap == pytest.approx(pair.duration * 0.005)
        assert np.isnan(found.true_motion).all()
        before = previous_frame(ticks, prior)
        if before is None:
            assert found.scene.previous is None
            np.testing.assert_array_equal(found.motion, np.eye(4))
            continue
        with_previous += 1
        previous = training.data.depth(name, before)
        np.testing.assert_array_equal(found.scene.previous, previous)
        last = estimate_motion(previous, pair.prior, training.camera, 200.0)
        np.testing.assert_array_equal(found.scene.last_motion, last)
        expected = continued(last, pair.duration / (ticks[prior] - ticks[before]))
        np.testing.assert_allclose(se3_log(found.motion), se3_log(expected), atol=1e-12)
    assert with_previous > 3
    with pytest.raises(ValueError, match="odometry: ELiDAR holds no poses"):
        training.example(0, odometry=True)


def test_a_broken_sequence_can_be_left_out_and_is_named(tmp_path):
    names = [f"Town0{k}_Opt_00" for k in range(3)]
    hdf5, _ = write_pairs(tmp_path, [("train", name) for name in names])
    with h5py.File(hdf5, "r+") as file:
        del file[f"{names[0]}/depth_frames"]
    files = find_files(tmp_path)
    with pytest.raises(ValueError, match=f"{names[0]}/depth_frames: found nothing"):
        open_elidar_pairs(files, ElidarOptions())
    with pytest.warns(UserWarning, match=f"left out {names[0]}: .*depth_frames: found nothing"):
        parts = open_elidar_pairs(files, ElidarOptions(on_error="skip"))
    assert sorted(name for part in parts for name in part.data.sequences) == names[1:]
    with pytest.raises(ValueError, match="on_error: found 'ignore'"):
        ElidarOptions(on_error="ignore")


def test_pairs_reach_a_worker_as_paths(pairs):
    copy = pickle.loads(pickle.dumps(pairs[0]))
    assert len(pickle.dumps(pairs[0].motions)) < 500
    np.testing.assert_array_equal(copy.example(3).scene.prior, pairs[0].example(3).scene.prior)


def test_the_tasks_take_elidar(pairs):
    prior, voxel, truth = PaperTask(*pairs, NONE).batch(np.array([0]), np.random.default_rng(0))
    known = pairs[0].example(0)
    np.testing.assert_array_equal(prior[0, 0], known.scene.prior)
    np.testing.assert_array_equal(voxel[0], known.scene.voxel)
    np.testing.assert_array_equal(truth[0, 0], known.truth)
    stack, _ = RefineTask(*pairs, augmentation=NONE, mix=MotionMix(0.0, 0.2)).batch(
        np.array([5]), np.random.default_rng(0)
    )
    np.testing.assert_array_equal(stack[0], pairs[0].example(5).stack())


def test_motions_of_other_data_are_not_mixed(data, pairs):
    every = ExtrapolationData(*find_files(data).require_pairs(), split="train")
    with pytest.raises(ValueError, match="other settings: fov_deg"):
        find_last_motions(every, 90.0, pairs[0].motions.folder)


def test_a_folder_of_recordings_is_not_elidar(data, tmp_path):
    assert elidar_in(data) is not None
    assert elidar_in(tmp_path) is None
    assert elidar_in(tmp_path / "nowhere") is None
    hdf5, _ = write_pairs(tmp_path / "half")
    (tmp_path / "half" / "manifest.json").write_text("{}")
    assert elidar_in(hdf5.parent) is None


def extrapolator(data, kind, out, *more):
    return [kind, f"--data={data}", f"--pairs={out}/pairs", "--workers=0", f"--out={out}/run",
            "--judge-every=1", *more]  # fmt: skip


SHORT = ("--refine.steps=1", "--refine.batch-size=2", "--channels", "8", "8")


def test_our_extrapolator_is_trained_by_the_same_command(data, tmp_path):
    arguments = extrapolator(data, "ours", tmp_path, *SHORT)
    assert train_extrapolator.main(arguments) == 0
    weights = tmp_path / "run" / train_extrapolator.WEIGHTS
    first = weights.read_bytes()
    assert load_learned(weights).refine is not None
    card = json.loads(weights.with_suffix(".json").read_text())
    assert card["data"]["train"]["names"] == ["Town01_Opt_00"]
    assert card["data"]["validation"]["names"] == ["Town02_Opt_ClearNoon"]
    assert card["training"]["mix"]["true"] == 0
    assert train_extrapolator.main([*arguments, "--resume"]) == 0
    assert weights.read_bytes() == first


@pytest.mark.parametrize("flag", ["--odometry", "--estimate", "--parts=motion"])
def test_trainings_by_true_motions_are_refused(data, tmp_path, flag, capsys):
    assert train_extrapolator.main(extrapolator(data, "ours", tmp_path, *SHORT, flag)) == 2
    assert "which ELiDAR does not hold" in capsys.readouterr().err


def test_the_papers_network_needs_no_motions(data, tmp_path):
    short = ("--training.steps=1", "--training.batch-size=2")
    assert train_extrapolator.main(extrapolator(data, "paper", tmp_path, *short)) == 0
    load_unet(tmp_path / "run" / train_extrapolator.WEIGHTS)
    assert not (tmp_path / "pairs").exists()


# Keyframe detectors.


def test_frames_are_held_out_and_read_when_asked_for(data):
    training, validation = open_elidar_frames(data / SLICING_FILE, 0.2)
    whole = SlicingData(data / SLICING_FILE, "train")
    assert sorted([*training.chosen, *validation.chosen]) == list(range(len(whole)))
    assert len(validation.chosen) / len(whole) == pytest.approx(0.2, abs=0.05)
    assert validation.chosen[0] < 12 < 105 < validation.chosen[-1]
    for part in (training, validation):
        frames = part.frames(0)
        assert len(frames) == part.length
        for place in (0, 3, part.length - 1):
            np.testing.assert_array_equal(frames[place : place + 1][0], whole[part.chosen[place]][0])
            assert part.causes(0)[place, 0] == (whole.scores[part.chosen[place]] == 1)
        assert frames[2:5].shape == (3, *SIZE) and frames[2:5].dtype == np.int8
    with pytest.raises(ValueError, match="held_out: found 0"):
        open_elidar_frames(data / SLICING_FILE, 0.0)


def test_the_label_alone_is_learnt(data):
    parts = open_elidar_frames(data / SLICING_FILE, 0.2)
    task = KeyframeTask(*parts, SampleOptions(flip=False, invert=False, noise=0.0))
    assert task.labels.shape == (1, parts[0].length, 1)
    frames, labels = task.batch(np.arange(4), np.random.default_rng(0))
    assert frames.shape == (4, 1, *SIZE) and labels.shape == (4, 1, 1)
    known = [parts[0].frames(0)[k : k + 1][0] for k in range(15)]
    for frame, label in zip(frames[:, 0], labels[:, 0, 0], strict=True):
        place = next(k for k, other in enumerate(known) if np.array_equal(frame, other))
        assert label == parts[0].causes(0)[place, 0]


def test_long_sequences_pass_a_network_in_bounded_blocks():
    assert block_length((120, 160)) == 256
    assert block_length((480, 640)) == 16
    assert block_length((4000, 4000)) == 1


@pytest.mark.parametrize("recipe", ["cnn", "paper"])
def test_detectors_are_trained_by_the_same_command(data, tmp_path, recipe):
    options = f"{recipe} --data {data} --held-out 0.2 --training.steps 2 --training.batch-size 4"
    assert train_keyframe.main([*options.split(), "--out", str(tmp_path / "run")]) == 0
    policy = KeyframeCNN.load(tmp_path / "run" / "best.safetensors")
    assert policy.network.size == SIZE
    card = json.loads((tmp_path / "run" / "best.json").read_text())
    assert card["data"]["training"]["release"] == "ELiDAR slicing"
    _, validation = open_elidar_frames(data / SLICING_FILE, 0.2)
    thresholds = calibrate(detect(policy.network, validation))
    assert thresholds == card["metrics"]["thresholds"]
    assert card["metrics"]["at_thresholds"]["f1"]["recall_by_cause"] == {}


def test_elidar_is_not_learnt_from_together_with_other_folders(data, tmp_path, capsys):
    assert train_keyframe.main(f"cnn --data {tmp_path} {data} --out {tmp_path}/run".split()) == 2
    assert "expected one folder with ELiDAR's files" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_whole_sequences_are_followed_in_pieces(data, monkeypatch):
    monkeypatch.setattr(elidar_frames, "PIECE", 20)
    training, validation = open_elidar_sequences(find_files(data), 0.1)
    assert (training.names, validation.names) == (["Town01_Opt_00"], ["Town02_Opt_ClearNoon"])
    assert (len(training), training.length) == (2, 20)  # of 59 slices
    source = NAMED[0][2]
    for number in range(2):
        slices = np.arange(20 * number + 1, 20 * number + 21)
        frames = training.frames(number)
        np.testing.assert_array_equal(frames[0:20], [source.event_frame(k) for k in slices])
        np.testing.assert_array_equal(training.causes(number).any(axis=1), source.keyframe[slices])
        np.testing.assert_array_equal(training.causes(number)[:, 0], source.speed[slices] > 10)
        np.testing.assert_array_equal(training.lidar(number), slices % 5 == 0)
    assert validation.weathers == ["ClearNoon"] * 2
    monkeypatch.setattr(elidar_frames, "PIECE", 60)
    with pytest.raises(ValueError, match=r"npz: found 59 slices, expected at least 60"):
        open_elidar_sequences(find_files(data), 0.1)


def test_a_broken_raw_sequence_can_be_left_out_and_is_named(data, tmp_path, monkeypatch):
    monkeypatch.setattr(elidar_frames, "PIECE", 20)
    copy = tmp_path / "data"
    shutil.copytree(data, copy)
    broken = copy / RAW_FOLDER / "Town09_Opt_00.npz"
    broken.write_bytes((copy / RAW_FOLDER / "Town01_Opt_00.npz").read_bytes()[:-100])
    with open(copy / "slicing" / "train_sequences.txt", "a") as names:
        names.write("Town09_Opt_00\n")
    with pytest.raises(ValueError, match=r"Town09_Opt_00.npz: not a readable .npz"):
        open_elidar_sequences(find_files(copy), 0.1)
    with pytest.warns(UserWarning, match=r"left out Town09_Opt_00: .*not a readable .npz"):
        training, validation = open_elidar_sequences(find_files(copy), 0.1, "skip")
    assert (training.names, validation.names) == (["Town01_Opt_00"], ["Town02_Opt_ClearNoon"])


def test_a_detector_with_a_memory_keeps_its_first_half(data, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(elidar_frames, "PIECE", 20)
    options = {"height": 40, "width": 48, "channels": [4, 4, 4], "hidden": 8, "memory_size": 8}
    first = tmp_path / "first.safetensors"
    tensors = TemporalDetector(**options).state_dict()
    write_weights(first, tensors, Card("untrained", "keyframe-cnn-temporal", options))
    command = f"temporal --data {data} --first-half {first} --out {tmp_path}/run --memory-training.steps 2"
    more = "--memory-training.batch-size 2 --memory-sampling.window 9 --memory-sampling.stride 3"
    assert train_keyframe.main([*command.split(), *more.split()]) == 0
    network = KeyframeCNN.load(tmp_path / "run" / "best.safetensors").network
    kept = {name: torch.equal(tensor, tensors[name]) for name, tensor in network.state_dict().items()}
    assert {name.split(".")[0] for name, same in kept.items() if not same} == {"inputs", "recurrent", "head"}
    (tmp_path / "bare").mkdir()
    shutil.copy(data / SLICING_FILE, tmp_path / "bare")
    assert train_keyframe.main(f"temporal --data {tmp_path}/bare --out {tmp_path}/no".split()) == 2
    assert "a detector with a memory learns from whole sequences" in capsys.readouterr().err
