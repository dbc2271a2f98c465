"""``nl_env/Replay-v0``: recordings replay as they were live, ELiDAR's pairs as irregular steps."""

import pickle
import warnings

import h5py
import numpy as np
import pytest
from elidar_files import SIZE, Source, export, write_pairs
from gymnasium.utils.env_checker import check_env as gymnasium_check
from rollouts import digest, rollout
from stable_baselines3.common.env_checker import check_env as sb3_check

from nl_env.config import SPLITS, DrivingConfig, SceneConfig
from nl_env.driving import DrivingEnv
from nl_env.elidar import find_files, frame_ticks, read_metadata
from nl_env.elidar.plan import draw_pairs
from nl_env.elidar.walks import find_walks
from nl_env.elidar_stream import UNKNOWN_SPEED, ElidarStream
from nl_env.observations import OBS_MODES
from nl_env.recording import record_sequence
from nl_env.replay import ReplayEnv
from nl_env.representations import voxel_from_bins

DURATION = 0.4
TRAIN, TEST = SPLITS["train"][7], SPLITS["test"][7]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recordings")
    config = DrivingConfig(scene=SceneConfig(scenario="highway", duration_s=DURATION))
    for seed in (TRAIN, TEST):
        record_sequence(folder / f"{seed}.h5", config, seed, 10_000, intensity=True)
    return folder


@pytest.fixture(scope="module")
def elidar(tmp_path_factory):
    """Larger images than the other tests use, as Stable-Baselines3 wants 36 pixels at least."""
    size = (40, 48)
    named = [
        ("Town01_Opt_00", "train", Source(1, slices=60, size=size)),
        ("Town02_Opt_ClearNoon", "test", Source(2, slices=60, size=size)),
    ]
    return export(tmp_path_factory.mktemp("export"), named)


@pytest.fixture(scope="module")
def bare(elidar, tmp_path_factory):
    """The extrapolation files alone."""
    folder = tmp_path_factory.mktemp("bare")
    for path in find_files(elidar).require_pairs():
        (folder / path.name).write_bytes(path.read_bytes())
    return folder


@pytest.fixture(params=["recordings", "elidar", "bare"])
def data(request):
    return request.getfixturevalue(request.param)


# Every kind of data.


@pytest.mark.parametrize("obs_mode", OBS_MODES)
def test_check_env_is_clean(data, obs_mode):
    env = ReplayEnv(data=data, obs_mode=obs_mode, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gymnasium_check(env, skip_render_check=True)
        if obs_mode != "signed":  # an int8 image always gets a warning
            sb3_check(env)
    env.reset(seed=0)
    assert env.render().dtype == np.uint8
    env.close()


def test_the_same_seed_gives_the_same_bytes_also_after_pickling(data):
    env = ReplayEnv(data=data)
    first = digest(rollout(env, 123, steps=4))
    assert digest(rollout(env, 123, steps=4)) == first
    assert digest(rollout(pickle.loads(pickle.dumps(ReplayEnv(data=data))), 123, steps=4)) == first
    starts = {digest(rollout(env, seed, steps=2)) for seed in range(100, 108)}
    assert len(starts) > 1
    env.reset(seed=0)
    copy = pickle.loads(pickle.dumps(env))
    left, right = env.step(1), copy.step(1)
    assert digest([(left[0], left[1], left[4])]) == digest([(right[0], right[1], right[4])])


# Recordings.


@pytest.mark.parametrize("obs_mode", ["image", "dict"])
def test_a_recording_replays_bit_for_bit(recordings, obs_mode):
    live = DrivingEnv(scenario="highway", duration=DURATION, obs_mode=obs_mode)
    replay = ReplayEnv(data=recordings, obs_mode=obs_mode)
    assert replay.found == "2 recordings"
    for seed in (TRAIN, TEST):
        assert digest(rollout(replay, seed, steps=20)) == digest(rollout(live, seed, steps=20))


def test_a_recording_replays_with_another_lidar(recordings):
    live = DrivingEnv(scenario="highway", duration=DURATION, lidar_hz=25, beams=32)
    replay = ReplayEnv(data=recordings / f"{TRAIN}.h5", lidar_hz=25, beams=32)
    assert digest(rollout(replay, TRAIN, steps=20)) == digest(rollout(live, TRAIN, steps=20))


def test_split_and_sequences_choose_recordings(recordings):
    assert ReplayEnv(data=recordings, split="test").stream.seeds == (TEST,)
    assert ReplayEnv(data=recordings, sequences=[TRAIN]).stream.seeds == (TRAIN,)
    env = ReplayEnv(data=recordings, split="test")
    assert env.reset(seed=1)[1] == env.reset(seed=TEST)[1]  # the only one to draw
    for arguments, message in (
        ({"split": "val"}, "found no recording of split 'val'"),
        ({"split": "all"}, "split: found 'all'"),
        ({"sequences": [5]}, "sequences: found 5, expected seeds of recordings"),
        ({"lidar_hz": 7}, "lidar_hz: found 7"),
    ):
        with pytest.raises(ValueError, match=message):
            ReplayEnv(data=recordings, **arguments)
    with pytest.raises(ValueError, match="seed: found 5, expected one of the 1 recorded"):
        env.reset(options={"sequence": 5})


# ELiDAR.


def test_every_pair_is_a_decision_once_and_a_step_is_a_stored_pair(elidar):
    stream = ElidarStream(elidar)
    decided = {name: [] for name in stream.data.sequences}
    for k, episode in enumerate(stream.episodes):
        pairs, source = stream.data.sequences[episode.sequence], SOURCES[episode.sequence]
        sample = stream.reset(k)
        assert sample.lidar is not None
        assert not sample.event_frame.any()
        for row in episode.rows:
            before, sample = sample, stream.advance()
            np.testing.assert_array_equal(sample.depth, source.depth(sample.t))
            np.testing.assert_array_equal(before.depth, source.depth(before.t))
            assert sample.t - before.t == 5000 * pairs.duration[row]
            window = source.voxel(before.t, sample.t)
            np.testing.assert_array_equal(voxel_from_bins([sample.bins]), window)
            np.testing.assert_array_equal(sample.event_frame, window.sum(axis=0))
            if sample.lidar is None:
                assert before.lidar is not None  # so the stored grid starts at the LiDAR frame
                decided[episode.sequence].append(int(row))
        with pytest.raises(RuntimeError, match="the sequence ended"):
            stream.advance()
    for name, rows in decided.items():
        assert sorted(rows) == list(range(len(stream.data.sequences[name])))


SOURCES = {
    "Town01_Opt_00": Source(1, slices=60, size=(40, 48)),
    "Town02_Opt_ClearNoon": Source(2, slices=60, size=(40, 48)),
}


def test_steps_are_scored_against_the_stored_depth_at_their_own_times(elidar):
    env = ReplayEnv(data=elidar, split="test", extrapolator="repeat", error="rmse", error_scale=1.0)
    assert env.found == "1 ELiDAR sequences, 6 episodes"
    _, info = env.reset(seed=0)
    times = env.stream.times_us
    assert info["t"] == times[0] == 0
    done, k, last_lidar = False, 0, 0
    while not done:
        k += 1
        _, reward, _, done, info = env.step(0)
        if k % 2 == 0:
            last_lidar = times[k]
        assert info["t"] == times[k]
        assert info["lidar"] == (k % 2 == 0)
        assert info["depth_age"] == times[k] - last_lidar
        assert info["rmse"] == pytest.approx((times[k] - last_lidar) / 20_000, abs=0.004)  # 1 m a slice
        assert reward == pytest.approx(-info["rmse"])
        assert info["effective_rate"] == pytest.approx((k // 2) * 1e6 / times[k])
    assert k == env.stream.slices


def test_labels_are_joined_from_raw_sequences(elidar, bare):
    env = ReplayEnv(data=elidar)
    for k, episode in enumerate(env.stream.episodes):
        source = SOURCES[episode.sequence]
        env.reset(seed=k)
        done = False
        while not done:
            before = env.stream.times_us[env.sample.index - 1]
            _, _, _, done, info = env.step(0)
            last = min(info["t"] // 20_000, source.slices - 1)
            assert info["ego_speed"] == source.speed[max(last, 1)]
            assert info["shortest_distance"] == source.shortest_distance[max(last, 1)]
            assert info["new_actors"] == source.new_actors[1:][before // 20_000 : last].sum()
    assert env.stream.describe()["labels"]
    env = ReplayEnv(data=bare)
    env.reset(seed=0)
    info = env.step(0)[4]
    assert (info["ego_speed"], info["shortest_distance"], info["keyframe"]) == (UNKNOWN_SPEED, np.inf, False)
    assert not env.stream.describe()["labels"]


def test_a_raw_sequence_of_other_events_is_not_joined(elidar, bare):
    other = Source(9, slices=60, size=(40, 48))
    raw = bare / "Town01_Opt_00.npz"
    names = ("frames", "key_frame", "ego_velocity", "shortest_distance", "num_new_actors")
    frames = np.stack([other.event_frame(k) for k in range(1, 60)])
    states = (other.keyframe, other.speed, other.shortest_distance, other.new_actors)
    np.savez(raw, **dict(zip(names, (frames, *(state[1:60] for state in states)), strict=True)))
    try:
        stream = ElidarStream(bare)
        with pytest.warns(UserWarning, match="is not the voxel grid of the same 20 ms"):
            stream.reset(0)
        assert not stream.describe()["labels"]
    finally:
        raw.unlink()


def test_the_released_splits_do_not_fit_and_that_is_said(elidar, bare):
    (bare / "train_sequences.txt").write_text("Town02_Opt_ClearNoon\n")
    try:
        with pytest.warns(UserWarning, match="1 of the test sequences are train .*: Town02_Opt_ClearNoon"):
            ElidarStream(bare, split="test")
    finally:
        (bare / "train_sequences.txt").unlink()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ElidarStream(elidar, split="test")


def test_walks_of_drawn_pairs_are_the_three_that_were_drawn(tmp_path):
    _, metadata = write_pairs(tmp_path)
    pairs = read_metadata(metadata).sequences[0]
    assert [walk.tolist() for walk in find_walks(pairs, frame_ticks(pairs))] == [[0, 3], [1, 2, 4]]
    for seed in range(5):
        plan = draw_pairs(4000, np.random.default_rng(seed))
        walks = find_walks(plan, plan.ticks)
        assert len(walks) == 3
        assert sorted(np.concatenate(walks)) == list(range(len(plan.prior)))
        for walk in walks:
            np.testing.assert_array_equal(plan.prior[walk[1:]], plan.truth[walk[:-1]])
            assert plan.prior[walk[0]] == 0


def test_what_does_not_fit_elidar_is_refused(elidar, bare, tmp_path):
    for arguments, message in (
        ({"odometry": True}, "odometry: found True, but ELiDAR .* holds no poses"),
        ({"lidar_hz": 5}, "ELiDAR has its own LiDAR"),
        ({"split": "val"}, "split: found 'val'"),
        ({"sequences": ["Town09_Opt_00"]}, "found 'Town09_Opt_00'"),
    ):
        with pytest.raises(ValueError, match=message):
            ReplayEnv(data=elidar, **arguments)
    with pytest.raises(ValueError, match="seed: found 99, expected an episode from 0 to 11"):
        ReplayEnv(data=elidar).reset(options={"sequence": 99})
    with pytest.raises(FileNotFoundError, match="found none of ELiDAR's files"):
        ReplayEnv(data=tmp_path)
    with pytest.raises(FileNotFoundError, match="no such file or folder"):
        ReplayEnv(data=tmp_path / "nowhere")
    with pytest.raises(ValueError, match="is no recording, expected a folder for ELiDAR"):
        ReplayEnv(data=next(bare.glob("*.h5")))


@pytest.mark.parametrize(("gone", "missing"), [(0, "voxel_grids_v1.h5"), (1, "voxel_grids_v1_metadata.csv")])
def test_half_of_the_files_cannot_be_replayed(tmp_path, gone, missing):
    files = write_pairs(tmp_path)
    files[gone].unlink()
    with pytest.raises(FileNotFoundError, match=f"found no .*{missing}, found only .*{files[1 - gone].name}"):
        ReplayEnv(data=tmp_path)


def test_broken_sequences_can_be_left_out_and_are_named(tmp_path):
    hdf5, _ = write_pairs(tmp_path, [("train", "Town01_Opt_00"), ("train", "Town02_Opt_00")], dtype="f4")
    with h5py.File(hdf5, "r+") as file:
        del file["Town02_Opt_00/events"]
    with pytest.raises(ValueError, match="Town02_Opt_00/events: found nothing"):
        ReplayEnv(data=tmp_path)
    with pytest.warns(UserWarning, match="left out Town02_Opt_00: .*Town02_Opt_00/events: found nothing"):
        env = ReplayEnv(data=tmp_path, on_error="skip", extrapolator="repeat")
    assert env.found.startswith("1 ELiDAR sequences")
    env.reset(seed=0)
    env.step(1)
    with pytest.raises(ValueError, match="on_error: found 'ignore'"):
        ReplayEnv(data=tmp_path, on_error="ignore")


def test_labels_that_cannot_be_read_can_be_left_out_and_are_named(tmp_path):
    write_pairs(tmp_path, dtype="f4")
    (tmp_path / "Town01_Opt_00.npz").write_bytes(b"PK\x03\x04")
    with pytest.raises(ValueError, match=r"Town01_Opt_00\.npz: not a readable \.npz"):
        ElidarStream(tmp_path).reset(0)
    stream = ElidarStream(tmp_path, on_error="skip")
    with pytest.warns(UserWarning, match=r"Town01_Opt_00 has no labels: .*not a readable \.npz"):
        sample = stream.reset(0)
    assert sample.state.speed == UNKNOWN_SPEED and not stream.describe()["labels"]


def test_damaged_files_beside_recordings_can_be_left_out_and_are_named(recordings, tmp_path):
    whole = (recordings / f"{TRAIN}.h5").read_bytes()
    (tmp_path / f"{TRAIN}.h5").write_bytes(whole)
    (tmp_path / f"{TEST}.h5").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=rf"{TEST}\.h5: not a readable HDF5 file"):
        ReplayEnv(data=tmp_path)
    with pytest.warns(UserWarning, match=rf"left out .*{TEST}\.h5: not a readable HDF5 file"):
        env = ReplayEnv(data=tmp_path, on_error="skip")
    assert env.found == "1 recordings"


def test_damage_met_in_a_replay_is_named(tmp_path):
    hdf5, _ = write_pairs(tmp_path, dtype="f4")
    with h5py.File(hdf5, "r+") as file:
        file["Town01_Opt_00/events"][0, 1, 2, 3] = 0.5
    stream = ElidarStream(tmp_path)
    assert stream.camera.shape == SIZE
    stream.reset(0)
    with pytest.raises(ValueError, match=r"events\[0\]: found values that are not whole numbers"):
        stream.advance()
