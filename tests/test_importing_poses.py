"""Camera poses of real recordings: what follows from them, and what is refused."""

import math

import gymnasium as gym
import h5py
import numpy as np
import pytest
from event_files import driving_poses, some_events, write_depth, write_m3ed, write_poses

from nl_env.importing import (
    DepthMaps,
    ImportOptions,
    NavigationTrack,
    PoseTrack,
    holds_navigation,
    holds_poses,
    import_recording,
    open_events,
)
from nl_env.keyframes import SPEED_LIMIT
from nl_env.recording import Recording
from nl_env.types import SLICE_US
from scripts.import_events import main

SENSOR = (240, 320)
TIMES = np.arange(0, 1_000_001, 100_000)
HALF_SECOND = ImportOptions(duration_s=0.5)


def track(folder, motions, times=TIMES, **options):
    return PoseTrack(write_poses(folder / "pose_gt.h5", motions, times, **options))


def test_a_straight_drive(tmp_path):
    """The world is the first camera's, x forward and z up."""
    motion = track(tmp_path, driving_poses(TIMES, 7.0)).motion(np.array([0, 130_000, 1_000_000]))
    np.testing.assert_allclose(motion.speed, 7.0)
    np.testing.assert_allclose(motion.pose[:, :3, 3], [[0, 0, 0], [0.91, 0, 0], [7, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(motion.pose[1, :3, :3] @ [1, 0, 0], [0, -1, 0], atol=1e-12)  # right
    np.testing.assert_allclose(motion.pose[1, :3, :3] @ [0, 1, 0], [0, 0, -1], atol=1e-12)  # down
    np.testing.assert_allclose(motion.twist, [[0, 0, 7.0, 0, 0, 0]] * 3, atol=1e-9)
    assert motion.known.all()


def test_a_turn(tmp_path):
    """A circle's chords are shorter than its arcs, by less than a thousandth here."""
    times = np.array([0, 333_333, 725_000])
    motion = track(tmp_path, driving_poses(TIMES, 10.0, turn_rate=0.5)).motion(times)
    np.testing.assert_allclose(motion.speed, 10.0, rtol=1e-3)
    np.testing.assert_allclose(motion.twist[:, 3:], [[0, 0.5, 0]] * 3, atol=1e-9)  # about the axis down
    ahead = motion.pose[:, :3, 2]
    angle = 0.5 * times * 1e-6
    expected = np.stack([np.cos(angle), -np.sin(angle), 0 * angle], axis=1)  # to the right
    np.testing.assert_allclose(ahead, expected, atol=1e-9)


def test_the_twist_leads_from_one_pose_to_the_next(tmp_path):
    poses = track(tmp_path, driving_poses(TIMES, 10.0, turn_rate=0.5))
    now, later = (poses.motion(np.array([t])) for t in (250_000, 251_000))
    step = np.linalg.inv(now.pose[0]) @ later.pose[0]
    np.testing.assert_allclose(step[:3, 3], now.twist[0, :3] * 1e-3, atol=1e-5)
    np.testing.assert_allclose(step[0, 2], now.twist[0, 4] * 1e-3, rtol=1e-3)


def test_nothing_is_known_outside_and_in_gaps(tmp_path):
    times = np.delete(TIMES, [4, 5, 6])  # no pose from 0.4 to 0.6 s: 0.4 s between two
    motion = track(tmp_path, driving_poses(times, 7.0), times).motion(np.arange(0, 1_200_001, 50_000))
    known = np.arange(0, 1_200_001, 50_000)
    np.testing.assert_array_equal(
        motion.known, (known < 300_000) | ((known >= 700_000) & (known <= 1_000_000))
    )
    for values in (motion.pose, motion.twist, motion.speed):
        axes = tuple(range(1, values.ndim))
        np.testing.assert_array_equal(np.isnan(values).all(axis=axes), ~motion.known)
        np.testing.assert_array_equal(np.isnan(values).any(axis=axes), ~motion.known)


def imported(folder, speed, until_us=1_000_000, **options):
    events = some_events(SENSOR, 1_000_000, 5_000, start_us=100)
    source = open_events(write_m3ed(folder / "car.h5", events, SENSOR))
    maps = np.full((len(TIMES), *SENSOR), 20.0)
    depth = DepthMaps(write_depth(folder / "car_depth.h5", maps, TIMES + 50_000.25))
    times = TIMES[until_us >= TIMES]
    poses = track(folder, driving_poses(times, speed), times)
    summary = import_recording(
        source, depth, folder / "out.h5", ImportOptions(duration_s=0.5, **options), poses
    )
    return summary, Recording(folder / "out.h5")


@pytest.mark.parametrize("speed", [9.5, 10.5])
def test_a_recording_has_the_speed_and_its_cause_of_keyframes(tmp_path, speed):
    summary, recording = imported(tmp_path, speed)
    assert summary.pose_slices == 26 == recording.description["pose_slices"]
    assert recording.description["motion_source"] == "pose_gt.h5"
    assert recording.description["start_us"] == 50_000  # M3ED's times are floats
    np.testing.assert_allclose(recording.speed, speed)
    np.testing.assert_array_equal(recording.keyframe, np.full(26, speed > SPEED_LIMIT))
    first, later = recording.state(0), recording.state(10)
    np.testing.assert_allclose(later.pose[:3, 3] - first.pose[:3, 3], [speed * 0.2, 0, 0], atol=1e-9)
    assert (later.shortest_distance, later.new_actors) == (math.inf, 0)
    recording.verify()


def test_a_replay_says_the_speed_and_gives_odometry(tmp_path):
    summary, recording = imported(tmp_path, 12.0)
    env = gym.make(
        "nl_env/Replay-v0", data=recording.path, extrapolator="warp", odometry=True, error="abs_rel"
    )
    _, info = env.reset(seed=summary.seed)
    assert info["ego_speed"] == pytest.approx(12.0)
    for _ in range(5):
        _, _, _, _, info = env.step(1)
    assert info["keyframe_speed"] and info["keyframe"]
    # The map says 20 m again after 1.2 m of driving; the warp knows better.
    assert info["abs_rel"] == pytest.approx(1.2 / 20.0, rel=0.02)


def test_poses_of_a_part_leave_the_rest_unknown(tmp_path):
    summary, recording = imported(tmp_path, 12.0, until_us=300_000)
    known = 50_000 + SLICE_US * np.arange(26) <= 300_000
    assert summary.pose_slices == np.count_nonzero(known) == 13
    np.testing.assert_allclose(recording.speed, np.where(known, 12.0, -1.0))
    np.testing.assert_array_equal(recording.keyframe, known)
    assert np.isnan(recording.pose(20 * SLICE_US)).all()
    with pytest.raises(ValueError, match=r"odometry: found True, but .* holds poses at 13 of 26 slices"):
        gym.make("nl_env/Replay-v0", data=recording.path, extrapolator="warp", odometry=True)


def test_poses_of_another_time(tmp_path):
    with pytest.raises(
        ValueError,
        match=r"pose_gt\.h5: found poses or speeds from 0 to 100000 us, expected some from 450000 to 950000",
    ):
        imported(tmp_path, 12.0, until_us=100_000, start_s=0.4)
    assert not list(tmp_path.glob("*out*"))


def test_the_command_takes_poses_from_the_depth_file(tmp_path, capsys):
    events = some_events(SENSOR, 1_000_000, 5_000, start_us=100)
    source = write_m3ed(tmp_path / "car.h5", events, SENSOR)
    depth = write_depth(tmp_path / "depth.h5", np.full((len(TIMES), *SENSOR), 20.0), TIMES)
    arguments = [str(source), "--depth", str(depth), "--duration-s", "0.5", "--overwrite", "--out"]
    assert not holds_poses(depth) and main([*arguments, str(tmp_path / "none.h5")]) == 0
    assert "speed at" not in capsys.readouterr().out
    write_poses(depth, driving_poses(TIMES, 11.0), TIMES, mode="r+")
    assert holds_poses(depth) and main([*arguments, str(tmp_path / "some.h5")]) == 0
    assert "speed at 26 and poses at 26 of 26 slices" in capsys.readouterr().out
    other = write_poses(tmp_path / "pose_gt.h5", driving_poses(TIMES, 5.0), TIMES)
    assert main([*arguments, str(tmp_path / "other.h5"), "--poses", str(other)]) == 0
    speeds = [Recording(tmp_path / f"{name}.h5").speed[3] for name in ("none", "some", "other")]
    np.testing.assert_allclose(speeds, [-1.0, 11.0, 5.0])


def write_navigation(path, velocities, times):
    """EvTTC's velocities beside its events."""
    with h5py.File(path, "r+") as file:
        file["integratedNavigation/data/velocity"] = velocities
        file["integratedNavigation/data/ts"] = times
    return path


def test_evttc_says_its_speed_and_no_poses(tmp_path, capsys):
    """Along north, east and up; 10 m/s, the limit of the rule, are reached after 0.2 s."""
    events = some_events(SENSOR, 1_000_000, 5_000, start_us=100)
    path = write_m3ed(tmp_path / "a.hdf5", events, SENSOR, group="prophesee/event_cam_left")
    times = np.arange(0, 400_001, 10_000)
    speeds = 8.0 + times * 1e-5
    write_navigation(path, speeds[:, None] * [0.6, -0.8, 0.0], times)
    assert main([str(path), "--duration-s", "0.5", "--out", str(tmp_path / "out.h5")]) == 0
    assert "speed at 20 and poses at 0 of 26 slices" in capsys.readouterr().out
    recording = Recording(tmp_path / "out.h5")
    ends = int(events["t"][0]) + SLICE_US * np.arange(26)
    known = ends <= 400_000
    np.testing.assert_allclose(recording.speed, np.where(known, 8.0 + ends * 1e-5, -1.0))
    np.testing.assert_array_equal(recording.keyframe, known & (ends > 200_000))
    assert np.isnan(recording.pose(0)).all() and recording.description["motion_source"] == "a.hdf5"


@pytest.mark.parametrize(
    ("velocities", "times", "message"),
    [
        (
            np.ones((3, 2)),
            [1, 2, 3],
            r"found .*velocity \(3, 2\) and .*ts \(3,\), expected \(N, 3\) and \(N,\)",
        ),
        (np.ones((3, 3)), [1, 2], r"ts \(2,\), expected"),
        (np.ones((1, 3)), [1], "at least 2"),
        (np.array([[1.0, 0, 0], [np.nan, 0, 0]]), [1, 2], r"velocity\[1\]: found \[nan, 0\.0, 0\.0\]"),
        (
            np.array([[1.0, 0, 0], [0, 3_600.0, 0]]),
            [1, 2],
            r"velocity\[1\]: .* expected a velocity of at most 100",
        ),
        (np.ones((2, 3)), [2, 1], r"ts\[1\]: found 1 us, expected times that ascend"),
        (np.ones((2, 3)), [-1, 1], r"ts\[0\]: found -1 us"),
    ],
)
def test_bad_navigation(tmp_path, velocities, times, message):
    h5py.File(tmp_path / "a.hdf5", "w").close()
    assert not holds_navigation(tmp_path / "a.hdf5")
    path = write_navigation(tmp_path / "a.hdf5", velocities, times)
    assert holds_navigation(path)
    with pytest.raises(ValueError, match=rf"a\.hdf5: .*{message}"):
        NavigationTrack(path)


def changed(name, content):
    def change(file):
        old = file[name][()]
        del file[name]
        new = content(old) if callable(content) else content
        if new is not None:
            file[name] = new

    return change


def with_row(k, value):
    def change(old):
        old[k] = value
        return old

    return change


MIRROR = np.diag([1.0, 1.0, -1.0, 1.0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (changed("Cn_T_C0", None), "Cn_T_C0: found nothing, expected a dataset"),
        (changed("ts", None), "ts: found nothing"),
        (changed("Cn_T_C0", lambda old: old[:, :3]), r"found Cn_T_C0 \(11, 3, 4\) and ts \(11,\)"),
        (changed("Cn_T_C0", lambda old: old[:5]), r"expected \(N, 4, 4\) and \(N,\), at least 2"),
        (changed("Cn_T_C0", with_row(3, np.nan)), r"Cn_T_C0\[3\]: found .*nan.*, expected a rotation"),
        (changed("Cn_T_C0", with_row(3, np.inf)), r"Cn_T_C0\[3\]: found .*inf"),
        (changed("Cn_T_C0", with_row(2, 2 * np.eye(4))), r"Cn_T_C0\[2\]: found \[\[2\.0"),
        (changed("Cn_T_C0", with_row(2, MIRROR)), r"Cn_T_C0\[2\]: found .*-1\.0"),
        (changed("Cn_T_C0", np.full((11, 4, 4), b"x")), r"Cn_T_C0: found \|S1, expected numbers"),
        (changed("ts", with_row(4, 300_000.0)), r"ts\[4\]: found 300000\.0 us, expected times that ascend"),
        (changed("ts", with_row(4, 5.0)), r"ts\[4\]: found 5\.0 us"),
        (changed("ts", with_row(0, -5.0)), r"ts\[0\]: found -5\.0 us"),
        (changed("ts", with_row(4, np.nan)), r"ts\[4\]: found nan us"),
        (changed("ts", with_row(10, np.inf)), r"ts\[10\]: found inf us"),
        (lambda file: file.attrs.modify("cam_name", "/prophesee/right"), "found poses of /prophesee/right"),
    ],
)
def test_bad_pose_files(tmp_path, change, message):
    path = write_poses(tmp_path / "pose_gt.h5", driving_poses(TIMES, 3.0), TIMES)
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(ValueError, match=rf"(?s)pose_gt\.h5: .*{message}"):
        PoseTrack(path)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_a_truncated_pose_file(tmp_path, share):
    path = write_poses(tmp_path / "pose_gt.h5", driving_poses(TIMES, 3.0), TIMES)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ValueError, match=r"pose_gt\.h5: not a readable HDF5 file"):
        PoseTrack(path)
    with pytest.raises(FileNotFoundError, match=r"none\.h5: no such file"):
        PoseTrack(tmp_path / "none.h5")
