"""Exported files have ELiDAR's layout and read back as what was recorded."""

import hashlib
import json
import pickle

import h5py
import numpy as np
import pytest
from elidar_files import SIZE, Source, export

from nl_env.config import SPLITS, DrivingConfig, SceneConfig
from nl_env.elidar import ExtrapolationData, RawSequence, SlicingData, find_files, read_sequence_list
from nl_env.elidar.export import ExportOptions, write_part
from nl_env.elidar.layout import (
    DURATIONS,
    METADATA_FILE,
    PAIRS_FILE,
    RAW_FOLDER,
    SEQUENCE_LISTS,
    SLICING_FILE,
)
from nl_env.elidar.plan import draw_pairs, sequence_names, split_of_seed
from nl_env.recording import record_sequence
from scripts import export_elidar

NAMED = [
    ("Town05_Opt_ClearNoon", "train", Source(1)),
    ("Town05_Opt_00", "train", Source(2)),
    ("Town04_Opt_WetNoon", "test", Source(3)),
]


@pytest.fixture(scope="module")
def data_folder(tmp_path_factory):
    return export(tmp_path_factory.mktemp("export"), NAMED)


def test_the_layout_is_the_release_s(data_folder):
    with h5py.File(data_folder / PAIRS_FILE) as file:
        assert set(file) == {name for name, _, _ in NAMED}
        for name in file:
            assert set(file[name]) == {"depth_frames", "events"}
            assert file[f"{name}/depth_frames"].shape[1:] == (1, *SIZE)
            assert file[f"{name}/events"].shape[1:] == (5, *SIZE)
    with h5py.File(data_folder / SLICING_FILE) as file:
        assert {split: set(file[split]) for split in file} == {
            split: {"event_frames", "scores"} for split in ("train", "test")
        }
        assert file["train/event_frames"].shape == (2 * 29, *SIZE)
        assert file["test/scores"].shape == (29,)
    assert read_sequence_list(data_folder / SEQUENCE_LISTS["train"]) == (
        "Town05_Opt_ClearNoon",
        "Town05_Opt_00",
    )
    assert read_sequence_list(data_folder / SEQUENCE_LISTS["test"]) == ("Town04_Opt_WetNoon",)
    header, first, *_ = (data_folder / METADATA_FILE).read_text().split("\n")
    assert header == "split,sequence,events_id,prior_depth_frame_id,gt_depth_frame_id,duration"
    assert first.startswith("train,Town05_Opt_ClearNoon,0,0,")
    found = find_files(data_folder)
    assert found.pairs == data_folder / PAIRS_FILE
    assert set(found.raw) == {name for name, _, _ in NAMED}


def test_pairs_come_back_as_recorded(data_folder):
    data = ExtrapolationData(data_folder / PAIRS_FILE, data_folder / METADATA_FILE)
    sources = {name: source for name, _, source in NAMED}
    assert {name: pairs.split for name, pairs in data.sequences.items()} == {n: s for n, s, _ in NAMED}
    index = 0
    for name, pairs in data.sequences.items():
        for row in range(len(pairs)):
            pair = data[index]
            t0, t1 = (5000 * int(data.ticks[name][frame[row]]) for frame in (pairs.prior, pairs.truth))
            np.testing.assert_array_equal(pair.prior, sources[name].depth(t0))
            np.testing.assert_array_equal(pair.truth, sources[name].depth(t1))
            np.testing.assert_array_equal(pair.voxel, sources[name].voxel(t0, t1))
            index += 1
    assert index == len(data)


def test_no_return_is_stored_beyond_the_range_as_carla_does(data_folder):
    """The released evaluation keeps pixels below 200 m, so a stored zero would count as truth."""
    with h5py.File(data_folder / PAIRS_FILE) as file:
        depth = file["Town05_Opt_00/depth_frames"][0, 0]
    assert (depth[0] == 1000).all()
    assert (depth[1:] < 200).all()


def test_event_frames_and_labels_come_back_as_recorded(data_folder):
    train = SlicingData(data_folder / SLICING_FILE, "train")
    for k in range(1, 30):
        for start, (_, _, source) in zip((0, 29), NAMED[:2], strict=True):
            frame, score = train[start + k - 1]
            np.testing.assert_array_equal(frame, source.event_frame(k))
            assert score == source.keyframe[k]
    for name, _, source in NAMED:
        raw = RawSequence(data_folder / RAW_FOLDER / f"{name}.npz")
        assert len(raw) == source.slices - 1
        for k in range(1, 30):
            np.testing.assert_array_equal(raw.frame(k - 1), source.event_frame(k))
        np.testing.assert_array_equal(raw.keyframe, source.keyframe[1:30])
        np.testing.assert_array_equal(raw.ego_speed, source.speed[1:30])
        np.testing.assert_array_equal(raw.shortest_distance, source.shortest_distance[1:30])
        np.testing.assert_array_equal(raw.new_actors, source.new_actors[1:30])


def test_drawn_slices_are_a_sorted_sample(tmp_path):
    options = ExportOptions(slices_per_sequence=7, raw=False)
    folder = export(tmp_path, NAMED[:1], options)
    data = SlicingData(folder / SLICING_FILE, "train")
    source = NAMED[0][2]
    every = [source.event_frame(k) for k in range(1, 30)]
    places = [next(k for k, frame in enumerate(every) if np.array_equal(frame, data[i][0])) for i in range(7)]
    assert places == sorted(set(places))
    np.testing.assert_array_equal(data.scores, source.keyframe[1:30][places])
    assert len(SlicingData(folder / SLICING_FILE, "test")) == 0
    assert not (folder / RAW_FOLDER).exists()


def test_pairs_are_drawn_as_in_the_release():
    """Three walks from tick 0, about 350 pairs in 20 s, every gap about as often, an end at 3996 or 3998."""
    plans = [draw_pairs(4000, np.random.default_rng(seed)) for seed in range(80)]
    assert {int(plan.ticks[-1]) for plan in plans} == {3996, 3998}
    assert 345 < np.mean([len(plan.prior) for plan in plans]) < 358
    durations, counts = np.unique(np.concatenate([plan.duration for plan in plans]), return_counts=True)
    assert tuple(durations) == DURATIONS
    assert counts.max() / counts.min() < 1.15
    for plan in plans:
        assert np.count_nonzero(plan.prior == 0) == 3
        assert (np.diff(plan.prior) >= 0).all()
        np.testing.assert_array_equal(plan.ticks[plan.truth] - plan.ticks[plan.prior], plan.duration)
    with pytest.raises(ValueError, match="found 4, expected more than 4"):
        draw_pairs(4, np.random.default_rng(0))


def test_names_are_the_release_s_and_distinct():
    descriptions = [
        {"scenario": "intersection", "weather": "ClearNoon"},
        {"scenario": "intersection", "weather": "ClearNoon"},
        {"scenario": "highway", "weather": "MidRainNoon"},
        {"scenario": "intersection", "weather": "ClearNoon"},
        {},
    ]
    assert sequence_names(descriptions) == [
        "Town05_Opt_ClearNoon",
        "Town05_Opt_00",
        "Town04_Opt_MidRainyNoon",
        "Town05_Opt_01",
        "Town10HD_Opt_00",
    ]


def test_seeds_decide_the_split():
    assert split_of_seed(SPLITS["train"][5]) == "train"
    assert split_of_seed(SPLITS["test"][5]) == "test"
    with pytest.raises(ValueError, match="of split 'val', expected one of train or test"):
        split_of_seed(SPLITS["val"][5])


def test_the_same_source_gives_the_same_bytes(tmp_path, data_folder):
    again = export(tmp_path, NAMED)
    files = sorted(path.relative_to(again) for path in again.rglob("*") if path.is_file())
    assert len(files) == 8
    for file in files:
        digests = [
            hashlib.sha256((folder / file).read_bytes()).hexdigest() for folder in (again, data_folder)
        ]
        assert digests[0] == digests[1], file


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (Source(1, depth_period_us=20_000), "found depth every 20 ms, expected every 10 ms or finer"),
        (Source(1, slices=1), "found a sequence of 1 slices, expected at least 2"),
    ],
)
def test_sources_that_cannot_be_exported_are_refused_and_leave_nothing(tmp_path, source, message):
    with pytest.raises(ValueError, match=f"Town05_Opt_00: {message}"):
        write_part(tmp_path / "part.h5", source, "Town05_Opt_00", "train", ExportOptions(), tmp_path)
    assert not list(tmp_path.iterdir())


def test_options_are_validated():
    for arguments in ({"slices_per_sequence": -1}, {"seed": -1}):
        with pytest.raises(ValueError, match=f"{next(iter(arguments))}: found -1"):
            ExportOptions(**arguments)


# The command.


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recordings")
    config = DrivingConfig(scene=SceneConfig(scenario="highway", duration_s=0.2))
    for seed in (SPLITS["train"][0], SPLITS["test"][0]):
        record_sequence(folder / f"{seed}.h5", config, seed, 10_000)
    return folder


def content(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_the_command_exports_recordings(tmp_path, recordings, capsys):
    arguments = [str(recordings), "--keep-resolution", "--workers", "0", "--out"]
    assert export_elidar.main([*arguments, str(tmp_path / "data")]) == 0
    assert "1 training and 1 test sequences" in capsys.readouterr().out
    data = find_files(tmp_path / "data")
    pairs = ExtrapolationData(*data.require_pairs())
    assert pairs.shape == (120, 160)
    assert {pair.split for pair in pairs.sequences.values()} == {"train", "test"}
    sequences = json.loads((tmp_path / "data/sequences.json").read_text())
    assert [entry["name"] for entry in sequences] == list(pairs.sequences)
    assert all(entry["description"]["scenario"] == "highway" for entry in sequences)
    assert pickle.loads(pickle.dumps(pairs))[0].voxel.any()


def test_an_interrupted_export_resumes_to_the_same_files(tmp_path, recordings, capsys, monkeypatch):
    arguments = [str(recordings), "--keep-resolution", "--workers", "0", "--out"]
    folders = tmp_path / "whole", tmp_path / "interrupted"
    assert export_elidar.main([*arguments, str(folders[0])]) == 0

    def interrupt(path, source, name, split, options, data_folder):
        if split == "test":
            raise KeyboardInterrupt
        write_part(path, source, name, split, options, data_folder)

    with monkeypatch.context() as patch:
        patch.setattr(export_elidar, "write_part", interrupt)
        assert export_elidar.main([*arguments, str(folders[1])]) == 130
    assert "--resume" in capsys.readouterr().err
    assert not (folders[1] / PAIRS_FILE).exists()
    assert export_elidar.main([*arguments, str(folders[1])]) == 2
    assert "already holds another run" in capsys.readouterr().err
    assert export_elidar.main([*arguments, str(folders[1]), "--resume"]) == 0
    assert content(folders[1]) == content(folders[0])
    assert export_elidar.main([*arguments, str(folders[1]), "--resume"]) == 0
    assert "finished before" in capsys.readouterr().out
    assert content(folders[1]) == content(folders[0])


def test_the_command_refuses_what_is_not_elidar(tmp_path, recordings, capsys):
    out = ["--out", str(tmp_path / "data"), "--workers", "0"]
    assert export_elidar.main([str(recordings), *out]) == 2
    assert "(120, 160) images, expected (480, 640) as in ELiDAR" in capsys.readouterr().err
    assert export_elidar.main([str(recordings), str(recordings), "--keep-resolution", *out]) == 2
    assert "found seed 0 twice" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert export_elidar.main([str(tmp_path / "empty"), *out]) == 2
    assert "found no .h5 in" in capsys.readouterr().err
    assert not (tmp_path / "data").exists()
