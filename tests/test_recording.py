import json
import multiprocessing
import os
import pickle
import resource
import shutil
import signal
from concurrent.futures import ThreadPoolExecutor

import h5py
import numpy as np
import pytest

from nl_env.config import DrivingConfig, EventCameraConfig, LidarConfig, SceneConfig
from nl_env.env import AdaptiveDepthEnv
from nl_env.keyframes import label_keyframe
from nl_env.recording import Recording, record_sequence
from nl_env.recording.file import RecordingFile
from nl_env.recording.schema import Header
from nl_env.recording.writer import CheckedOutput
from nl_env.recording_stream import RecordingStream
from nl_env.representations import voxel_from_bins, voxel_grid
from nl_env.sensors.lidar import quantise
from nl_env.simulator import Simulator
from nl_env.streams import SyntheticStream
from nl_env.types import EVENT_DTYPE, SLICE_US, TICK_US


def config(noise="realistic", rate_hz=10, beams=0, duration_s=0.4):
    return DrivingConfig(
        scene=SceneConfig(scenario="highway", duration_s=duration_s),
        events=EventCameraConfig.preset(noise),
        lidar=LidarConfig(rate_hz=rate_hz, beams=beams),
    )


CASES = {
    "realistic": (3, config(), SLICE_US),
    "ideal, 5 Hz, 32 beams": (4, config("ideal", 5, 32), SLICE_US),
    "realistic, 25 Hz, depth at every tick": (5, config(rate_hz=25, duration_s=0.2), TICK_US),
    "ideal, depth at 10 ms": (3, config("ideal", duration_s=0.2), 10_000),
}
SEED, CONFIG, _ = CASES["realistic"]
SLICES = CONFIG.scene.slices


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("recordings")


@pytest.fixture(scope="module")
def path(folder):
    """The first case, with pictures."""
    file = folder / f"{SEED}.h5"
    record_sequence(file, CONFIG, SEED, intensity=True)
    return file


@pytest.fixture
def recording(path):
    with Recording(path) as opened:
        yield opened


@pytest.fixture(scope="module")
def samples():
    stream = SyntheticStream(CONFIG)
    return [stream.reset(SEED), *(stream.advance() for _ in range(stream.slices))]


@pytest.fixture(scope="module")
def short(folder):
    """The smallest recording, to damage copies of."""
    file = folder / "short.h5"
    record_sequence(file, config(duration_s=0.2), SEED)
    return file


@pytest.fixture
def damaged(short, tmp_path):
    return shutil.copy(short, tmp_path / "damaged.h5")


def rollout(stream, seed):
    """Everything a whole episode shows, as bytes and as values with their types."""
    env = AdaptiveDepthEnv(stream, extrapolator="warp", obs_mode="dict")
    observation, info = env.reset(seed=seed)
    steps = []
    reward, truncated = 0.0, False
    while True:
        arrays = (*observation.values(), env.depth, env.true_depth, env.prior_depth, env.sample.bins)
        state = env.sample.state
        steps.append(
            (
                [(a.dtype, a.shape, a.tobytes()) for a in (*arrays, state.pose, state.twist)],
                (reward, truncated, state.speed, state.shortest_distance, state.new_actors),
                {key: (type(value), repr(value)) for key, value in info.items()},
            )
        )
        if truncated:
            env.close()
            return steps
        observation, reward, _, truncated, info = env.step(len(steps) % 2)


@pytest.mark.parametrize("case", CASES)
def test_a_replay_is_the_live_episode_bit_for_bit(case, tmp_path):
    seed, recorded, period = CASES[case]
    record_sequence(tmp_path / f"{seed}.h5", recorded, seed, period)
    live, replay = SyntheticStream(recorded), RecordingStream(tmp_path)
    for name in ("camera", "slices", "lidar_period", "max_depth"):
        assert getattr(replay, name) == getattr(live, name)
    assert rollout(replay, seed) == rollout(live, seed)
    live.reset(seed)
    replay.reset(seed)
    assert replay.describe() == live.describe()
    replay.close()


def test_events_bins_and_voxel_grids_agree_with_the_live_stream(recording, samples):
    everything = recording.events(0, SLICES * SLICE_US)
    assert everything.dtype == EVENT_DTYPE and np.all(np.diff(everything["t"]) >= 0)
    assert recording.event_counts.tolist() == [sample.event_count for sample in samples]
    for k in (0, 1, 7, SLICES):
        assert recording.bins(k).dtype == np.int16
        np.testing.assert_array_equal(recording.bins(k), samples[k].bins)
        assert recording.event_count(k) == samples[k].event_count
    np.testing.assert_array_equal(
        recording.voxel(2 * SLICE_US, 7 * SLICE_US), voxel_from_bins([s.bins for s in samples[3:8]])
    )
    t0, t1 = 33_333, 77_777  # no multiples of anything
    inside = everything[(everything["t"] >= t0) & (everything["t"] < t1)]
    assert recording.events(t0, t1).tobytes() == inside.tobytes()
    np.testing.assert_array_equal(
        recording.voxel(t0, t1), voxel_grid(everything, recording.camera.shape, t0, t1)
    )


def test_event_frames_are_the_sums_of_the_bins(recording, samples):
    for k, sample in enumerate(samples):
        frame = recording.event_frame(k)
        assert frame.dtype == np.int16 and frame.any() == (sample.event_count > 0)
        np.testing.assert_array_equal(frame, sample.event_frame)
    for k in (-1, SLICES + 1):
        with pytest.raises(ValueError, match=r"3\.h5: slice: found"):
            recording.event_frame(k)


def test_rows_are_those_that_hdf5_reads(path):
    """In any order, within a chunk and across several, and the same when they are read again."""
    rng = np.random.default_rng(0)
    columns = ("events/t", "events/x", "events/y", "events/p", "depth/codes", "intensity/frames")
    with h5py.File(path) as file:
        content = {name: file[name][:] for name in columns}
    stored = RecordingFile(path)
    for name, rows in content.items():
        for first, last in np.sort(rng.integers(0, len(rows) + 1, (20, 2))).tolist():
            found = stored.read(name, first, last)
            assert found.dtype == rows.dtype and found.shape == rows[first:last].shape
            np.testing.assert_array_equal(found, rows[first:last])
            found[...] = 0  # does not reach what is kept
        assert stored.read(name, 0, len(rows)).tobytes() == rows.tobytes()
    stored.close()


@pytest.mark.parametrize("filters", [{}, {"compression": "lzf"}, {"compression": "gzip", "fletcher32": True}])
def test_files_that_were_packed_otherwise_read_the_same(path, tmp_path, filters):
    repacked = tmp_path / f"{SEED}.h5"
    with h5py.File(path) as source, h5py.File(repacked, "w") as target:
        target.attrs.update(source.attrs)
        for name in Header(SEED, CONFIG, {}, intensity=True).columns:
            chunks = (7, *source[name].shape[1:]) if filters else None
            target.create_dataset(name, data=source[name][:], chunks=chunks, **filters)
    assert rollout(RecordingStream(repacked), SEED) == rollout(RecordingStream(path), SEED)


def test_bins_are_read_when_they_are_asked_for(path, samples, monkeypatch):
    """An extrapolator that does not look at them costs nothing; whoever does finds them, however late."""
    stream = RecordingStream(path)
    early = [stream.reset(SEED), stream.advance(), stream.advance()]
    with monkeypatch.context() as patched:
        patched.setattr(Recording, "bins", lambda *_: pytest.fail("bins were read"))
        env = AdaptiveDepthEnv(stream, extrapolator="repeat")
        env.reset(seed=SEED)
        for _ in range(SLICES):
            env.step(1)
    env.close()
    copy = pickle.loads(pickle.dumps(early[2]))
    for sample, live in zip((*early, copy), (*samples[:3], samples[2]), strict=True):
        np.testing.assert_array_equal(sample.bins, live.bins)


def test_threads_may_share_a_recording(recording):
    def read(start):
        return [recording.events(k * SLICE_US, (k + 1) * SLICE_US).tobytes() for k in range(start, SLICES, 2)]

    expected = [read(0), read(1)]
    with ThreadPoolExecutor(2) as pool:
        for _ in range(3):
            assert list(pool.map(read, (0, 1))) == expected


def test_state_and_labels_of_every_slice(recording, samples):
    for k, sample in enumerate(samples):
        state, label = recording.state(k), label_keyframe(sample.state)
        assert state.pose.tobytes() == sample.state.pose.tobytes()
        assert state.twist.tobytes() == sample.state.twist.tobytes()
        assert (recording.speed[k], recording.shortest_distance[k], recording.new_actors[k]) == (
            sample.state.speed,
            sample.state.shortest_distance,
            sample.state.new_actors,
        )
        causes = recording.keyframe_speed[k], recording.keyframe_distance[k], recording.keyframe_new[k]
        assert causes == (label.speed, label.distance, label.new)
        assert recording.keyframe[k] == label.label
    assert (recording.seed, recording.config, recording.slices) == (SEED, CONFIG, SLICES)


def test_depth_and_motion_between_slices(tmp_path):
    seed, recorded = 6, config(duration_s=0.2)
    record_sequence(tmp_path / "fine.h5", recorded, seed, TICK_US)
    simulator = Simulator(recorded, seed)
    with Recording(tmp_path / "fine.h5") as fine:
        fine.verify()
        for tick in range(7):
            if tick:
                simulator.tick(depth=True)
            depth = quantise(simulator.depth, fine.max_depth)
            assert fine.depth(tick * TICK_US).tobytes() == depth.tobytes()
            pose, twist = simulator.motion()
            assert fine.pose(tick * TICK_US).tobytes() == pose.tobytes()
            assert fine.twist(tick * TICK_US).tobytes() == twist.tobytes()


def test_what_is_not_stored_is_refused(recording):
    with pytest.raises(ValueError, match=r"3\.h5: t_us: found 5000, expected a multiple of 20000"):
        recording.depth(TICK_US)
    with pytest.raises(ValueError, match="found 420000"):
        recording.pose((SLICES + 1) * SLICE_US)
    for k in (-1, SLICES + 1):
        with pytest.raises(ValueError, match=r"3\.h5: slice: found"):
            recording.bins(k)
    for window in ((-1, 5), (5, 5), (0, SLICES * SLICE_US + 1)):
        with pytest.raises(ValueError, match=r"3\.h5: found the window"):
            recording.events(*window)
    with pytest.raises(ValueError, match="depth_period_us: found 15000"):
        record_sequence("never.h5", CONFIG, SEED, 15_000)


def test_pictures_are_8_bit_and_only_there_when_asked_for(path, short, samples):
    live, replay = SyntheticStream(CONFIG), RecordingStream(path)
    live.reset(SEED)
    replay.reset(SEED)
    live.advance()
    replay.advance()
    assert replay.intensity().dtype == np.float32
    np.testing.assert_allclose(replay.intensity(), live.intensity(), atol=0.5001 / 255)
    replay.close()
    without = RecordingStream(short)
    without.reset(SEED)
    with pytest.raises(ValueError, match=r"short\.h5: holds no pictures; record it again with intensity"):
        without.intensity()
    without.close()


def test_plain_h5py_reads_it_and_the_bytes_depend_on_the_arguments_alone(path, tmp_path):
    with h5py.File(path) as file:
        camera = json.loads(file.attrs["config"])["scene"]
        assert camera["fov_deg"] == CONFIG.scene.fov_deg
        assert file["depth/codes"].shape == (SLICES + 1, 120, 160) and file["depth/codes"].dtype == np.uint16
        cuts = file["events/slice_index"][:]
        assert file["events/t"][cuts[3]] >= 3 * SLICE_US > file["events/t"][cuts[3] - 1]
        for name in Header(SEED, CONFIG, {}, intensity=True).columns:
            assert file[name].compression == "gzip"
    record_sequence(tmp_path / "again.h5", CONFIG, SEED, intensity=True)
    assert (tmp_path / "again.h5").read_bytes() == path.read_bytes()


def test_copies_for_other_processes_open_the_file_themselves(recording):
    expected = recording.depth(SLICE_US).tobytes()
    copy = pickle.loads(pickle.dumps(recording))
    assert copy.depth(SLICE_US).tobytes() == expected
    copy.close()
    with multiprocessing.get_context("fork").Pool(1) as pool:  # inherits the open file, must not use it
        child = pool.apply(read_depth, (recording,))
    assert child == expected
    assert recording.depth(SLICE_US).tobytes() == expected


def read_depth(recording):
    return recording.depth(SLICE_US).tobytes()


def test_a_closed_recording_opens_again(path):
    recording = Recording(path)
    recording.close()
    speed = recording.speed
    recording.close()
    recording.close()
    np.testing.assert_array_equal(recording.speed, speed)
    recording.close()


class TestStream:
    def test_out_of_order_calls_are_refused(self, path):
        stream = RecordingStream(path)
        with pytest.raises(RuntimeError, match="reset"):
            stream.advance()
        stream.reset(SEED)
        for _ in range(SLICES):
            stream.advance()
        with pytest.raises(RuntimeError, match=f"ended at slice {SLICES}"):
            stream.advance()
        stream.close()
        stream.close()
        with pytest.raises(RuntimeError, match="reset"):
            stream.describe()

    def test_another_lidar_may_be_replayed_but_not_another_range(self, path):
        live = SyntheticStream(config(rate_hz=25, beams=16))
        replay = RecordingStream([path], lidar=LidarConfig(rate_hz=25, beams=16))
        assert rollout(replay, SEED) == rollout(live, SEED)
        with pytest.raises(ValueError, match=r"found a range of 100\.0 m, expected the recorded 200\.0 m"):
            RecordingStream(path, lidar=LidarConfig(max_depth=100.0))

    def test_seeds_come_from_names_or_from_the_files(self, path, short, tmp_path):
        assert RecordingStream(short).seeds == (SEED,)
        assert RecordingStream(path.parent / path.name).seeds == (SEED,)
        with pytest.raises(ValueError, match=r"short\.h5: found a second recording of seed 3"):
            RecordingStream([path, short])
        with pytest.raises(ValueError, match=r"seed: found 8, expected one of the 1 recorded"):
            RecordingStream(path).reset(8)
        shutil.copy(path, tmp_path / "8.h5")
        with pytest.raises(ValueError, match=r"8\.h5: found the sequence of seed 3, expected 8"):
            RecordingStream(tmp_path).reset(8)

    def test_files_of_another_configuration_are_refused(self, path, short, tmp_path):
        shutil.copy(path, tmp_path / "2.h5")
        shutil.copy(short, tmp_path / "3.h5")
        with pytest.raises(ValueError, match=r"3\.h5: found the configuration"):
            RecordingStream(tmp_path).reset(3)

    def test_nothing_to_replay(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"found no \*\.h5 file"):
            RecordingStream(tmp_path)
        with pytest.raises(FileNotFoundError, match=r"1\.h5"):
            RecordingStream(tmp_path / "1.h5")
        with pytest.raises(ValueError, match="found no files"):
            RecordingStream([])

    def test_it_pickles_in_the_middle_of_a_sequence(self, path):
        stream = RecordingStream(path)
        stream.reset(SEED)
        copy = pickle.loads(pickle.dumps(stream))
        assert copy.advance().bins.tobytes() == stream.advance().bins.tobytes()
        stream.close()
        copy.close()


class TestDamage:
    def read_all(self, path):
        with Recording(path) as recording:
            recording.verify()

    def test_an_undamaged_file_verifies(self, short, path):
        for file in (short, path):
            with Recording(file) as recording:
                recording.verify()
                assert len(recording.events(0, 20_000)) == recording.event_count(1) > 0

    @pytest.mark.parametrize("share", [0.0, 0.001, 0.1, 0.5, 0.999])
    def test_truncated(self, damaged, share):
        os.truncate(damaged, int(share * damaged.stat().st_size))
        with pytest.raises(ValueError, match=r"damaged\.h5: not a readable recording"):
            self.read_all(damaged)

    def test_no_bit_flip_goes_unnoticed(self, short, damaged):
        """Wherever a byte changes, reading fails with the file's name, or nothing of the content changed."""
        clean = short.read_bytes()
        with h5py.File(short) as file:
            content = self.content(file)
        rng = np.random.default_rng(0)
        offsets = [*range(0, 2_000, 97), *rng.integers(2_000, len(clean), 40).tolist()]
        noticed = 0
        for offset in offsets:
            flipped = bytearray(clean)
            flipped[offset] ^= 1 << int(rng.integers(8))
            damaged.write_bytes(flipped)
            try:
                self.read_all(damaged)
            except ValueError as error:
                assert "damaged.h5" in str(error)
                noticed += 1
            else:
                with h5py.File(damaged) as file:
                    assert self.content(file) == content
        assert noticed > len(offsets) // 2

    @staticmethod
    def content(file):
        arrays = {}
        file.visititems(
            lambda name, item: arrays.update({name: item[:].tobytes()}) if hasattr(item, "chunks") else None
        )
        return arrays, {name: str(value) for name, value in file.attrs.items()}

    @pytest.mark.parametrize("name", ["depth", "events", "events/tick_index", "state/keyframe_new"])
    def test_missing_group_or_dataset(self, damaged, name):
        with h5py.File(damaged, "a") as file:
            del file[name]
        with pytest.raises(ValueError, match=rf"damaged\.h5.*{name}.*found None"):
            self.read_all(damaged)

    @pytest.mark.parametrize(
        ("name", "values", "message"),
        [
            ("depth/codes", np.zeros((11, 60, 80), np.uint16), r"shape \(11, 60, 80\)"),
            ("depth/codes", np.zeros((3, 120, 160), np.uint16), r"shape \(3, 120, 160\)"),
            ("depth/codes", np.zeros((11, 120, 160), np.float32), "found float32, expected uint16"),
            ("events/x", np.zeros((4, 4), np.uint16), r"shape \(4, 4\)"),
            ("state/speed", np.zeros((), np.float64), r"shape \(\)"),
            ("events/p", np.zeros(5, np.int8), "expected them to ascend from 0 to the number of events"),
        ],
    )
    def test_wrong_shape_or_type(self, damaged, name, values, message):
        with h5py.File(damaged, "a") as file:
            del file[name]
            file[name] = values
        with pytest.raises(ValueError, match=rf"damaged\.h5.*{message}"), Recording(damaged) as recording:
            recording.bins(1)

    @pytest.mark.parametrize(
        ("name", "value", "message"),
        [
            ("schema_version", 2, "schema_version: found 2, expected 1; record the sequence again"),
            ("schema", b"other", "schema: found 'other'"),
            ("seed", None, "attribute seed: found none"),
            ("config", b"{", "not a readable recording"),
            ("config", b"[]", "found list, expected a JSON object"),
            ("config", b'{"colour": 1}', "DrivingConfig key: found 'colour'"),
            ("config", b'{"resolution": "half"}', "camera_height: found 120.0, expected 240.0"),
            ("depth_period_us", 7, "depth_period_us: found 7"),
        ],
    )
    def test_wrong_header(self, damaged, name, value, message):
        with h5py.File(damaged, "a") as file:
            del file.attrs[name]
            if value is not None:
                file.attrs[name] = value
        with pytest.raises(ValueError, match=rf"damaged\.h5.*{message}"):
            _ = Recording(damaged).seed

    def test_other_files(self, tmp_path):
        text, other = tmp_path / "text.h5", tmp_path / "other.h5"
        text.write_text("no recording")
        with h5py.File(other, "w") as file:
            file["x"] = 1
        for file in (text, other):
            with pytest.raises(ValueError, match=file.name):
                _ = Recording(file).seed
        with pytest.raises(FileNotFoundError, match=r"nothing\.h5"):
            _ = Recording(tmp_path / "nothing.h5").seed

    def test_changed_values_are_found_by_their_checksum(self, damaged):
        with h5py.File(damaged, "a") as file:
            file["depth/codes"][4, 60, 80] += 1
        with Recording(damaged) as recording:
            recording.depth(4 * SLICE_US)  # a consistent file: only the checksum knows
        with pytest.raises(ValueError, match=r"damaged\.h5: depth/codes: found SHA-256 .*, expected"):
            self.read_all(damaged)

    @pytest.mark.parametrize(("name", "value"), [("x", 160), ("y", 120), ("p", 0), ("t", 0)])
    def test_events_that_no_camera_sends_never_reach_the_sums(self, damaged, name, value):
        with h5py.File(damaged, "a") as file:
            cut = int(file["events/slice_index"][3])
            file[f"events/{name}"][cut + 50] = value
        with Recording(damaged) as recording, pytest.raises(ValueError, match=r"damaged\.h5.*events"):
            recording.bins(4)


class TestWriting:
    def test_an_interrupted_write_leaves_nothing(self, tmp_path, monkeypatch):
        at_slice_5(monkeypatch, interrupt)
        with pytest.raises(KeyboardInterrupt):
            record_sequence(tmp_path / "1.h5", CONFIG, SEED)
        assert list(tmp_path.iterdir()) == []

    def test_a_killed_write_leaves_nothing_under_the_final_name(self, tmp_path, monkeypatch):
        (tmp_path / "1.h5").write_bytes(b"before")
        at_slice_5(monkeypatch, lambda: os.kill(os.getpid(), signal.SIGKILL))
        status = forked(lambda: record_sequence(tmp_path / "1.h5", CONFIG, SEED))
        assert os.WTERMSIG(status) == signal.SIGKILL
        assert (tmp_path / "1.h5").read_bytes() == b"before"
        assert sorted(path.name[0] for path in tmp_path.iterdir()) == [".", "1"]

    def test_ctrl_c_while_hdf5_writes(self, tmp_path, monkeypatch):
        write = CheckedOutput.write

        def pressing(self, data):
            signal.raise_signal(signal.SIGINT)
            return write(self, data)

        monkeypatch.setattr(CheckedOutput, "write", pressing)
        # Where a shell began the tests with &, Ctrl-C is ignored.
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            with pytest.raises(KeyboardInterrupt):
                record_sequence(tmp_path / "1.h5", CONFIG, SEED)
            assert list(tmp_path.iterdir()) == []
            assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        finally:
            signal.signal(signal.SIGINT, before)

    def test_a_full_disk_keeps_the_previous_file_and_is_named(self, tmp_path):
        (tmp_path / "1.h5").write_bytes(b"before")

        def write():
            resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))
            with pytest.raises(OSError, match=r"1\.h5: cannot write the recording"):
                record_sequence(tmp_path / "1.h5", CONFIG, SEED)

        assert forked(write) == 0
        assert [path.name for path in tmp_path.iterdir()] == ["1.h5"]
        assert (tmp_path / "1.h5").read_bytes() == b"before"

    def test_a_folder_that_does_not_exist_is_named(self, tmp_path):
        with pytest.raises(OSError, match=r"nowhere/1\.h5: cannot write"):
            record_sequence(tmp_path / "nowhere" / "1.h5", config(duration_s=0.2), SEED)


def interrupt():
    raise KeyboardInterrupt


def at_slice_5(monkeypatch, action):
    """Make the simulator run ``action`` in the middle of the recording."""
    tick = Simulator.tick

    def acting(self, depth):
        tick(self, depth)
        if self.t == 5 * SLICE_US:
            action()

    monkeypatch.setattr(Simulator, "tick", acting)


def forked(action):
    """Exit status of a child process that runs ``action``."""
    child = os.fork()
    if child == 0:
        try:
            action()
        except BaseException as error:
            os.write(2, repr(error).encode())
            os._exit(1)
        os._exit(0)
    return os.waitpid(child, 0)[1]
