"""DSEC: disparity as depth, events at the rectified pixels, and what is refused."""

import gymnasium as gym
import h5py
import numpy as np
import pytest
from event_files import (
    BASELINE,
    DSEC_SHAPE,
    RECTIFIED_FOCAL,
    some_events,
    write_calibration,
    write_disparity,
    write_dsec,
    write_m3ed,
    write_rectify_map,
)
from PIL import Image

from nl_env.importing import DisparityMaps, RectifiedEvents, StereoCalibration, open_depth, open_events
from nl_env.recording import Recording
from scripts.import_events import main

pytest.importorskip("yaml")

SHAPE = (12, 16)
OFFSET = 49_599_300_523
TIMES = OFFSET + np.arange(50_000, 1_100_000, 100_000)


def shifted_places(shape, right=0.0, down=0.0):
    """A map that moves every pixel by as much."""
    rows, columns = np.indices(shape)
    return np.stack([columns + right, rows + down], axis=-1)


@pytest.fixture
def calibration(tmp_path):
    return StereoCalibration.read(write_calibration(tmp_path / "cam_to_cam.yaml", SHAPE))


def some_depth(count=3, shape=SHAPE):
    depth = np.random.default_rng(0).uniform(5.0, 60.0, (count, *shape))
    depth[:, 2] = 0.0
    return depth


def test_the_calibration_is_the_rectified_left_event_camera_s(calibration):
    assert calibration.shape == SHAPE
    assert (calibration.camera.focal, calibration.camera.cx, calibration.camera.cy) == (560.0, 7.5, 5.5)
    codes = np.array([[0, 256, 2560]], np.uint16)
    np.testing.assert_allclose(calibration.depth(codes), [[0, 560 * 0.6, 56 * 0.6]], rtol=1e-6)


def test_disparity_is_depth(tmp_path, calibration):
    depth = some_depth()
    folder = write_disparity(tmp_path / "disparity", depth, TIMES[:3])
    for place in (folder, folder / "event"):
        maps = open_depth(place, calibration=calibration)
        assert (len(maps), maps.shape) == (3, SHAPE)
        np.testing.assert_array_equal(maps.times, TIMES[:3])
        for k in range(3):
            found = maps.read(k)
            assert found.dtype == np.float32
            np.testing.assert_array_equal(found > 0, depth[k] > 0)
            # Half a unit of disparity, 1/512 px, at distance z is z^2 / (512 f b) metres.
            worst = depth[k] ** 2 / (512 * RECTIFIED_FOCAL * BASELINE)
            assert np.all(np.abs(found - depth[k]) <= 1.01 * worst + 1e-5)
    with pytest.raises(ValueError, match="found picture 3, expected 0 to 2"):
        maps.read(3)


def test_disparity_as_it_is_downloaded_for_one_sequence(tmp_path, calibration):
    folder = write_disparity(tmp_path / "disparity", some_depth(), TIMES[:3])
    (folder / "event").rename(tmp_path / "zurich_city_04_a_disparity_event")
    (folder / "timestamps.txt").rename(tmp_path / "zurich_city_04_a_disparity_timestamps.txt")
    (tmp_path / "timestamps.txt").write_text("of something else")
    maps = DisparityMaps(tmp_path / "zurich_city_04_a_disparity_event", calibration)
    np.testing.assert_array_equal(maps.times, TIMES[:3])


def test_events_move_to_the_nearest_rectified_pixel(tmp_path):
    events = some_events(SHAPE, 300_000, 3_000)
    source = open_events(write_m3ed(tmp_path / "a.h5", events, SHAPE))
    places = shifted_places(SHAPE, right=-2.4, down=3.6)
    places[0, 5] = [1e9, -1e9]
    rectified = RectifiedEvents(source, write_rectify_map(tmp_path / "rectify_map.h5", places))
    expected = events[(events["x"] >= 2) & (events["y"] < SHAPE[0] - 4)]
    expected = expected[~((expected["x"] == 5) & (expected["y"] == 0))]
    expected["x"] -= 2
    expected["y"] += 4
    np.testing.assert_array_equal(np.concatenate(list(rectified.blocks(0, 300_000))), expected)
    assert (rectified.shape, rectified.span(), len(rectified)) == (SHAPE, source.span(), 3_000)
    assert rectified.layout == "M3ED, rectified" and rectified.calibration is None


def write_sequence(folder):
    """A good second of DSEC. Depth says its time, a metre for 10 ms; the map goes a pixel to the right."""
    events = some_events(DSEC_SHAPE, 1_200_000, 20_000, start_us=OFFSET)
    write_dsec(folder / "events.h5", events, OFFSET)
    write_calibration(folder / "cam_to_cam.yaml")
    write_rectify_map(folder / "rectify_map.h5", shifted_places(DSEC_SHAPE, right=1.0))
    depth = np.broadcast_to(((TIMES - OFFSET) / 1e4)[:, None, None], (len(TIMES), *DSEC_SHAPE))
    write_disparity(folder / "disparity", depth, TIMES)
    return events


def test_a_sequence_is_imported_and_replays(tmp_path, capsys):
    events = write_sequence(tmp_path)
    arguments = [str(tmp_path / "events.h5"), "--depth", str(tmp_path / "disparity")]
    arguments += ["--calibration", str(tmp_path / "cam_to_cam.yaml"), "--out", str(tmp_path / "out.h5")]
    assert main(arguments) == 2
    assert "found " in (said := capsys.readouterr().err) and "expected --rectify-map, too" in said
    arguments += ["--rectify-map", str(tmp_path / "rectify_map.h5"), "--duration-s", "0.6"]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert "DSEC, rectified, 30 slices" in said and "depth at 7 of 31 slices, at most 0.0 ms off" in said

    recording = Recording(tmp_path / "out.h5")
    inside = events[(events["t"] >= TIMES[0]) & (events["t"] < TIMES[0] + 600_000) & (events["x"] < 639)]
    found = recording.events(0, 600_000)
    np.testing.assert_array_equal(found["t"], inside["t"] - TIMES[0])
    np.testing.assert_array_equal(found["x"], (inside["x"] + 1) // 4)
    np.testing.assert_allclose(recording.depth(100_000), 15.0, atol=0.01)
    assert not recording.depth(20_000).any()
    assert recording.camera.fx == pytest.approx(RECTIFIED_FOCAL / 4)

    env = gym.make("nl_env/Replay-v0", data=tmp_path / "out.h5", extrapolator="repeat", error="abs_rel")
    env.reset(seed=recording.seed)
    for _ in range(5):
        _, _, _, _, info = env.step(0)
    assert info["abs_rel"] == pytest.approx(10 / 15, rel=1e-2)  # 5 m held, 15 m true


def test_rectified_events_without_depth(tmp_path, capsys):
    write_sequence(tmp_path)
    arguments = [str(tmp_path / "events.h5"), "--rectify-map", str(tmp_path / "rectify_map.h5")]
    arguments += ["--duration-s", "0.4", "--out", str(tmp_path / "out.h5")]
    assert main(arguments) == 2
    assert "found no calibration, expected --focal-px" in capsys.readouterr().err
    assert main([*arguments, "--calibration", str(tmp_path / "cam_to_cam.yaml")]) == 0
    assert Recording(tmp_path / "out.h5").camera.fx == pytest.approx(RECTIFIED_FOCAL / 4)


# What is refused


def rewritten(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    return path


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "camRect0",
            "camRect9",
            r"intrinsics\.camRect0\.resolution: found None, expected finite numbers, \(2,\)",
        ),
        ("camera_matrix: [560.0,", "camera_matrix: [", r"camRect0\.camera_matrix: found \[560\.0"),
        ("camera_matrix: [560.0", "camera_matrix: [.nan", r"camera_matrix: found \[nan"),
        ("camera_matrix: [560.0", "camera_matrix: [-1.0", "camRect0: found 16x12 pixels, focal lengths -1.0"),
        ("cams_03", "cams_12", r"disparity_to_depth\.cams_03: found None, expected finite numbers, \(4, 4\)"),
        (
            "[0.0, 0.0, 0.0, 560.0]",
            "[0.0, 0.0, 0.5, 560.0]",
            "expected one that makes depth of disparity alone",
        ),
        ("[0.0, 0.0, 0.0, 560.0]", "[0.0, 0.0, 0.0, a]", r"cams_03: found .*'a'"),
        ("intrinsics:", "intrinsics: [", "not readable YAML"),
        ("intrinsics:\n", "intrinsics: !!python/object/apply:os.getcwd []\nx:\n", "not readable YAML"),
    ],
)
def test_bad_calibrations(tmp_path, old, new, message):
    path = rewritten(write_calibration(tmp_path / "cam_to_cam.yaml", SHAPE), old, new)
    with pytest.raises(ValueError, match=rf"(?s)cam_to_cam\.yaml: .*{message}"):
        StereoCalibration.read(path)


def test_missing_files(tmp_path, calibration):
    with pytest.raises(FileNotFoundError, match=r"none\.yaml: no such file; expected DSEC's cam_to_cam"):
        StereoCalibration.read(tmp_path / "none.yaml")
    with pytest.raises(FileNotFoundError, match="nowhere: no such folder"):
        DisparityMaps(tmp_path / "nowhere", calibration)
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match=r"empty: found no \.png"):
        DisparityMaps(tmp_path / "empty", calibration)
    folder = write_disparity(tmp_path / "disparity", some_depth(), TIMES[:3])
    with pytest.raises(
        ValueError, match="disparity: found a folder, DSEC's disparity, expected its --calibration"
    ):
        open_depth(folder)
    with pytest.raises(ValueError, match="camera: found 'right', but DSEC's disparity"):
        open_depth(folder, "right", calibration)
    (folder / "timestamps.txt").unlink()
    with pytest.raises(FileNotFoundError, match=r"event: found no times, expected .*timestamps\.txt"):
        DisparityMaps(folder, calibration)


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ("1\n2\n", "found 2 times, expected 3, one for each picture"),
        ("1\n3\n2\n", r"\[2\]: found 2 us, expected times that ascend"),
        ("1\n2\n2\n", r"\[2\]: found 2 us"),
        ("-1\n2\n3\n", r"\[0\]: found -1 us"),
        ("1\n2.5\n3\n", r"line 2: found '2\.5', expected a time in us"),
        ("", r"found int64 \(0,\), expected times in us"),
        ("9" * 30, "line 1: found '999"),
    ],
)
def test_bad_times(tmp_path, calibration, times, message):
    folder = write_disparity(tmp_path / "disparity", some_depth(), TIMES[:3])
    (folder / "timestamps.txt").write_text(times)
    with pytest.raises(ValueError, match=rf"timestamps\.txt.*{message}"):
        DisparityMaps(folder, calibration)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_truncated_picture(tmp_path, calibration, share):
    folder = write_disparity(tmp_path / "disparity", some_depth(), TIMES[:3])
    path = folder / "event" / "000002.png"
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    maps = DisparityMaps(folder, calibration)
    maps.read(0)
    with pytest.raises(ValueError, match=r"000002\.png: not a readable picture"):
        maps.read(1)


def test_flipped_bytes_in_a_picture(tmp_path, calibration):
    folder = write_disparity(tmp_path / "disparity", some_depth(), TIMES[:3])
    path = folder / "event" / "000002.png"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"000002\.png: not a readable picture"):
        DisparityMaps(folder, calibration).read(1)


@pytest.mark.parametrize("picture", [np.zeros((12, 15), np.uint16), np.zeros(SHAPE, np.uint8)])
def test_pictures_of_another_size_or_kind(tmp_path, calibration, picture):
    folder = write_disparity(tmp_path / "disparity", some_depth(), TIMES[:3])
    Image.fromarray(picture).save(folder / "event" / "000002.png")
    with pytest.raises(ValueError, match=r"000002\.png: found .* expected 16x12 of 16 bits, as .*cam_to_cam"):
        DisparityMaps(folder, calibration).read(1)


@pytest.mark.parametrize(
    ("places", "message"),
    [
        (None, "rectify_map: found nothing, expected a dataset"),
        (
            np.zeros((12, 15, 2)),
            r"rectify_map: found \(12, 15, 2\), expected \(12, 16, 2\), the sensor's size",
        ),
        (np.full((*SHAPE, 2), np.nan), "rectify_map: found NaN or infinity"),
    ],
)
def test_bad_rectify_maps(tmp_path, places, message):
    source = open_events(write_m3ed(tmp_path / "a.h5", some_events(SHAPE, 9_000, 30), SHAPE))
    path = tmp_path / "rectify_map.h5"
    if places is None:
        h5py.File(path, "w").close()
    else:
        write_rectify_map(path, places)
    with pytest.raises(ValueError, match=message):
        RectifiedEvents(source, path)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ValueError, match=r"rectify_map\.h5: not a readable HDF5 file"):
        RectifiedEvents(source, path)
