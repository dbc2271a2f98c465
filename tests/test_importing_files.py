"""Readers of real event files: the published layouts, lazy windows, and everything that can be wrong."""

import importlib.util
import pickle

import h5py
import numpy as np
import pytest
from event_files import (
    DSEC_SHAPE,
    some_events,
    write_dat,
    write_depth,
    write_dsec,
    write_evt2,
    write_evt3,
    write_m3ed,
)

from nl_env.importing import DatEvents, DepthMaps, Evt2Events, MsIndexedEvents, cameras_in, open_events
from nl_env.importing.prophesee import BLOCK_WORDS

SHAPE = (48, 64)
EVENTS = some_events(SHAPE, 300_000, 4_000)
needs_evt3 = pytest.mark.skipif(
    importlib.util.find_spec("evt3") is None, reason="the package evt3 is optional"
)


def window(events, start, stop):
    return events[(events["t"] >= start) & (events["t"] < stop)]


def change(path, name, content):
    """Replace a dataset; ``content`` may be a function of the old one, or None to delete it."""
    with h5py.File(path, "r+") as file:
        old = file[name][()]
        del file[name]
        new = content(old) if callable(content) else content
        if new is not None:
            file[name] = new
    return path


def flip(path, name, chunk):
    """Change a byte in the middle of a chunk of a dataset."""
    with h5py.File(path) as file:
        found = file[name].id.get_chunk_info(chunk)
    data = bytearray(path.read_bytes())
    data[found.byte_offset + found.size // 2] ^= 0xFF
    path.write_bytes(data)


def unknown_filter(path, group, name, shape):
    """Add a dataset of one chunk that nothing here can decompress."""
    with h5py.File(path, "r+") as file:
        properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        properties.set_chunk(shape)
        properties.set_filter(32_900, h5py.h5z.FLAG_OPTIONAL)  # a number that no package claims
        space = h5py.h5s.create_simple(shape)
        dataset = h5py.h5d.create(file[group].id, name, h5py.h5t.STD_U32LE, space, properties)
        dataset.write_direct_chunk((0,) * len(shape), b"compressed by something")


def late(ms):
    """A change of the index: the events of one millisecond are counted before it."""

    def changed(index):
        index[ms] = index[ms + 1]
        return index

    return changed


def at(k, value):
    """A change of one element."""

    def changed(old):
        old[k] = value
        return old

    return changed


# HDF5 with an index by millisecond


@pytest.mark.parametrize(
    ("group", "layout"), [("prophesee/left", "M3ED"), ("prophesee/event_cam_left", "EvTTC")]
)
def test_m3ed_and_evttc(tmp_path, group, layout):
    intrinsics = [50.0, 52.0, 30.5, 25.0]
    source = open_events(write_m3ed(tmp_path / "a.h5", EVENTS, SHAPE, intrinsics, group))
    assert (source.layout, source.shape, len(source)) == (layout, SHAPE, len(EVENTS))
    assert (source.calibration.focal, source.calibration.cx, source.calibration.cy) == (51.0, 30.5, 25.0)
    assert source.span() == (EVENTS["t"][0], EVENTS["t"][-1])
    np.testing.assert_array_equal(np.concatenate(list(source.blocks(0, 400_000))), EVENTS)
    source.verify()


def test_dsec_times_include_the_offset(tmp_path):
    offset = 49_599_300_523
    events = EVENTS.copy()
    events["t"] += offset
    source = open_events(write_dsec(tmp_path / "events.h5", events, offset))
    assert (source.layout, source.shape, source.calibration) == ("DSEC", DSEC_SHAPE, None)
    assert source.span() == (events["t"][0], events["t"][-1])
    start, stop = offset + 12_345, offset + 67_891
    np.testing.assert_array_equal(source.events(start, stop), window(events, start, stop))
    source.verify()


def test_every_window_is_exact(tmp_path):
    """Also between milliseconds, before the first event, past the last and past the end of the index."""
    source = MsIndexedEvents(write_m3ed(tmp_path / "a.h5", EVENTS, SHAPE))
    rng = np.random.default_rng(1)
    edges = [(0, 1), (0, 1000), (299_000, 299_001), (299_500, 500_000), (400_000, 500_000), (-5_000, 3)]
    edges += [tuple(sorted(rng.choice(320_000, 2, replace=False).tolist())) for _ in range(40)]
    for start, stop in edges:
        np.testing.assert_array_equal(source.events(start, stop), window(EVENTS, start, stop))
    with pytest.raises(ValueError, match="stop_us: found 5 with start_us = 5"):
        source.events(5, 5)


def test_the_index_of_the_release_documentation(tmp_path):
    """The example in DSEC's own reader: times and the index that belongs to them."""
    events = some_events(SHAPE, 1, 10)
    events["t"] = [0, 500, 2100, 5000, 5000, 7100, 7200, 7200, 8100, 9000]
    path = change(write_dsec(tmp_path / "a.h5", events), "ms_to_idx", [0, 2, 2, 3, 3, 3, 5, 5, 8, 9])
    source = MsIndexedEvents(path)
    source.verify()
    np.testing.assert_array_equal(source.events(2_000, 7_200), events[2:6])


def test_a_source_pickles_and_reopens(tmp_path):
    source = MsIndexedEvents(write_dsec(tmp_path / "a.h5", EVENTS))
    source.close()
    copy = pickle.loads(pickle.dumps(source))
    np.testing.assert_array_equal(copy.events(0, 50_000), source.events(0, 50_000))


def test_windows_do_not_read_the_rest(tmp_path, monkeypatch):
    source = MsIndexedEvents(write_m3ed(tmp_path / "a.h5", EVENTS, SHAPE))
    rows = []
    read = source._reader.read
    monkeypatch.setattr(source._reader, "read", lambda name, index: rows.append(index) or read(name, index))
    found = len(source.events(100_000, 102_000))
    assert all(index.stop - index.start <= found + 2 for index in rows)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("events/t", at(500, 0), r"found t = 0 at event 500, expected no time before"),
        ("events/t", lambda t: t.astype("i8") - 5_000, r"found times from -\d+ to"),
        ("events/x", at(77, 64_000), r"events: found x = 64000 at event 77, expected 0 to 639"),
        ("events/y", lambda y: at(77, -3)(y.astype("i4")), r"found y = -3 at event 77, expected 0 to 479"),
        ("events/p", at(9, 3), r"found p = 3 at event 9, expected 0 or 1"),
        ("events/p", lambda p: at(9, -1)(p.astype("i1")), r"expected -1 or 1"),
        ("ms_to_idx", lambda index: index + (np.arange(len(index)) > 50), r"ms_to_idx"),
        (
            "ms_to_idx",
            lambda index: index - (np.arange(len(index)) > 50),
            r"ms_to_idx: found events after 299 ms",
        ),
        ("ms_to_idx", late(51), r"ms_to_idx\[51\]: found event \d+, but events/t says"),
        ("ms_to_idx", lambda index: np.roll(index, 1), r"ms_to_idx: found event numbers"),
        ("ms_to_idx", lambda index: index[:100], r"ms_to_idx: found 100 ms, expected \d+ or more"),
        ("ms_to_idx", lambda index: index.astype(float), r"ms_to_idx: found float64"),
        ("events/y", lambda y: y[:-1], r"expected as many of each"),
        ("ms_to_idx", None, r"found no events of the left camera, expected events/t and ms_to_idx"),
        ("events/y", None, r"events/y: found nothing, expected a dataset"),
        ("events/x", lambda x: x.reshape(2, -1), r"events/x: found uint16 \(2, 2000\)"),
        ("events/x", lambda x: x.astype(float), r"expected one integer per event"),
        ("t_offset", np.array([1.5]), r"t_offset: found float64 \(1,\), expected one integer"),
    ],
)
def test_bad_hdf5_is_refused_by_name(tmp_path, name, content, message):
    path = change(write_dsec(tmp_path / "a.h5", EVENTS, 0), name, content)
    with pytest.raises(ValueError, match=message) as error:
        MsIndexedEvents(path).verify()
    assert str(path) in str(error.value)


def test_a_wrong_index_is_found_by_the_read_it_would_spoil(tmp_path):
    path = change(write_m3ed(tmp_path / "a.h5", EVENTS, SHAPE), "prophesee/left/ms_map_idx", late(200))
    source = MsIndexedEvents(path)
    assert len(source.events(50_000, 90_000))
    with pytest.raises(ValueError, match=r"ms_map_idx\[200\]: found event .*, but prophesee/left/t says"):
        source.events(200_000, 210_000)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("calib/resolution", [64], r"calib/resolution: found \[64\], expected 2 finite numbers"),
        ("calib/resolution", [64, 0], "expected pixels"),
        ("calib/intrinsics", [1.0, np.nan, 0, 0], "expected 4 finite numbers"),
        ("calib/intrinsics", [-1.0, 1.0, 0, 0], "found focal lengths -1.0, 1.0"),
    ],
)
def test_bad_calibration(tmp_path, name, content, message):
    path = change(write_m3ed(tmp_path / "a.h5", EVENTS, SHAPE), f"prophesee/left/{name}", content)
    with pytest.raises(ValueError, match=message):
        MsIndexedEvents(path)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_a_truncated_hdf5(tmp_path, share):
    path = write_m3ed(tmp_path / "a.h5", EVENTS, SHAPE)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ValueError, match=r"a\.h5: not a readable HDF5 file"):
        MsIndexedEvents(path)


def test_flipped_bytes_in_a_chunk(tmp_path):
    path = write_dsec(tmp_path / "a.h5", EVENTS, compression="gzip", fletcher32=True, chunks=(1_000,))
    flip(path, "events/x", 2)
    source = MsIndexedEvents(path)
    assert len(source.events(0, 100_000))  # the other chunks are fine
    with pytest.raises(ValueError, match=r"a\.h5: events/x\[.*damaged or truncated"):
        source.verify()


def test_a_file_without_events(tmp_path):
    path = write_dsec(tmp_path / "a.h5", EVENTS)
    for name in "txyp":
        change(path, f"events/{name}", np.zeros(0, np.uint16))
    with pytest.raises(ValueError, match=r"events: found .* expected as many of each, at least 1"):
        MsIndexedEvents(path)


def test_a_missing_filter_names_the_plugin(tmp_path):
    path = change(write_dsec(tmp_path / "a.h5", EVENTS), "events/t", None)
    unknown_filter(path, "events", b"t", (len(EVENTS),))
    with pytest.raises(ValueError, match=r"events/t: compressed with filter 32900 .*install hdf5plugin"):
        MsIndexedEvents(path)


def test_blosc_is_read_where_hdf5plugin_is_installed(tmp_path):
    hdf5plugin = pytest.importorskip("hdf5plugin")
    source = MsIndexedEvents(write_dsec(tmp_path / "a.h5", EVENTS, **hdf5plugin.Blosc(cname="zstd")))
    np.testing.assert_array_equal(source.events(0, 300_000), EVENTS)


def test_what_is_no_event_file(tmp_path):
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["images"] = np.zeros(3)
    assert cameras_in(tmp_path / "other.h5") == cameras_in(tmp_path / "a.txt") == ()
    with pytest.raises(
        ValueError, match=r"found no events of the left camera, expected events/t and ms_to_idx \(DSEC\)"
    ):
        open_events(tmp_path / "other.h5")
    with pytest.raises(FileNotFoundError, match=r"none\.h5: no such file"):
        open_events(tmp_path / "none.h5")
    with pytest.raises(ValueError, match=r"found \.txt, expected one of \.h5, \.hdf5, \.raw, \.dat"):
        open_events(tmp_path / "a.txt")
    right = write_m3ed(tmp_path / "right.h5", EVENTS, SHAPE, group="prophesee/right")
    assert cameras_in(right) == ("right",)
    assert cameras_in(write_dsec(tmp_path / "dsec.h5", EVENTS)) == ("left",)
    assert open_events(right, "right").shape == SHAPE
    with pytest.raises(ValueError, match="found no events of the left camera"):
        open_events(right)
    with pytest.raises(ValueError, match="camera: found 'middle'"):
        open_events(right, "middle")


# Depth maps


def test_depth_maps(tmp_path):
    depth = np.array([[[5.0, np.inf]], [[0.0, np.nan]], [[7.5, 300.0]]])
    maps = DepthMaps(write_depth(tmp_path / "d.h5", depth, [10, 20, 30]))
    assert (maps.shape, len(maps)) == ((1, 2), 3)
    np.testing.assert_array_equal([maps.read(k) for k in range(3)], [[[5, 0]], [[0, 0]], [[7.5, 300]]])
    plain = DepthMaps(write_depth(tmp_path / "plain.h5", depth, [10, 20, 30], name="depth"))
    np.testing.assert_array_equal(plain.read(2), maps.read(2))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("ts", [10, 20, 20], r"ts\[2\]: found 20 us, expected times that ascend"),
        ("ts", [10, 30, 20], r"ts\[2\]: found 20 us"),
        ("ts", [-10, 20, 30], r"ts\[0\]: found -10 us"),
        ("ts", [0.1, 20.0, 20.3], r"ts\[2\]: found 20.3 us"),
        ("ts", [1.0, np.nan, 3.0], r"ts\[1\]: found nan us"),
        ("ts", [1.0, 2.0, np.inf], r"ts\[2\]: found inf us"),
        ("ts", [1.0, 2.0, 1e300], r"ts\[2\]: found 1e\+300 us"),
        ("ts", [True, False, True], r"ts: found bool \(3,\), expected times in us"),
        ("ts", [10, 20], r"expected \(N, H, W\) and \(N,\)"),
        (
            "depth/prophesee/left",
            np.zeros((3, 2, 2), "S2"),
            r"depth/prophesee/left: found \|S2, expected numbers",
        ),
        ("ts", None, "ts: found nothing"),
        ("depth/prophesee/left", None, "depth/prophesee/left: found nothing"),
        ("depth/prophesee/left", np.zeros((3, 2)), r"found depth/prophesee/left \(3, 2\)"),
    ],
)
def test_bad_depth_files(tmp_path, name, content, message):
    path = change(write_depth(tmp_path / "d.h5", np.ones((3, 2, 2)), [10, 20, 30]), name, content)
    with pytest.raises(ValueError, match=message):
        DepthMaps(path)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_a_truncated_depth_file(tmp_path, share):
    path = write_depth(tmp_path / "d.h5", np.ones((3, 20, 30)), [10, 20, 30])
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ValueError, match=r"d\.h5: not a readable HDF5 file"):
        DepthMaps(path)


def test_flipped_bytes_in_a_depth_map(tmp_path):
    depth = np.random.default_rng(0).uniform(1, 50, (3, 20, 30))
    path = write_depth(tmp_path / "d.h5", depth, [10, 20, 30], compression="gzip")
    flip(path, "depth/prophesee/left", 1)
    maps = DepthMaps(path)
    np.testing.assert_allclose(maps.read(2), depth[2], rtol=1e-6)
    with pytest.raises(ValueError, match=r"d\.h5: depth/prophesee/left\[1\]: damaged or truncated"):
        maps.read(1)


def test_depth_compressed_with_a_missing_filter(tmp_path):
    path = change(write_depth(tmp_path / "d.h5", np.ones((2, 2, 2)), [10, 20]), "depth/prophesee/left", None)
    unknown_filter(path, "depth/prophesee", b"left", (2, 2, 2))
    maps = DepthMaps(path)
    with pytest.raises(ValueError, match=r"left: compressed with filter 32900 .*install hdf5plugin"):
        maps.read(0)


def test_negative_depth(tmp_path):
    maps = DepthMaps(write_depth(tmp_path / "d.h5", np.full((2, 2, 2), -1.5), [10, 20]))
    with pytest.raises(ValueError, match=r"depth/prophesee/left\[1\]: found -1.5 m"):
        maps.read(1)


# Prophesee

WRITERS = [write_dat, write_evt2, pytest.param(write_evt3, marks=needs_evt3)]


def write_prophesee(writer, folder, events):
    if writer is write_dat:
        return write_dat(folder / "a.dat", events, DSEC_SHAPE)
    return writer(folder / "a.raw", events)


@pytest.mark.parametrize("writer", WRITERS)
def test_prophesee_files(tmp_path, writer):
    events = some_events((480, 640), 300_000, 3_000, seed=2, start_us=17_000_000)  # past 24 bits of us
    source = open_events(write_prophesee(writer, tmp_path, events))
    assert source.shape == (480, 640)
    assert source.span() == (events["t"][0], events["t"][-1])
    for start, stop in [(0, 10**9), (17_050_000, 17_123_456), (0, 17_000_000)]:
        found = np.concatenate(list(source.blocks(start, stop)))
        np.testing.assert_array_equal(found, window(events, start, stop))
    source.verify()


def test_evt2_times_go_on_across_blocks(tmp_path):
    """A block may begin without a word of time: the one before still holds."""
    events = some_events((480, 640), 60, 4, seed=3)
    path = write_evt2(tmp_path / "a.raw", events)
    words = np.frombuffer(path.read_bytes()[path.read_bytes().rindex(b"480\n") + 4 :], "<u4")
    filler = np.full(BLOCK_WORDS, 0xE << 28, "<u4")
    lead = np.array([1 << 28], "<u4")  # an event before the first word of time has none
    header = b"% evt 2.0\n% geometry 640x480\n"
    path.write_bytes(header + np.concatenate([lead, words[:3], filler, words[3:]]).tobytes())
    np.testing.assert_array_equal(np.concatenate(list(open_events(path).blocks(0, 100))), events)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "found no header"),
        (b"\x00\x01", "found no header"),
        (b"% evt 2.0", "found a header without an end"),
        (b"% evt 2.0\n", "found no sensor size in its header, expected --sensor WIDTH HEIGHT"),
        (b"% evt 2.1\n% geometry 640x480\n", "found the encoding 2.1, expected evt 2.0 or 3.0"),
        (b"% format EVT21;height=4;width=4\n", "found the encoding 2.1"),
        (b"% date today\n", "found the encoding None"),
        (b"% evt 2.0\n% geometry 0x480\n", "found a sensor of 480x0"),
    ],
)
def test_bad_raw_headers(tmp_path, text, message):
    path = tmp_path / "a.raw"
    path.write_bytes(text)
    with pytest.raises(ValueError, match=message):
        open_events(path)


def test_the_caller_may_say_the_size(tmp_path):
    path = write_evt2(tmp_path / "a.raw", EVENTS, header=b"% evt 2.0\n")
    assert open_events(path, sensor=(480, 640)).shape == (480, 640)
    with pytest.raises(ValueError, match=r"found x = \d+ at event \d+, expected 0 to 31"):
        open_events(path, sensor=(480, 32)).verify()


@pytest.mark.parametrize("writer", WRITERS)
def test_truncated_prophesee_files(tmp_path, writer):
    path = write_prophesee(writer, tmp_path, EVENTS)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ValueError, match="cut off"):
        open_events(path).span()


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
@pytest.mark.parametrize("writer", WRITERS)
def test_a_prophesee_file_cut_between_two_words_is_a_shorter_one(tmp_path, writer, share):
    """Nothing in it says how long it was; what is left is right."""
    path = write_prophesee(writer, tmp_path, EVENTS)
    whole = path.read_bytes()
    removed = 8 * int((1 - share) * (len(whole) - 200) / 8 + 1)
    path.write_bytes(whole[:-removed])
    found = np.concatenate(list(open_events(path).blocks(0, 10**9)))
    assert 0 < len(found) < len(EVENTS)
    np.testing.assert_array_equal(found, EVENTS[: len(found)])


@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize(("name", "value", "last"), [("x", 700, 639), ("y", 500, 479)])
def test_events_off_the_sensor(tmp_path, writer, name, value, last):
    events = EVENTS.copy()
    events[name][3_000] = value
    source = open_events(write_prophesee(writer, tmp_path, events))
    with pytest.raises(ValueError, match=rf"found {name} = {value} at event 3000, expected 0 to {last}"):
        source.verify()


@pytest.mark.parametrize("writer", WRITERS)
def test_times_that_go_back(tmp_path, writer):
    events = some_events(DSEC_SHAPE, 4_000, 40)  # all within what EVT 3.0's lower words can say
    events["t"][:] = 100 * np.arange(40)
    events["t"][20] = 2_150
    source = open_events(write_prophesee(writer, tmp_path, events))
    with pytest.raises(
        ValueError, match=r"found t = 2100 at event 21, expected no time before that of the prev"
    ):
        source.span()


def test_bad_dat_files(tmp_path):
    path = tmp_path / "a.dat"
    with pytest.raises(ValueError, match="found version 1 of DAT, expected 2"):
        open_events(write_dat(path, EVENTS, SHAPE, version="1"))
    with pytest.raises(ValueError, match=r"found event type and size \(14, 8\)"):
        open_events(write_dat(path, EVENTS, SHAPE, kind=0x0E))
    with pytest.raises(ValueError, match="found no events"):
        DatEvents(write_dat(path, EVENTS[:0], SHAPE)).span()
    unsorted = EVENTS.copy()
    unsorted["t"][100] = 0
    with pytest.raises(ValueError, match="found t = 0 at event 100"):
        DatEvents(write_dat(path, unsorted, SHAPE)).span()
    with pytest.raises(FileNotFoundError, match=r"none\.dat: no such file"):
        open_events(tmp_path / "none.dat")


def test_a_raw_file_of_the_other_encoding(tmp_path):
    path = write_evt2(tmp_path / "a.raw", EVENTS, header=b"% evt 3.0\n% geometry 64x48\n")
    with pytest.raises(ValueError, match=r"found the encoding 3.0, expected evt 2.0"):
        Evt2Events(path)


def test_evt3_without_its_package_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "evt3", None)
    with pytest.raises(ImportError, match=r"a\.raw: EVT 3.0 needs the package evt3 \(pip install"):
        open_events(write_evt3(tmp_path / "a.raw", EVENTS))
