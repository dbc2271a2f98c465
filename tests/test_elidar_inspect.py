"""The inspection says what is in files and folders, and what is wrong with them."""

import json

import h5py
import numpy as np
import pytest
from elidar_files import SIZE, Source, export, write_pairs, write_raw
from PIL import Image

from nl_env.config import DrivingConfig, SceneConfig
from nl_env.inspection import Reading, inspect_path
from nl_env.recording import record_sequence
from nl_env.weight_files import Card, write_weights
from scripts import inspect_data

NAME = "Town01_Opt_00"


@pytest.fixture(scope="module")
def data_folder(tmp_path_factory):
    named = [("Town01_Opt_00", "train", Source(1)), ("Town02_Opt_ClearNoon", "test", Source(2))]
    return export(tmp_path_factory.mktemp("export"), named)


def by_kind(path, **reading):
    return {found.kind: found for found in inspect_path(path, Reading(**reading))}


def test_every_part_of_a_release_is_described(data_folder):
    found = by_kind(data_folder, verify=True)
    assert list(found) == [
        "ELiDAR extrapolation pairs",
        "ELiDAR labelled event frames",
        "ELiDAR raw sequences",
        "ELiDAR sequence lists",
    ]
    assert not any(findings.problems for findings in found.values())
    pairs = found["ELiDAR extrapolation pairs"].facts
    assert pairs["sequences"] == {"train": 1, "test": 1}
    assert set(pairs["pairs_by_gap_ms"]) <= {"20", "50", "100", "200", "500"}
    assert sum(pairs["pairs_by_gap_ms"].values()) == pairs["pairs"]
    assert pairs["resolution"] == "6x8"
    frames = found["ELiDAR labelled event frames"].facts
    assert (frames["train"]["frames"], frames["test"]["frames"]) == (29, 29)
    assert frames["test"]["keyframes"] == pytest.approx(Source(2).keyframe[1:30].mean())
    assert found["ELiDAR raw sequences"].facts["sequences"] == {"29 slices of 6x8": 2}
    assert found["ELiDAR sequence lists"].facts == {"train": 1, "test": 1}


def test_single_files_are_described(tmp_path, data_folder):
    write_raw(tmp_path / "raw.npz")
    assert inspect_path(tmp_path / "raw.npz", Reading())[0].facts["keyframes"] == 0.5
    hdf5, metadata = write_pairs(tmp_path / "pairs")
    assert inspect_path(metadata, Reading())[0].facts["depth_frames"] == 4
    assert inspect_path(hdf5, Reading())[0].kind == "ELiDAR extrapolation pairs"
    slicing = next(data_folder.rglob("slicing_dataset_v1.h5"))
    assert inspect_path(slicing, Reading())[0].kind == "ELiDAR labelled event frames"
    lists = next(data_folder.rglob("train_sequences.txt"))
    assert inspect_path(lists, Reading())[0].facts == {"sequences": 1}


def test_recordings_and_weights_are_described(tmp_path):
    torch = pytest.importorskip("torch")
    config = DrivingConfig(scene=SceneConfig(scenario="highway", weather="WetNoon", duration_s=0.2))
    record_sequence(tmp_path / "4.h5", config, 4, 10_000)
    write_weights(tmp_path / "net.safetensors", {"a": torch.zeros(2, 3)}, Card("A test.", "net"))
    (tmp_path / "5.h5").write_bytes((tmp_path / "4.h5").read_bytes()[:5000])
    recordings, weights = inspect_path(tmp_path, Reading(verify=True))
    assert recordings.facts["sequences"] == 1
    assert recordings.facts["kinds"] == {"120x160, LiDAR 10 Hz, depth every 10 ms": 1}
    assert recordings.facts["seconds"] == pytest.approx(0.2)
    assert recordings.facts["weathers"] == {"WetNoon": 1}
    assert len(recordings.problems) == 1
    assert "5.h5: not a readable HDF5 file" in recordings.problems[0]
    assert weights.facts["parameters"] == 6
    assert weights.facts["what"] == "A test."
    assert not weights.problems


def test_damage_is_found_when_everything_is_read(tmp_path):
    hdf5, _ = write_pairs(tmp_path)
    with h5py.File(hdf5, "r+") as file:
        file[f"{NAME}/depth_frames"][3, 0, 1, 1] = np.nan
    assert not inspect_path(tmp_path, Reading())[0].problems
    found = inspect_path(tmp_path, Reading(verify=True))[0]
    assert len(found.problems) == 2  # two pairs use the frame
    assert "depth_frames[3]: found depths" in found.problems[0]


def test_broken_and_missing_parts_are_problems(tmp_path):
    names = [("train", "Town01_Opt_00"), ("train", "Town02_Opt_00")]
    hdf5, metadata = write_pairs(tmp_path, names)
    metadata.write_text(metadata.read_text() + "train,Town02_Opt_00,5,0,3,32\n")
    found = inspect_path(tmp_path, Reading())[0]
    assert found.facts["sequences"] == {"train": 2}
    assert "Town02_Opt_00: found durations that contradict" in found.problems[0]

    (tmp_path / "train_sequences.txt").write_text("Town01_Opt_00\n")
    (tmp_path / "test_sequences.txt").write_text("Town02_Opt_00\n")
    lists = by_kind(tmp_path)["ELiDAR sequence lists"]
    assert "1 test sequences of the slicing release are training sequences" in lists.problems[0]

    hdf5.write_bytes(hdf5.read_bytes()[:3000])
    found = by_kind(tmp_path)
    assert "found the CSV but no extrapolation HDF5" in found["ELiDAR extrapolation CSV"].problems[-1]
    assert "pairs.h5: not a readable HDF5 file" in found["unreadable HDF5"].problems[0]


def test_the_command_prints_text_json_and_a_figure(tmp_path, data_folder, capsys):
    figure = tmp_path / "sheet.png"
    assert inspect_data.main([str(data_folder), "--figure", str(figure)]) == 0
    text = capsys.readouterr().out
    assert "ELiDAR extrapolation pairs: " in text
    assert "sequences: train 1, test 1" in text
    picture = Image.open(figure)
    tile = 120 * SIZE[1] // SIZE[0]
    assert picture.size == (16 * tile, 3 * 120)  # 8 event frames of each split are the widest row

    assert inspect_data.main([str(data_folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[3] == {
        "kind": "ELiDAR sequence lists",
        "path": str(data_folder),
        "train": 1,
        "test": 1,
        "problems": [],
    }


def test_the_command_reports_problems_by_its_exit_status(tmp_path, capsys):
    _, metadata = write_pairs(tmp_path)
    metadata.write_text(metadata.read_text() + f"train,{NAME},5,0,3,32\n")
    assert inspect_data.main([str(metadata)]) == 1
    assert "PROBLEM: " in capsys.readouterr().out
    for path, message in (
        (tmp_path / "nowhere", "no such file or folder"),
        (tmp_path / "notes.pdf", "found .pdf, expected a folder or one of .h5"),
    ):
        if path.suffix:
            path.write_bytes(b"%PDF")
        assert inspect_data.main([str(path)]) == 2
        assert message in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert inspect_data.main([str(tmp_path / "empty")]) == 2
    assert "found none of ELiDAR's files" in capsys.readouterr().err
    with h5py.File(tmp_path / "empty" / "other.h5", "w") as file:
        file["x"] = 1
    assert inspect_data.main([str(tmp_path / "empty" / "other.h5")]) == 2
    assert "neither a recording nor one of ELiDAR's" in capsys.readouterr().err
