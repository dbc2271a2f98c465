"""Real event files become native recordings: what is kept, what is left empty, and that they replay."""

import json
import math

import gymnasium as gym
import h5py
import numpy as np
import pytest
from event_files import (
    driving_poses,
    some_events,
    write_dat,
    write_depth,
    write_dsec,
    write_m3ed,
    write_poses,
)
from gymnasium.utils.env_checker import check_env

import nl_env
from nl_env.config import SPLITS
from nl_env.importing import DepthMaps, ImportOptions, import_recording, open_events
from nl_env.importing.convert import derived_seed
from nl_env.importing.geometry import choose_crop
from nl_env.importing.source import Calibration
from nl_env.inspection import Reading, inspect_path
from nl_env.recording import Recording
from scripts.import_events import main

SENSOR = (250, 330)
"""Twice a quarter resolution, and a margin."""
MARGIN_TOP, MARGIN_LEFT = 5, 5
START, LAST = 100_000, 1_250_000
HALF_SECOND = ImportOptions(duration_s=0.5, lidar_hz=5)


def write_sequence(folder, depth_period_us=100_000, late_us=0):
    """Random events for a good second, and depth whose value says its time (0.1 m a ms)."""
    events = some_events(SENSOR, LAST - START, 30_000, start_us=START)
    source = open_events(write_m3ed(folder / "car.h5", events, SENSOR))
    times = np.arange(150_000, 1_200_001, depth_period_us)
    maps = np.broadcast_to(times[:, None, None] / 1e4, (len(times), *SENSOR)).copy()
    maps[:, ::2] = np.inf  # LiDAR returns are sparse
    depth = DepthMaps(
        write_depth(folder / "car_depth.h5", maps, times + late_us * (np.arange(len(times)) > 0))
    )
    return events, source, depth


def imported(folder, options=HALF_SECOND, **sequence):
    events, source, depth = write_sequence(folder, **sequence)
    return events, import_recording(source, depth, folder / "out.h5", options), Recording(folder / "out.h5")


@pytest.fixture(scope="module")
def standard(tmp_path_factory):
    return imported(tmp_path_factory.mktemp("standard"))


def test_events_keep_time_and_polarity(standard):
    events, summary, recording = standard
    inside = events[(events["t"] >= 150_000) & (events["t"] < 650_000)]
    assert summary.events_read == len(inside)
    x, y = inside["x"].astype(int) - MARGIN_LEFT, inside["y"].astype(int) - MARGIN_TOP
    inside = inside[(x >= 0) & (x < 320) & (y >= 0) & (y < 240)]
    assert summary.events_kept == len(inside) < summary.events_read
    found = recording.events(0, 500_000)
    np.testing.assert_array_equal(found["t"], inside["t"] - 150_000)
    np.testing.assert_array_equal(found["p"], inside["p"])
    np.testing.assert_array_equal(found["x"], (inside["x"] - MARGIN_LEFT) // 2)
    np.testing.assert_array_equal(found["y"], (inside["y"] - MARGIN_TOP) // 2)
    recording.verify()


def test_depth_is_that_of_its_slice_or_empty(standard):
    """Maps come every 100 ms, so every fifth slice has one and no other has any."""
    _, summary, recording = standard
    assert (summary.slices, summary.depth_slices, summary.depth_offset_ms) == (25, 6, 0.0)
    for k in range(26):
        expected = 15.0 + 2.0 * k if k % 5 == 0 else 0.0  # rows without a return lose to their neighbours
        np.testing.assert_allclose(recording.depth(k * 20_000), expected, atol=200 / 65535)
    assert recording.header.description["depth_slices"] == 6


def test_depth_at_every_slice(tmp_path):
    _, summary, recording = imported(tmp_path, depth_period_us=20_000, late_us=3_000)
    assert (summary.depth_slices, summary.depth_offset_ms) == (26, 3.0)
    np.testing.assert_allclose(recording.depth(7 * 20_000), 29.0, atol=200 / 65535)
    env = gym.make("nl_env/Replay-v0", data=recording.path, extrapolator="repeat")
    check_env(env.unwrapped, skip_render_check=True)


def test_depth_beyond_the_range_is_no_return(tmp_path):
    _, _, recording = imported(tmp_path, ImportOptions(duration_s=0.5, max_depth=20.0))
    assert np.all(recording.depth(0) > 0) and not np.any(recording.depth(400_000))
    assert recording.max_depth == 20.0


def test_what_is_not_known_says_so(standard):
    _, summary, recording = standard
    state = recording.state(3)
    assert np.isnan(state.pose).all() and np.isnan(state.twist).all()
    assert (state.speed, state.shortest_distance, state.new_actors) == (-1.0, math.inf, 0)
    assert not recording.keyframe.any()
    description = recording.description
    assert (description["source"], description["layout"], description["weather"]) == (
        "car.h5",
        "M3ED",
        "unknown",
    )
    assert (description["start_us"], description["crop"], description["binning"]) == (
        150_000,
        [5, 5, 320, 240],
        2,
    )
    assert summary.seed == recording.seed == derived_seed("car.h5", 0.0)
    assert recording.seed in SPLITS["test"]


def test_the_camera_is_the_calibration_after_binning(tmp_path, standard):
    _, _, recording = standard
    assert recording.camera.shape == (120, 160)
    assert recording.camera.fx == pytest.approx(0.8 * SENSOR[1] / 2)
    _, _, other = imported(tmp_path, ImportOptions(duration_s=0.5, focal_px=300.0))
    assert other.camera.fx == pytest.approx(150.0)


def test_the_bytes_do_not_depend_on_when(tmp_path, standard):
    _, _, recording = imported(tmp_path)
    assert recording.path.read_bytes() == standard[2].path.read_bytes()


def test_it_replays_and_inspects(standard):
    _, summary, recording = standard
    env = gym.make("nl_env/Replay-v0", data=recording.path, extrapolator="repeat", error="abs_rel")
    observation, info = env.reset(seed=summary.seed)
    assert observation.shape == (1, 120, 160)
    assert (info["ego_speed"], info["keyframe"], info["lidar"]) == (-1.0, False, True)
    errors = []
    for k in range(1, summary.slices + 1):
        _, _, _, truncated, info = env.step(0)
        assert info["lidar"] == (k % 10 == 0)  # 5 Hz
        errors.append(info["abs_rel"])
    assert truncated
    known = [k for k, error in enumerate(errors, start=1) if not math.isnan(error)]
    assert known == [5, 10, 15, 20, 25]  # an empty map has no error
    assert errors[4] == pytest.approx(10.0 / 25.0, rel=1e-3)  # 15 m held, 25 m true
    assert errors[9] == pytest.approx(0.0)  # a LiDAR frame

    (found,) = inspect_path(recording.path, Reading(verify=True, pictures=True))
    assert found.problems == [] and found.facts["sequences"] == 1
    json.dumps(found.as_json(), allow_nan=False)


def test_events_alone_make_a_recording_without_depth(tmp_path):
    events = some_events((480, 640), 300_000, 5_000)
    source = open_events(write_dsec(tmp_path / "events.h5", events))
    options = ImportOptions(duration_s=0.2, focal_px=550.0, start_s=0.05)
    summary = import_recording(source, None, tmp_path / "out.h5", options)
    recording = Recording(tmp_path / "out.h5")
    assert summary.depth_slices == 0 and recording.description["depth_source"] is None
    assert not recording.depth(100_000).any()
    env = gym.make("nl_env/Replay-v0", data=tmp_path / "out.h5", extrapolator="repeat", error="abs_rel")
    env.reset(seed=summary.seed)
    _, reward, _, _, info = env.step(1)
    assert reward == pytest.approx(-0.1)  # the trigger; no error without a truth
    assert info["event_count"] == recording.event_count(1) > 0


@pytest.mark.parametrize("writer", [write_m3ed, write_dat])
def test_event_files_are_inspected(tmp_path, writer):
    events = some_events((48, 64), 200_000, 1_000, start_us=1_000)
    path = writer(tmp_path / ("a.dat" if writer is write_dat else "a.h5"), events, (48, 64))
    (found,) = inspect_path(path, Reading(verify=True, pictures=True))
    assert found.problems == [] and len(found.pictures) == 1
    assert (found.facts["resolution"], found.facts["events"]) == ("48x64", 1_000)
    assert found.facts["events_per_second"] == pytest.approx(5_000, rel=0.02)
    json.dumps(found.as_json(), allow_nan=False)
    events["x"][500] = 64
    (found,) = inspect_path(writer(path, events, (48, 64)), Reading(verify=True))
    assert len(found.problems) == 1 and "found x = 64 at event 500" in found.problems[0]


def test_ground_truth_is_inspected(tmp_path):
    """Depth maps and poses of one file, a folder of both files, and what is wrong with them."""
    times = np.arange(5) * 100_000 + 7_000.25
    path = write_depth(tmp_path / "depth_gt.h5", np.full((5, 48, 64), 20.0), times)
    (depth,) = inspect_path(path, Reading(verify=True, pictures=True))
    assert depth.kind == "depth maps" and depth.problems == [] and len(depth.pictures) == 5
    assert (depth.facts["resolution"], depth.facts["maps"], depth.facts["maps_per_second"]) == (
        "48x64",
        5,
        10,
    )
    write_poses(path, driving_poses(times, 6.0), times, mode="r+", camera="/prophesee/right")
    write_m3ed(tmp_path / "data.h5", some_events((48, 64), 200_000, 1_000), (48, 64))
    events, depth, poses = inspect_path(tmp_path, Reading())
    assert (events.kind, depth.kind, poses.kind) == ("M3ED events", "depth maps", "poses")
    assert poses.facts["metres"] == pytest.approx(2.4) and poses.facts["largest_speed"] == pytest.approx(6.0)
    json.dumps([found.as_json() for found in (events, depth, poses)], allow_nan=False)

    with h5py.File(path, "r+") as file:
        file["depth/prophesee/left"][3, 0, 0] = -1.0
        file["Cn_T_C0"][2] = 0.0
    (tmp_path / "broken.h5").write_bytes(path.read_bytes()[:2000])
    events, depth, poses, broken = inspect_path(tmp_path, Reading(verify=True))
    assert "depth/prophesee/left[3]: found -1.0 m" in depth.problems[0]
    assert "Cn_T_C0[2]: found " in poses.problems[0]
    assert "broken.h5: not a readable HDF5 file" in broken.problems[0] and events.problems == []


def test_it_has_no_odometry(standard):
    recording = standard[2]
    with pytest.raises(ValueError, match=r"odometry: found True, but .* holds poses at 0 of 26 slices"):
        gym.make("nl_env/Replay-v0", data=recording.path, extrapolator="warp", odometry=True)


def test_two_parts_of_a_file_replay_together(tmp_path):
    _, source, depth = write_sequence(tmp_path)
    (tmp_path / "parts").mkdir()
    for start in (0.0, 0.6):
        options = ImportOptions(duration_s=0.4, start_s=start)
        import_recording(source, depth, tmp_path / "parts" / f"car-{start}.h5", options)
    env = gym.make("nl_env/Replay-v0", data=tmp_path / "parts", split="test", extrapolator="repeat")
    assert set(env.unwrapped.stream.seeds) == {derived_seed("car.h5", 0.0), derived_seed("car.h5", 0.6)}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"duration_s": 5.0}, r"car\.h5: found 1\.10 s of events from the start on, expected 5\.00 s"),
        ({"start_s": 1.2}, r"car_depth\.h5: found depth until 1150000 us, expected some from 1300"),
        (
            {"duration_s": 0.5, "lidar_hz": 25},
            r"no depth for the LiDAR frame 0\.04 s .* 40\.0 ms away; 10 frames",
        ),
        ({"duration_s": 0.5, "crop": (0, 0, 160, 100)}, r"crop: found 160x100 pixels, expected a multiple"),
        ({"duration_s": 0.5, "crop": (20, 0, 320, 240)}, r"crop: found columns 20 to 340"),
        (
            {"duration_s": 0.5, "resolution": "full"},
            r"resolution: found 'full', 640x480, expected one that fits",
        ),
        ({"duration_s": 0.5, "focal_px": 20.0}, r"fov_deg: found 165\.\d+"),
    ],
)
def test_what_cannot_be_imported(tmp_path, options, message):
    _, source, depth = write_sequence(tmp_path)
    with pytest.raises(ValueError, match=message):
        import_recording(source, depth, tmp_path / "out.h5", ImportOptions(**options))
    assert not list(tmp_path.glob("*out*"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"resolution": "tiny"}, "resolution: found 'tiny'"),
        ({"lidar_hz": 7}, "lidar_hz: found 7"),
        ({"depth_tolerance_ms": 10.0}, "depth_tolerance_ms: found 10.0"),
        ({"duration_s": 0.1}, "duration_s: found 0.1"),
        ({"start_s": -1.0}, "start_s: found -1.0"),
        ({"focal_px": math.nan}, "focal_px: found nan"),
        ({"seed": -1}, "seed: found -1"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        ImportOptions(**options)


def test_depth_of_another_sensor_and_no_calibration(tmp_path):
    _, source, _ = write_sequence(tmp_path)
    depth = DepthMaps(write_depth(tmp_path / "small.h5", np.ones((2, 4, 4)), [150_000, 250_000]))
    with pytest.raises(ValueError, match=r"small\.h5: found depth of \(4, 4\), expected the sensor's size"):
        import_recording(source, depth, tmp_path / "out.h5", HALF_SECOND)
    events = some_events(SENSOR, 900_000, 3_000)
    source = open_events(write_dat(tmp_path / "a.dat", events, SENSOR))
    with pytest.raises(ValueError, match=r"a\.dat: found no calibration, expected --focal-px"):
        import_recording(source, None, tmp_path / "out.h5", HALF_SECOND)


def test_damage_found_on_the_way_leaves_nothing(tmp_path):
    events = some_events(SENSOR, 900_000, 3_000)
    events["t"][2_000] = 0
    path = write_dat(tmp_path / "a.dat", events, SENSOR)
    source = open_events(path)
    source._scanned = (0, 899_999, 3_000)  # as if the fault lay beyond what was looked at before
    with pytest.raises(ValueError, match=r"a\.dat: found t = 0 at event 2000"):
        import_recording(source, None, tmp_path / "out.h5", ImportOptions(duration_s=0.8, focal_px=300.0))
    assert [file.name for file in tmp_path.iterdir()] == ["a.dat"]


def test_the_crop_is_centred_on_the_principal_point():
    assert choose_crop((720, 1280), "quarter", Calibration(1034.0, 600.0, 359.5)).left == 120
    crop = choose_crop((720, 1280), "quarter")
    assert (crop.k, crop.left, crop.top, crop.shape) == (6, 160, 0, (120, 160))
    assert choose_crop((720, 1280), "quarter", Calibration(1034.0, 10.0, 900.0)).left == 0
    assert choose_crop((480, 640), "half", rectangle=(10, 20, 320, 240)).k == 1


def test_binned_depth_is_the_nearest_return():
    crop = choose_crop((240, 320), "quarter")
    depth = np.zeros((240, 320), np.float32)
    depth[0:2, 0:2] = [[9.0, 4.0], [0.0, 7.0]]
    binned = crop.depth(depth)
    assert binned.dtype == np.float32 and binned[0, 0] == 4.0 and np.count_nonzero(binned) == 1


def test_the_command(tmp_path, capsys):
    write_sequence(tmp_path)
    out = tmp_path / "new" / "car.h5"
    arguments = [str(tmp_path / "car.h5"), "--depth", str(tmp_path / "car_depth.h5"), "--out", str(out)]
    assert main([*arguments, "--duration-s", "0.5", "--crop", "0", "0", "320", "240"]) == 0
    said = capsys.readouterr().out
    assert "M3ED, 25 slices" in said and "crop of 320x240 at column 0, row 0, binned 2x2" in said
    assert "depth at 6 of 26 slices, at most 0.0 ms off" in said
    assert main(arguments) == 2
    assert "exists; choose another name or pass --overwrite" in capsys.readouterr().err
    assert main([*arguments, "--overwrite"]) == 2
    assert "expected 20.00 s" in capsys.readouterr().err
    with Recording(out) as recording:
        assert recording.description["crop"] == [0, 0, 320, 240]
        assert recording.header.nl_env_version == nl_env.__version__
