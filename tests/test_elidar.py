"""Reading ELiDAR: pairs, labelled event frames, raw sequences, and what their readers refuse."""

import multiprocessing
import pickle
import subprocess
import sys
import zipfile

import h5py
import numpy as np
import pytest
from elidar_files import HEADER, ROWS, SIZE, TICKS, frame, grid, write_pairs, write_raw

from nl_env.elidar import (
    ExtrapolationData,
    RawSequence,
    SlicingData,
    find_files,
    parse_sequence_name,
    read_sequence_list,
)
from nl_env.elidar.layout import METADATA_FILE, PAIRS_FILE

NAME = "Town01_Opt_00"


def flip_chunk(path, name, chunk):
    """Invert four bytes in the middle of a chunk."""
    with h5py.File(path) as file:
        found = file[name].id.get_chunk_info(chunk)
    flip(path, found.byte_offset + found.size // 2)


def flip(path, place):
    """Invert four bytes."""
    content = bytearray(path.read_bytes())
    content[place : place + 4] = bytes(255 - byte for byte in content[place : place + 4])
    path.write_bytes(content)


def unknown_filter(path, group, name, shape):
    """Add a dataset, one image a chunk, that nothing here can decompress."""
    with h5py.File(path, "r+") as file:
        properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        properties.set_chunk((1, *shape[1:]))
        properties.set_filter(32_900, h5py.h5z.FLAG_OPTIONAL)  # a number that no package claims
        space = h5py.h5s.create_simple(shape)
        dataset = h5py.h5d.create(file[group].id, name, h5py.h5t.IEEE_F32LE, space, properties)
        dataset.write_direct_chunk((0,) * len(shape), b"compressed by something")


def masked(k):
    depth = frame(k)[0]
    depth[0] = 0
    return depth


def test_pairs_come_back_with_times_and_without_what_is_out_of_range(tmp_path):
    data = ExtrapolationData(*write_pairs(tmp_path))
    assert len(data) == len(ROWS)
    assert data.shape == SIZE
    np.testing.assert_array_equal(data.ticks[NAME], TICKS)
    np.testing.assert_array_equal(data.durations, [10, 4, 6, 20, 20])
    for index, (events_id, prior, truth, duration) in enumerate(ROWS):
        pair = data[index]
        np.testing.assert_array_equal(pair.prior, masked(prior))
        np.testing.assert_array_equal(pair.truth, masked(truth))
        np.testing.assert_array_equal(pair.voxel, grid(events_id))
        assert (pair.sequence, pair.duration) == (NAME, duration)
        assert pair.prior.dtype == pair.voxel.dtype == pair.truth.dtype == np.float32
    with pytest.raises(IndexError, match="found 5, expected 0 to 4"):
        data[len(ROWS)]


@pytest.mark.parametrize("dtype", ["int8", "int16", "float16", "float32", "float64", ">i4"])
@pytest.mark.parametrize("chunks", [None, (1, 5, *SIZE), (4, 2, 3, 8)])
def test_any_dtype_and_chunking_reads_the_same(tmp_path, dtype, chunks):
    options = {"compression": "gzip"} if chunks else {}
    data = ExtrapolationData(*write_pairs(tmp_path, dtype=dtype, chunks=chunks, **options))
    for index in range(len(ROWS)):
        np.testing.assert_array_equal(data[index].voxel, grid(ROWS[index][0]))


@pytest.mark.parametrize("flat", ["rows", "variable length"])
def test_flat_grids_and_frames_without_a_channel_read_the_same(tmp_path, flat):
    hdf5, metadata = write_pairs(tmp_path)
    with h5py.File(hdf5, "r+") as file:
        events = file[f"{NAME}/events"][:].reshape(len(ROWS), -1)
        depth = file[f"{NAME}/depth_frames"][:, 0]
        del file[f"{NAME}/events"], file[f"{NAME}/depth_frames"]
        file[f"{NAME}/depth_frames"] = depth.astype(np.float16)
        if flat == "rows":
            file[f"{NAME}/events"] = events
        else:
            dataset = file.create_dataset(f"{NAME}/events", len(events), h5py.vlen_dtype(np.float32))
            for k, row in enumerate(events):
                dataset[k] = row
    data = ExtrapolationData(hdf5, metadata)
    np.testing.assert_array_equal(data[3].voxel, grid(3))
    np.testing.assert_array_equal(data[3].prior, masked(2))


def test_the_range_decides_what_is_no_return(tmp_path):
    data = ExtrapolationData(*write_pairs(tmp_path), max_depth=3.0)
    assert data.depth(NAME, 2).max() == 3.0  # at the range is in range
    assert not data.depth(NAME, 3).any()


def test_split_and_sequences_select(tmp_path):
    files = write_pairs(tmp_path, (("train", "Town01_Opt_00"), ("test", "Town02_Opt_ClearNoon")))
    assert list(ExtrapolationData(*files, split="test").sequences) == ["Town02_Opt_ClearNoon"]
    assert list(ExtrapolationData(*files, sequences=["Town01_Opt_00"]).sequences) == ["Town01_Opt_00"]
    with pytest.raises(ValueError, match="found 'Town09_Opt_00', which is not in"):
        ExtrapolationData(*files, sequences=["Town09_Opt_00"])
    with pytest.raises(ValueError, match="split: found 'val'"):
        ExtrapolationData(*files, split="val")


def test_pickles_without_its_handle_and_opens_again(tmp_path):
    data = ExtrapolationData(*write_pairs(tmp_path))
    copy = pickle.loads(pickle.dumps(data))
    np.testing.assert_array_equal(copy[1].truth, data[1].truth)
    data.close()
    data.close()
    np.testing.assert_array_equal(copy[1].truth, data[1].truth)


def test_a_forked_process_opens_the_file_for_itself(tmp_path):
    data = ExtrapolationData(*write_pairs(tmp_path))
    first = data[3]  # the handle is open when the process forks
    with multiprocessing.get_context("fork").Pool(2) as pool:
        for pair in pool.map(data.__getitem__, [3, 0, 3]):
            assert pair.sequence == NAME
        np.testing.assert_array_equal(pair.voxel, first.voxel)
    np.testing.assert_array_equal(data[3].truth, first.truth)


def test_random_samples_need_little_memory(tmp_path):
    """A data set of 38 MB is read in a process that grows by far less."""
    shape = (120, 160)
    hdf5, metadata = tmp_path / "big.h5", tmp_path / "big_metadata.csv"
    rows = 100
    with h5py.File(hdf5, "w") as file:
        depth = file.create_dataset(
            "A_Opt_00/depth_frames", (rows + 1, 1, *shape), "f4", chunks=(8, 1, *shape), compression="gzip"
        )
        events = file.create_dataset(
            "A_Opt_00/events", (rows, 5, *shape), "f4", chunks=(1, 5, *shape), compression="gzip"
        )
        for k in range(rows):
            depth[k], events[k] = 1 + k, k
        depth[rows] = 1
    lines = [f"train,A_Opt_00,{k},{k},{k + 1},4" for k in range(rows)]
    metadata.write_text("\n".join([HEADER, *lines]))
    code = (
        "import resource, sys, numpy as np; from pathlib import Path;"
        "from nl_env.elidar import ExtrapolationData;"
        f"data = ExtrapolationData(Path({str(hdf5)!r}), Path({str(metadata)!r}));"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss;"
        "chosen = np.random.default_rng(0).integers(0, len(data), 200);"
        "assert all(data[int(k)].voxel[0, 0, 0] == k for k in chosen);"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(result.stdout) < 12_000  # kB


def test_labelled_event_frames(tmp_path):
    path = tmp_path / "slicing.h5"
    frames = np.arange(3 * 48).reshape(3, *SIZE).astype(np.int8)
    with h5py.File(path, "w") as file:
        file["train/event_frames"] = frames
        file["train/scores"] = np.array([0, 1, 1])
        file["test/event_frames"] = frames[:, None].astype(np.float32)
        file["test/scores"] = np.array([[1.0], [0.0], [0.0]])
    for split, scores in (("train", [0, 1, 1]), ("test", [1, 0, 0])):
        data = pickle.loads(pickle.dumps(SlicingData(path, split)))
        assert (len(data), data.shape) == (3, SIZE)
        for k in range(3):
            image, score = data[k]
            np.testing.assert_array_equal(image, frames[k])
            assert image.dtype == np.float32
            assert score == scores[k]
    with pytest.raises(ValueError, match="split: found 'val'"):
        SlicingData(path, "val")


def write_slicing(path, **changes):
    """Three labelled frames in either split; ``changes`` replace datasets of the training split."""
    arrays = {"event_frames": np.ones((3, *SIZE), np.float32), "scores": np.array([0.0, 1.0, 1.0])}
    with h5py.File(path, "w") as file:
        for split, content in (("test", arrays), ("train", {**arrays, **changes})):
            for name, array in content.items():
                if array is not None:
                    file.create_dataset(f"{split}/{name}", data=array)
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"event_frames": None}, "train/event_frames: found nothing, expected a dataset"),
        ({"scores": None}, "train/scores: found nothing, expected a dataset"),
        ({"event_frames": np.ones((3, 48))}, r"found shape \(3, 48\), expected \(N, H, W\)"),
        ({"event_frames": np.ones((3, 2, *SIZE))}, r"found shape \(3, 2, 6, 8\), expected \(N, H, W\)"),
        ({"event_frames": np.zeros((3, *SIZE), "S2")}, r"found \|S2, expected numbers"),
        ({"scores": np.zeros(4)}, r"scores: found shape \(4,\), expected \(3,\)"),
        ({"scores": np.array([0, np.nan, 1])}, r"scores\[1\]: found nan, expected a label in \[0, 1\]"),
        ({"scores": np.array([0, 1, -1])}, r"scores\[2\]: found -1.0, expected a label"),
    ],
)
def test_labelled_frames_that_do_not_fit_are_refused(tmp_path, changes, message):
    path = write_slicing(tmp_path / "slicing.h5", **changes)
    assert len(SlicingData(path, "test")) == 3
    with pytest.raises(ValueError, match=message):
        SlicingData(path, "train")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_impossible_event_frames_are_refused_when_they_are_read(tmp_path, value):
    frames = np.ones((3, *SIZE), np.float32)
    frames[1, 2, 2] = value
    data = SlicingData(write_slicing(tmp_path / "slicing.h5", event_frames=frames), "train")
    data[0]
    with pytest.raises(ValueError, match=r"train/event_frames\[1\]: found NaN or infinity"):
        data.frames()[0:2]
    with pytest.raises(IndexError, match="event frame: found 3, expected 0 to 2"):
        data[3]


def test_flipped_bytes_in_a_labelled_frame_are_found(tmp_path):
    path = tmp_path / "slicing.h5"
    frames = np.random.default_rng(0).integers(-3, 4, (3, *SIZE)).astype(np.int16)
    with h5py.File(path, "w") as file:
        file.create_dataset("train/event_frames", data=frames, chunks=(1, *SIZE), fletcher32=True)
        file["train/scores"] = np.zeros(3)
    flip_chunk(path, "train/event_frames", 1)
    data = SlicingData(path, "train")
    np.testing.assert_array_equal(data[0][0], frames[0])
    with pytest.raises(ValueError, match=r"slicing\.h5: train/event_frames\[1\]: damaged or truncated"):
        data[1]


def test_labelled_frames_behind_a_missing_filter_name_the_plugin(tmp_path):
    path = write_slicing(tmp_path / "slicing.h5", event_frames=None)
    unknown_filter(path, "train", b"event_frames", (3, *SIZE))
    with pytest.raises(ValueError, match=r"event_frames: compressed with filter 32900 .*hdf5plugin"):
        SlicingData(path, "train")[0]


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_a_truncated_slicing_file_is_refused(tmp_path, share):
    path = write_slicing(tmp_path / "slicing.h5")
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    with pytest.raises(ValueError, match=r"slicing\.h5: not a readable HDF5 file .*truncated"):
        SlicingData(path, "train")


def test_causes_are_told_where_the_label_follows_from_them(tmp_path):
    raw = RawSequence(write_raw(tmp_path / "raw.npz"))
    np.testing.assert_array_equal(raw.causes, [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0]])
    other = RawSequence(write_raw(tmp_path / "other.npz", key_frame=np.array([1, 1, 1, 0])))
    np.testing.assert_array_equal(other.causes, [[1], [1], [1], [0]])
    np.testing.assert_array_equal(raw.frames()[1:3], np.clip([raw.frame(1), raw.frame(2)], -128, 127))


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_raw_sequences_read_in_any_order(tmp_path, save):
    path = write_raw(tmp_path / "Town01_Opt_00.npz")
    with np.load(path) as arrays:
        content = dict(arrays)
    save(path, **content)
    raw = RawSequence(path)
    assert (len(raw), raw.shape) == (4, SIZE)
    for k in (0, 1, 3, 2, 0):
        np.testing.assert_array_equal(raw.frame(k), content["frames"][k])
    np.testing.assert_array_equal(raw.keyframe, [False, True, True, False])
    np.testing.assert_array_equal(raw.ego_speed, [0, 11, 3, 2])
    assert raw.shortest_distance[0] == np.inf
    copy = pickle.loads(pickle.dumps(raw))
    raw.close()
    np.testing.assert_array_equal(copy.frame(2), raw.frame(2))


@pytest.mark.parametrize(
    ("name", "group"),
    [
        ("Town05_Opt_ClearNoon", "Clear"),
        ("Town02_Opt_MidRainyNoon", "Rain"),
        ("Town02_Opt_SoftRainSunset", "Rain"),
        ("Town10HD_Opt_WetCloudySunset", "WetCloudy"),
        ("Town05_Opt_03", None),
    ],
)
def test_sequence_names_give_town_and_weather(name, group):
    parsed = parse_sequence_name(name)
    assert parsed.town == name.split("_")[0]
    assert parsed.weather_group == group
    assert (parsed.number is None) == (group is not None)


def test_sequence_names_of_another_form_are_refused():
    with pytest.raises(ValueError, match="found 'Town05-ClearNoon', expected a name like"):
        parse_sequence_name("Town05-ClearNoon")


def test_sequence_lists(tmp_path):
    path = tmp_path / "train_sequences.txt"
    path.write_text("Town01_Opt_00\r\nTown01_Opt_01\n\n")
    assert read_sequence_list(path) == ("Town01_Opt_00", "Town01_Opt_01")
    path.write_text("Town01_Opt_00\nTown01_Opt_00\n")
    with pytest.raises(ValueError, match="found Town01_Opt_00 more than once"):
        read_sequence_list(path)
    path.write_text("\n")
    with pytest.raises(ValueError, match="found no sequence name"):
        read_sequence_list(path)


# What the readers refuse.


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_a_truncated_file_is_refused(tmp_path, share):
    hdf5, metadata = write_pairs(tmp_path)
    content = hdf5.read_bytes()
    hdf5.write_bytes(content[: int(len(content) * share)])
    with pytest.raises(ValueError, match=r"pairs\.h5: not a readable HDF5 file .*truncated"):
        ExtrapolationData(hdf5, metadata)


def test_flipped_bytes_in_a_chunk_are_found(tmp_path):
    hdf5, metadata = write_pairs(tmp_path, chunks=(1, 5, *SIZE), compression="gzip")
    flip_chunk(hdf5, f"{NAME}/events", 2)
    data = ExtrapolationData(hdf5, metadata)
    assert data[1].duration == 4  # the other chunks are fine
    with pytest.raises(ValueError, match=rf"pairs\.h5: {NAME}/events\[2\]: damaged"):
        data[2]


def test_a_missing_compression_filter_names_the_plugin(tmp_path):
    hdf5, metadata = write_pairs(tmp_path)
    with h5py.File(hdf5, "r+") as file:
        del file[f"{NAME}/events"]
    unknown_filter(hdf5, NAME, b"events", (len(ROWS), 5, *SIZE))
    data = ExtrapolationData(hdf5, metadata)
    with pytest.raises(ValueError, match=r"compressed with filter 32900 .*hdf5plugin"):
        data[0]


def replaced(name, content):
    def change(file):
        del file[name]
        if content is not None:
            file[name] = content

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (replaced(f"{NAME}/events", None), "events: found nothing, expected a dataset"),
        (replaced(NAME, None), "depth_frames: found nothing, expected a dataset"),
        (replaced(f"{NAME}/events", np.zeros((5, *SIZE))), r"events: found shape \(5, 6, 8\), expected"),
        (replaced(f"{NAME}/events", np.zeros((5, 5, 6, 9))), r"events: found shape \(5, 5, 6, 9\), expected"),
        (replaced(f"{NAME}/depth_frames", np.zeros((4, 2, *SIZE))), r"expected \(N, 1, H, W\)"),
        (replaced(f"{NAME}/depth_frames", np.zeros((4, *SIZE), "S3")), "found |S3, expected numbers"),
        (replaced(f"{NAME}/depth_frames", np.zeros((3, *SIZE))), "line 5: found gt_depth_frame_id 3"),
        (
            replaced(f"{NAME}/events", np.zeros((4, 5, *SIZE))),
            "line 6: found events_id 4, expected at most 3",
        ),
    ],
)
def test_datasets_that_do_not_fit_are_refused(tmp_path, change, message):
    hdf5, metadata = write_pairs(tmp_path)
    with h5py.File(hdf5, "r+") as file:
        change(file)
    with pytest.raises(ValueError, match=message):
        ExtrapolationData(hdf5, metadata)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_impossible_depth_is_refused_when_it_is_read(tmp_path, value):
    hdf5, metadata = write_pairs(tmp_path)
    with h5py.File(hdf5, "r+") as file:
        file[f"{NAME}/depth_frames"][3, 0, 2, 2] = value
    data = ExtrapolationData(hdf5, metadata)
    data[0]
    with pytest.raises(ValueError, match=rf"{NAME}/depth_frames\[3\]: found depths from"):
        data[3]


def test_sequences_of_different_sizes_are_refused(tmp_path):
    hdf5, metadata = write_pairs(tmp_path, [("train", NAME), ("train", "Town02_Opt_00")])
    with h5py.File(hdf5, "r+") as file:
        replaced("Town02_Opt_00/depth_frames", np.zeros((4, 1, 12, 16)))(file)
        replaced("Town02_Opt_00/events", np.zeros((len(ROWS), 5, 12, 16)))(file)
    with pytest.raises(
        ValueError,
        match=r"Town02_Opt_00/depth_frames: found shape .*12, 16\), expected \(6, 8\) images as in",
    ):
        ExtrapolationData(hdf5, metadata)


def test_a_variable_row_of_another_length_is_refused_when_it_is_read(tmp_path):
    hdf5, metadata = write_pairs(tmp_path)
    with h5py.File(hdf5, "r+") as file:
        del file[f"{NAME}/events"]
        dataset = file.create_dataset(f"{NAME}/events", len(ROWS), h5py.vlen_dtype(np.float32))
        for k in range(len(ROWS)):
            dataset[k] = np.zeros(5 * SIZE[0] * SIZE[1] - (k == 1))
    data = ExtrapolationData(hdf5, metadata)
    data[0]
    with pytest.raises(ValueError, match=r"events\[1\]: found 239 values, expected \(5, 6, 8\)"):
        data[1]


def test_voxel_grids_with_nan_are_refused(tmp_path):
    hdf5, metadata = write_pairs(tmp_path, dtype="f4")
    with h5py.File(hdf5, "r+") as file:
        file[f"{NAME}/events"][1, 2, 2, 2] = np.nan
    with pytest.raises(ValueError, match=rf"{NAME}/events\[1\]: found NaN or infinity"):
        ExtrapolationData(hdf5, metadata)[1]


def test_one_broken_sequence_can_be_skipped_and_is_reported(tmp_path):
    names = ("Town01_Opt_00", "Town02_Opt_00", "Town03_Opt_00")
    hdf5, metadata = write_pairs(tmp_path, [("train", name) for name in names])
    with h5py.File(hdf5, "r+") as file:
        del file["Town02_Opt_00/events"]
    lines = metadata.read_text().split("\n")
    lines[-2] = lines[-2].replace(",20", ",40")  # contradicts the row before, in the last sequence
    metadata.write_text("\n".join(lines))
    data = ExtrapolationData(hdf5, metadata, on_error="skip")
    assert list(data.sequences) == ["Town01_Opt_00"]
    assert [problem.sequence for problem in data.problems] == list(names[1:])
    assert "Town02_Opt_00/events: found nothing" in data.problems[0].message
    with pytest.raises(ValueError, match="found no usable sequence of split test"):
        ExtrapolationData(hdf5, metadata, split="test", on_error="skip")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": np.array([None] * 4, object)}, "frames: .*(cannot be read|found)"),
        ({"key_frame": np.array([None] * 4, object)}, "key_frame: cannot be read .*allow_pickle=False"),
        ({"ego_velocity": None}, "found no ego_velocity"),
        ({"num_new_actors": np.zeros(3)}, r"num_new_actors: found float64 \(3,\), expected 4 numbers"),
        ({"key_frame": np.array([0, 1, 2, 0])}, r"key_frame\[2\]: found 2.0, expected a number in \[0, 1\]"),
        ({"ego_velocity": np.array([0, np.nan, 0, 0])}, r"ego_velocity\[1\]: found nan"),
        ({"shortest_distance": np.array([0, 1, -1, 0])}, r"shortest_distance\[2\]: found -1.0"),
        ({"frames": np.zeros((4, 48))}, r"frames: found shape \(4, 48\), expected \(N, H, W\)"),
        ({"frames": np.zeros((4, *SIZE)).T}, "frames: found a column-major array"),
        ({"frames": np.zeros((4, *SIZE), "S2")}, "frames: found a .*S2 array, expected row-major numbers"),
        ({"frames": np.zeros((5, *SIZE))}, r"key_frame: found int64 \(4,\), expected 5 numbers"),
        ({"shortest_distance": np.array([0, np.nan, 1, 0])}, r"shortest_distance\[1\]: found nan"),
        ({"num_new_actors": np.array([0, 1, -1, 0])}, r"num_new_actors\[2\]: found -1"),
    ],
)
def test_raw_sequences_that_do_not_fit_are_refused(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        RawSequence(write_raw(tmp_path / "raw.npz", **changes))


@pytest.mark.parametrize("value", [0.5, np.nan, 40_000.0])
def test_raw_event_frames_must_be_whole_counts(tmp_path, value):
    frames = np.zeros((4, *SIZE))
    frames[2, 0, 0] = value
    raw = RawSequence(write_raw(tmp_path / "raw.npz", frames=frames))
    raw.frame(1)
    with pytest.raises(ValueError, match=r"frames\[2\]: found values from"):
        raw.frame(2)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_a_truncated_raw_sequence_is_refused(tmp_path, share):
    path = write_raw(tmp_path / "raw.npz")
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    with pytest.raises(ValueError, match=r"raw\.npz: not a readable \.npz"):
        RawSequence(path)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_flipped_bytes_in_a_raw_sequence_are_found_when_all_of_it_is_read(tmp_path, save):
    """By the checksum of the archive, which covers all frames together."""
    path = write_raw(tmp_path / "raw.npz")
    with np.load(path) as arrays:
        content = dict(arrays)
    content["frames"] = np.random.default_rng(0).integers(-9, 9, (40, 60, 80)).astype(np.int16)
    content |= {name: np.zeros(40) for name in content if name != "frames"}
    save(path, **content)
    with zipfile.ZipFile(path) as archive:
        info = archive.getinfo("frames.npy")
    whole = path.read_bytes()
    for share in (0.3, 0.5, 0.7, 0.9):
        path.write_bytes(whole)
        flip(path, info.header_offset + 30 + int(share * info.compress_size))
        raw = RawSequence(path)
        with pytest.raises(ValueError, match=r"raw\.npz: frames\[\d+\]: damaged or truncated"):
            for k in range(len(raw)):
                raw.frame(k)


@pytest.mark.parametrize("name", ["frames", "ego_velocity"])
def test_a_raw_sequence_that_cannot_be_decompressed_is_refused(tmp_path, name):
    path = tmp_path / "raw.npz"
    rng = np.random.default_rng(0)
    content = dict.fromkeys(("key_frame", "shortest_distance", "num_new_actors"), np.zeros(400))
    frames = rng.integers(-9, 9, (400, *SIZE)).astype(np.int16)
    np.savez_compressed(path, frames=frames, ego_velocity=rng.random(400), **content)
    with zipfile.ZipFile(path) as archive:
        info = archive.getinfo(f"{name}.npy")
    middle = info.header_offset + info.compress_size // 2
    whole = path.read_bytes()
    path.write_bytes(whole[:middle] + b"\xff" * 200 + whole[middle + 200 :])
    with pytest.raises(ValueError, match=rf"raw\.npz: {name}"):
        raw = RawSequence(path)
        for k in range(len(raw)):
            raw.frame(k)


# Finding the files of a folder.


def test_files_are_found_by_content(tmp_path):
    hdf5, metadata = write_pairs(tmp_path / "extrapolation")
    with h5py.File(tmp_path / "labels.hdf5", "w") as file:
        file["test/event_frames"] = np.zeros((1, *SIZE))
    (tmp_path / "raw_data").mkdir()
    raw = write_raw(tmp_path / "raw_data" / "Town01_Opt_00.npz")
    np.savez(tmp_path / "results.npz", table=np.zeros(3))
    found = find_files(tmp_path)
    assert found.require_pairs() == (hdf5, metadata)
    assert found.require_slicing() == tmp_path / "labels.hdf5"
    assert found.raw == {"Town01_Opt_00": raw}
    assert "raw sequences: 1 .npz" in found.describe()
    assert "sequence lists: none" in found.describe()


def test_an_empty_or_missing_folder_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="found none of ELiDAR's files"):
        find_files(tmp_path)
    with pytest.raises(FileNotFoundError, match="not a folder"):
        find_files(tmp_path / "nowhere")


@pytest.mark.parametrize(("gone", "missing"), [(0, PAIRS_FILE), (1, METADATA_FILE)])
def test_half_of_the_files_is_refused(tmp_path, gone, missing):
    files = write_pairs(tmp_path)
    files[gone].unlink()
    with pytest.raises(
        FileNotFoundError, match=f"found no {missing.name}, found only .*{files[1 - gone].name}"
    ):
        find_files(tmp_path).require_pairs()
    with pytest.raises(FileNotFoundError, match="found no keyframe HDF5"):
        find_files(tmp_path).require_slicing()


def test_two_candidates_are_refused(tmp_path):
    write_pairs(tmp_path / "one")
    write_pairs(tmp_path / "two")
    with pytest.raises(ValueError, match="found 2 files for extrapolation HDF5, expected one"):
        find_files(tmp_path)
