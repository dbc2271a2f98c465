import pickle

import numpy as np
import pytest
from short_recordings import record

from nl_env.depth.motion import estimate_motion
from nl_env.depth.pairs import PAPER_GAPS, PairOptions, Pairs, build_pairs, cut_pairs
from nl_env.recording import Recording
from nl_env.sensors.lidar import decode

OPTIONS = PairOptions(instants=3, gaps_ms=((20, 40), (50,), (100,)))
SEEDS = (3, 4)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    return record(tmp_path_factory.mktemp("recordings"), SEEDS, duration_s=0.4)


@pytest.fixture(scope="module")
def pairs(recordings, tmp_path_factory):
    return build_pairs(recordings, tmp_path_factory.mktemp("pairs") / "train", OPTIONS)


def test_a_pair_holds_what_the_recording_says(recordings, pairs):
    assert len(pairs) == 2 * 3 * 3
    for index in (0, 4, 8, 9, 17):
        pair = pairs[index]
        now, gap = int(pair["t_us"]), int(pair["gap_us"])
        with Recording(recordings / f"sequences/{SEEDS[index // 9]}.h5") as recording:
            for name, t in (("previous", now - 100_000), ("prior", now), ("truth", now + gap)):
                np.testing.assert_array_equal(decode(pair[name], 200.0), recording.depth(t))
            np.testing.assert_array_equal(pair["voxel"], recording.voxel(now, now + gap))
            here, then = recording.pose(now), recording.pose(now + gap)
            np.testing.assert_allclose(then @ pair["true_motion"], here, atol=1e-9)
            before = recording.pose(now - 100_000)
            np.testing.assert_allclose(here @ pair["true_last_motion"], before, atol=1e-9)
            old, new = decode(pair["previous"], 200.0), decode(pair["prior"], 200.0)
            expected = estimate_motion(old, new, recording.camera, 200.0)
            np.testing.assert_array_equal(pair["last_motion"], expected)


def test_every_group_gives_one_of_its_gaps(pairs):
    gaps = np.array([int(pairs[index]["gap_us"]) // 1000 for index in range(len(pairs))]).reshape(-1, 3)
    assert set(gaps[:, 0]) == {20, 40}
    assert set(gaps[:, 1]) == {50} and set(gaps[:, 2]) == {100}
    times = [int(pairs[index]["t_us"]) for index in range(0, 9, 3)]
    assert times == sorted(set(times))


def test_built_pairs_are_opened_again_and_an_interrupted_build_is_finished(recordings, pairs, tmp_path):
    first = build_pairs(recordings, tmp_path / "again", OPTIONS)
    lost = tmp_path / "again/sequences/4.npy"
    kept = lost.read_bytes()
    lost.unlink()
    finished = []
    again = build_pairs(recordings, tmp_path / "again", OPTIONS, progress=finished.append)
    assert finished == [1, 1]
    assert lost.read_bytes() == kept == (pairs.folder / "sequences/4.npy").read_bytes()
    assert len(again) == len(first)


def test_pairs_of_other_options_are_not_mixed(recordings, pairs):
    with pytest.raises(ValueError, match="other settings"):
        build_pairs(recordings, pairs.folder, PairOptions(instants=2, gaps_ms=OPTIONS.gaps_ms))


def test_they_pickle_as_a_path(pairs):
    copy = pickle.loads(pickle.dumps(pairs))
    assert copy[7].tobytes() == pairs[7].tobytes()
    assert len(pickle.dumps(pairs)) < 1000


def test_bad_input_is_named(recordings, pairs, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"manifest\.json"):
        build_pairs(tmp_path, tmp_path / "out", OPTIONS)
    for content in ("[]", '{"split": "train"}', "{"):
        (tmp_path / "manifest.json").write_text(content)
        with pytest.raises(ValueError, match=r"found no manifest of recordings in .*manifest\.json"):
            build_pairs(tmp_path, tmp_path / "out", OPTIONS)
    with pytest.raises(FileNotFoundError, match=r"settings\.json"):
        Pairs(tmp_path)
    with pytest.raises(IndexError, match="18"):
        pairs[18]
    with (
        Recording(recordings / "sequences/3.h5") as recording,
        pytest.raises(ValueError, match=r"3\.h5.*instants"),
    ):
        cut_pairs(recording, PairOptions(instants=3, gaps_ms=PAPER_GAPS))
    for wrong in ({"instants": 0}, {"gaps_ms": ()}, {"gaps_ms": ((0,),)}, {"lidar_period_ms": 0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            PairOptions(**wrong)


@pytest.mark.parametrize("damage", ["truncated", "other array", "pickle"])
def test_damaged_files_are_named(recordings, tmp_path, damage):
    pairs = build_pairs(recordings, tmp_path / "pairs", OPTIONS)
    path = tmp_path / "pairs/sequences/4.npy"
    if damage == "truncated":
        path.write_bytes(path.read_bytes()[:-100])
    elif damage == "other array":
        np.save(path, np.zeros(9))
    else:
        np.save(path, np.array([{"a": 1}], object), allow_pickle=True)
    damaged = Pairs(pairs.folder)
    assert damaged[0]["gap_us"] > 0
    with pytest.raises(ValueError, match=r"4\.npy"):
        damaged[9]
