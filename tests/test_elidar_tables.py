"""The tables on ELiDAR's files equal what the released evaluation computes, and say what they leave out."""

import json
import shutil

import h5py
import numpy as np
import pytest
from elidar_files import Source, export

from agents.keyframe_networks import ARCHITECTURES
from nl_env.depth.metrics import PAPER_METRICS
from nl_env.elidar import ExtrapolationData, RawSequence, find_files
from nl_env.elidar.layout import PAIRS_FILE, RAW_FOLDER, SLICING_FILE
from nl_env.reproduction.elidar import WEATHER_GROUPS, weather_of
from nl_env.weight_files import Card, write_weights
from scripts import reproduce

SIZE = (40, 48)
TEST = {
    "Town02_Opt_MidRainyNoon": Source(2, slices=60, size=SIZE),
    "Town03_Opt_05": Source(3, slices=60, size=SIZE),
}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    named = [("Town01_Opt_00", "train", Source(1, slices=60, size=SIZE))]
    named += [(name, "test", source) for name, source in TEST.items()]
    return export(tmp_path_factory.mktemp("export"), named)


@pytest.fixture(scope="module")
def detectors(tmp_path_factory):
    """Untrained detectors."""
    folder = tmp_path_factory.mktemp("weights")
    paths = []
    for name in ("keyframe-cnn", "keyframe-cnn-temporal"):
        options = {"height": SIZE[0], "width": SIZE[1]}
        card = Card("untrained", name, options, metrics={"thresholds": {"default": 0.5}})
        paths.append(folder / f"{name}.safetensors")
        write_weights(paths[-1], ARCHITECTURES[name](**options).state_dict(), card)
    return [str(path) for path in paths]


def run(table, data, out, *more):
    """The figures of a table."""
    options = [table, "--data", str(data), "--workers", "0", "--out", str(out), *more]
    assert reproduce.main(options) == 0
    return json.loads((out / "results.json").read_text())["figures"]


def released_metrics(prior, truth):
    """The paper's metrics as the released notebook computes them, over pixels below 200 m."""
    mask = (truth > 0) & (truth < 200)
    prior, truth = prior[mask].astype(float).clip(1e-8), truth[mask].astype(float)
    ratio = np.maximum(prior / truth, truth / prior)
    return (
        np.sqrt(np.mean((prior - truth) ** 2)),
        np.sqrt(np.mean((np.log(prior) - np.log(truth)) ** 2)),
        np.mean(np.abs(prior - truth) / truth),
        np.mean((prior - truth) ** 2 / truth),
        *(np.mean(ratio < 1.25**power) for power in (1, 2, 3)),
    )


def test_repeat_by_gap_is_that_of_the_released_evaluation(data, tmp_path, capsys):
    nothing = ("--weights", "--paper-weights", "--pairs", "1000")
    figures = run("table-rates", data, tmp_path / "out", *nothing)
    assert set(figures) == {"repeat", "linear", "exponential", "warp"}
    assert "rows with the true motion are left out" in capsys.readouterr().out
    release = ExtrapolationData(*find_files(data).require_pairs(), split="test")
    by_gap = {"adaptive": {name: [] for name in TEST}}
    for index in range(len(release)):
        pair = release[index]
        found = released_metrics(pair.prior, pair.truth)
        for group in ("adaptive", str(pair.duration * 5)):
            by_gap.setdefault(group, {name: [] for name in TEST})[pair.sequence].append(found)
    assert len(by_gap) == 6
    for group, by_sequence in by_gap.items():
        expected = np.mean([np.mean(values, axis=0) for values in by_sequence.values() if values], axis=0)
        measured = [figures["repeat"][group][metric]["mean"] for metric in PAPER_METRICS]
        np.testing.assert_allclose(measured, expected, rtol=1e-5)


def test_fewer_pairs_are_drawn_by_the_seed_alone(data, tmp_path):
    nothing = ("--weights", "--paper-weights", "--pairs", "2")
    first, again = (run("table-rates", data, tmp_path / name, *nothing) for name in "ab")
    assert first == again
    one = run("table-rates", data, tmp_path / "c", *nothing, "--sequences", "1")
    assert one["repeat"] != first["repeat"]
    assert reproduce.main(["table-rates", "--data", str(data), *nothing, "--sequences", "3"]) == 2


def test_keyframes_by_weather_come_from_sequence_names(data, detectors, tmp_path, capsys):
    options = ("--weights", detectors[0], "--temporal-weights", detectors[1], "--train", str(data))
    figures = run("table-keyframe", data, tmp_path / "out", *options)
    assert "beside the published" in capsys.readouterr().out
    labels = [RawSequence(data / RAW_FOLDER / f"{name}.npz").keyframe for name in TEST]
    assert figures["splits"]["test"]["keyframes"] == pytest.approx(np.concatenate(labels).mean())
    assert figures["splits"]["train"]["sequences"] == 1
    assert set(figures["weathers"]) == {"MidRainNoon", "Rain"}  # the numbered sequence says no weather
    assert figures["weathers"]["Rain"]["keyframes"] == pytest.approx(labels[0].mean())
    causes = figures["cause_shares"]
    speeds = np.concatenate([source.speed[1:60] for source in TEST.values()])
    assert causes["speed"] == pytest.approx((speeds > 10).mean())


def test_without_raw_sequences_the_labelled_frames_are_one_sequence(data, detectors, tmp_path, capsys):
    (tmp_path / "data").mkdir()
    shutil.copy(data / SLICING_FILE, tmp_path / "data")
    options = ("--weights", detectors[0], "--temporal-weights", "--train", str(tmp_path / "data"))
    figures = run("table-keyframe", tmp_path / "data", tmp_path / "out", *options)
    assert "no causes, no weather" in capsys.readouterr().out
    assert figures["weathers"] == {} == figures["cause_shares"]
    assert figures["splits"]["test"]["keyframes"] == pytest.approx(
        np.mean([source.keyframe[1:60].mean() for source in TEST.values()])
    )
    assert set(figures["splits"]) == {"train", "test"}


def end_to_end(data, detectors, out, *more):
    weights = ("--weights", "None", "--paper-weights", "None")
    weights += ("--keyframe-weights", detectors[0], "--temporal-weights", detectors[1])
    return run("table-end-to-end", data, out, *weights, *more)


def test_end_to_end_holds_or_extrapolates_at_the_stored_pairs(data, detectors, tmp_path):
    found = end_to_end(data, detectors, tmp_path / "out", "--pairs", "1000")
    held = {policy: by["warp"]["rmse"]["mean"] for policy, by in found["held"].items()}
    release = ExtrapolationData(*find_files(data).require_pairs(), split="test")
    pairs = [release[index] for index in range(len(release))]
    short = [[p for p in pairs if p.duration in (4, 10) and p.sequence == name] for name in TEST]
    repeat = np.mean([np.mean([released_metrics(p.prior, p.truth)[0] for p in part]) for part in short])
    assert held["never"] == pytest.approx(repeat, rel=1e-4)
    assert min(held["never"], held["always"]) <= held["keyframe-rule*"] <= max(held["never"], held["always"])
    rates = {policy: summary["rate"]["mean"] for policy, summary in found["policies"].items()}
    lidar = 11 / (59 * 0.02)
    assert (rates["never"], rates["always"]) == (pytest.approx(lidar), pytest.approx(50.0))
    rule = [np.count_nonzero(s.keyframe[1:60] | (np.arange(1, 60) % 5 == 0)) / 1.18 for s in TEST.values()]
    assert rates["keyframe-rule*"] == pytest.approx(np.mean(rule))
    assert found["policies"]["keyframe-rule*"]["f1"]["mean"] == 1.0
    assert set(found["held"]) == {
        "never",
        "always",
        "keyframe-rule*",
        "keyframe-cnn",
        "keyframe-cnn-temporal",
    }


def test_sequences_that_either_release_trains_on_are_left_out(data, detectors, tmp_path, capsys):
    copy = tmp_path / "data"
    shutil.copytree(data, copy)
    lists = copy / "slicing"
    (lists / "train_sequences.txt").write_text("Town01_Opt_00\nTown03_Opt_05\n")
    (lists / "test_sequences.txt").write_text("Town02_Opt_MidRainyNoon\n")
    with pytest.warns(UserWarning, match="left out 1 test sequences .*: Town03_Opt_05"):
        end_to_end(copy, detectors, tmp_path / "out")
    text = (tmp_path / "out" / "table.md").read_text()
    assert "1 test sequences (release ELiDAR, resolution 40x48)" in text
    shutil.rmtree(copy / RAW_FOLDER)
    arguments = ["table-end-to-end", "--data", str(copy), "--weights", "None", "--paper-weights", "None"]
    assert reproduce.main([*arguments, "--out", str(tmp_path / "no")]) == 2
    assert "found no raw sequences" in capsys.readouterr().err


def truncate(data):
    """Cut the raw sequence off: it cannot be opened."""
    file = data / RAW_FOLDER / "Town03_Opt_05.npz"
    file.write_bytes(file.read_bytes()[:-100])
    return "Town03_Opt_05.npz: not a readable .npz"


def flip_event_frames(data):
    """Damage what is found when event frames are read, after opening."""
    file = data / RAW_FOLDER / "Town03_Opt_05.npz"
    content = bytearray(file.read_bytes())
    for place in range(200, 1000):
        content[place] ^= 0xFF
    file.write_bytes(content)
    return "Town03_Opt_05.npz: frames"


def flip_depth(data):
    """Damage a compressed chunk of depth, which is found when it is read."""
    with h5py.File(data / PAIRS_FILE, "r") as file:
        frames = file["Town03_Opt_05/depth_frames"]
        places = [frames.id.get_chunk_info(k) for k in range(frames.id.get_num_chunks())]
    with open(data / PAIRS_FILE, "r+b") as file:
        for chunk in places:
            file.seek(chunk.byte_offset + chunk.size // 3)
            file.write(b"\xff" * 8)
    return "Town03_Opt_05/depth_frames"


@pytest.mark.parametrize(
    ("table", "damage"),
    [
        ("table-keyframe", truncate),
        ("table-keyframe", flip_event_frames),
        ("table-rates", flip_depth),
        ("table-end-to-end", truncate),
        ("table-end-to-end", flip_depth),
    ],
)
def test_a_damaged_sequence_is_left_out_when_asked_and_named(
    data, detectors, tmp_path, capsys, table, damage
):
    shutil.copytree(data, tmp_path / "data")
    told = damage(tmp_path / "data")
    options = [table, "--data", str(tmp_path / "data"), "--workers", "0", "--out", str(tmp_path / "out")]
    if table == "table-keyframe":
        options += ["--weights", detectors[0], "--temporal-weights"]
    elif table == "table-rates":
        options += ["--weights", "--paper-weights", "--pairs", "2"]
    else:
        options += ["--weights", "None", "--keyframe-weights", detectors[0]]
        options += ["--temporal-weights", detectors[1]]
    assert reproduce.main(options) == 2
    assert told in capsys.readouterr().err
    with pytest.warns(UserWarning, match="left out") as warned:
        assert reproduce.main([*options, "--on-error", "skip", "--overwrite"]) == 0
    assert any(told in str(warning.message) for warning in warned)
    text = (tmp_path / "out" / "table.md").read_text()
    assert "1 test sequences (release ELiDAR" in text
    (left_out,) = json.loads((tmp_path / "out" / "results.json").read_text())["left_out"]
    assert told in left_out and f"Left out: {left_out}." in text


def test_when_nothing_is_left_the_reasons_are_given(data, tmp_path, capsys):
    shutil.copytree(data, tmp_path / "data")
    with h5py.File(tmp_path / "data" / PAIRS_FILE, "r+") as file:
        for name in TEST:
            file[f"{name}/depth_frames"][...] = -1.0
    options = ["table-rates", "--data", str(tmp_path / "data"), "--workers", "0", "--weights"]
    options += ["--out", str(tmp_path / "out"), "--on-error", "skip"]
    with pytest.warns(UserWarning, match="left out"):
        assert reproduce.main(options) == 2
    told = capsys.readouterr().err
    assert "found no sequence that can be read" in told and all(name in told for name in TEST)


def test_half_of_a_release_is_refused(data, tmp_path, capsys):
    (tmp_path / "half").mkdir()
    shutil.copy(data / PAIRS_FILE, tmp_path / "half")
    arguments = ["table-rates", "--weights", "--paper-weights", "--data", str(tmp_path / "half")]
    assert reproduce.main([*arguments, "--out", str(tmp_path / "out")]) == 2
    assert "metadata.csv" in capsys.readouterr().err


def test_weathers_are_grouped_as_in_the_release():
    assert weather_of("Town02_Opt_MidRainyNoon") == "MidRainNoon"
    assert weather_of("Town02_Opt_07") == "unknown"
    assert WEATHER_GROUPS["Wet"] == ("WetNoon", "WetSunset")
    assert len(WEATHER_GROUPS["Rain"]) == 6
