import dataclasses
import json
import os
import pickle
import shutil

import numpy as np
import pytest
from analytic_stream import WallStream

from nl_env.config import LidarConfig
from nl_env.depth.extrapolators import Warp
from nl_env.trace_files import (
    COLUMNS,
    default_folder,
    open_trace,
    open_traces,
    read_source,
    trace_files,
    verify_trace,
    write_trace,
)
from nl_env.trace_source import (
    ExtrapolatorIdentity,
    TraceSource,
    file_digest,
    identify_extrapolator,
    weights_digest,
)
from nl_env.trace_stream import TraceFolder
from nl_env.traces import trace_sequence

WARP = ExtrapolatorIdentity("warp", "", False)
SOURCE = TraceSource.of("0" * 64, WARP, LidarConfig())
SEED = 5


@pytest.fixture(scope="module")
def trace():
    return trace_sequence(WallStream(slices=12), Warp(), SEED)


@pytest.fixture
def path(trace, tmp_path):
    path = tmp_path / f"{SEED}.safetensors"
    write_trace(path, trace, SOURCE)
    return path


def test_what_is_read_is_what_was_written(trace, path):
    read = open_trace(path, SOURCE)
    assert (read.seed, read.description, read.lidar_period) == (SEED, {"scenario": "wall"}, 5)
    for name in ("images", *COLUMNS):
        found, expected = getattr(read, name), getattr(trace, name)
        assert found.dtype == expected.dtype and not found.flags.writeable
        np.testing.assert_array_equal(found, expected)
    assert read.errors.keys() == trace.errors.keys()
    for name, table in trace.errors.items():
        np.testing.assert_array_equal(read.errors[name], table)
    assert read_source(path) == SOURCE
    verify_trace(path, SOURCE)


def test_same_trace_same_bytes(trace, path, tmp_path):
    write_trace(tmp_path / "again.safetensors", trace, SOURCE)
    assert (tmp_path / "again.safetensors").read_bytes() == path.read_bytes()


def test_images_are_mapped_not_read(path):
    images = open_trace(path).images
    while images.base is not None and not isinstance(images, np.memmap):
        images = images.base
    assert isinstance(images, np.memmap)


def test_other_readers_of_the_format_understand_the_file(trace, path):
    from safetensors.numpy import load_file

    arrays = load_file(path)
    np.testing.assert_array_equal(arrays["errors/log_mae"], trace.errors["log_mae"])
    np.testing.assert_array_equal(arrays["images"], trace.images)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"recording": "1" * 64}, "recording is '0000.*', expected '1111"),
        (
            {"extrapolator": "network", "weights": "ab"},
            "extrapolator is 'warp', expected 'network'; weights is",
        ),
        ({"odometry": True}, "odometry is False, expected True"),
        ({"lidar_hz": 5}, "lidar_hz is 10, expected 5"),
        ({"beams": 16}, "beams is 0, expected 16"),
        ({"min_depth": 0.1}, "min_depth is 1.0, expected 0.1"),
    ],
)
def test_a_trace_of_something_else_is_refused_by_name(path, change, message):
    with pytest.raises(ValueError, match=rf"{path.name}: found a trace of something else: {message}"):
        open_trace(path, dataclasses.replace(SOURCE, **change))


@pytest.mark.parametrize("share", [0.0, 0.001, 0.1, 0.5, 0.99, 1.01])
def test_a_truncated_or_longer_file_is_refused(path, share):
    data = path.read_bytes()
    path.write_bytes((data + data)[: int(share * len(data))])
    with pytest.raises(ValueError, match=f"{path.name}: found"):
        open_trace(path)


def header_of(path):
    data = path.read_bytes()
    length = int.from_bytes(data[:8], "little")
    return json.loads(data[8 : 8 + length]), data[8 + length :]


def rewrite(path, entries, data):
    header = json.dumps(entries).encode()
    path.write_bytes(len(header).to_bytes(8, "little") + header + data)


def test_a_flipped_byte_is_found(path):
    entries, data = header_of(path)
    for name in ("errors/log_mae", "event_count", "images"):
        damaged = bytearray(data)
        damaged[entries[name]["data_offsets"][0] + 5] ^= 1
        rewrite(path, entries, bytes(damaged))
        with pytest.raises(ValueError, match=f"{path.name}: {name}: found SHA-256"):
            verify_trace(path)
    open_trace(path)  # opening does not read the images


def test_headers_that_lie_are_refused(path):
    entries, data = header_of(path)
    table, images = entries["errors/rmse"], entries["images"]
    size = len(data)
    for change, message in (
        ({"errors/rmse": {**table, "dtype": "BF16"}}, "not a trace's"),
        ({"errors/rmse": {**table, "shape": [2**62, 4]}}, "not a trace's"),
        ({"errors/rmse": {**table, "data_offsets": [-8, 0]}}, "not a trace's"),
        ({"errors/rmse": {**table, "shape": list(reversed(table["shape"]))}}, "errors/rmse: found float64"),
        (
            {"images": {**images, "shape": [images["data_offsets"][1] - images["data_offsets"][0]]}},
            "images: ",
        ),
        ({"errors/mine": table}, "found the arrays"),
        ({"images": {**images, "shape": [0, 1, 1], "data_offsets": [size, size]}}, "images: found"),
        ({"__metadata__": {"format": "pt"}}, "not a trace's"),
        ({"__metadata__": {"nl_env trace": "[]"}}, "not a trace's"),
        ({"__metadata__": {"nl_env trace": '{"version": 1, "seed": null}'}}, "not a trace's"),
    ):
        rewrite(path, {**entries, **change}, data)
        with pytest.raises(ValueError, match=rf"{path.name}: .*{message}|{path.name}: {message}"):
            open_trace(path)
    header = json.loads(entries["__metadata__"]["nl_env trace"])
    newer = {"nl_env trace": json.dumps({**header, "version": 2})}
    rewrite(path, {**entries, "__metadata__": newer}, data)
    with pytest.raises(ValueError, match="found version 2, expected 1"):
        open_trace(path)


def test_other_files_are_refused(tmp_path):
    for name, data in (("text", b"no trace at all, only words"), ("zeros", bytes(100)), ("empty", b"")):
        path = tmp_path / f"{name}.safetensors"
        path.write_bytes(data)
        with pytest.raises(ValueError, match=f"{path.name}: found"):
            open_trace(path)


def test_a_folder_is_read_in_order_of_the_seeds(trace, tmp_path):
    for seed in (30, 4, 100):
        write_trace(tmp_path / f"{seed}.safetensors", dataclasses.replace(trace, seed=seed), SOURCE)
    (tmp_path / ".5.safetensors").write_bytes(b"unfinished")
    assert list(trace_files(tmp_path)) == list(open_traces(tmp_path)) == [4, 30, 100]
    assert [trace.seed for trace in open_traces(tmp_path, [100, 4]).values()] == [100, 4]
    with pytest.raises(FileNotFoundError, match="found none of 1 sequences \\(such as 7\\)"):
        open_traces(tmp_path, [4, 7])
    write_trace(tmp_path / "5.safetensors", trace, dataclasses.replace(SOURCE, beams=32))
    with pytest.raises(ValueError, match=r"5.safetensors: found a trace of .*'beams': 32"):
        open_traces(tmp_path)
    shutil.move(tmp_path / "4.safetensors", tmp_path / "3.safetensors")
    with pytest.raises(ValueError, match=r"3.safetensors: found the trace of seed 4, expected 3"):
        open_traces(tmp_path, [3])
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match=r"found no SEED.safetensors in .*empty.*precompute"):
        open_traces(tmp_path / "empty")


def test_a_folder_that_must_fit_recordings(trace, path, tmp_path):
    recording = tmp_path / "5.h5"
    recording.write_bytes(b"what was recorded")
    write_trace(path, trace, TraceSource.of(file_digest(recording), WARP, LidarConfig()))
    folder = TraceFolder(tmp_path, {SEED: recording}, WARP, LidarConfig())
    assert folder[SEED].seed == pickle.loads(pickle.dumps(folder))[SEED].seed == SEED
    assert len(pickle.dumps(folder)) < 5_000  # paths only
    for arguments, message in (
        (({SEED: recording}, identify_extrapolator("repeat"), LidarConfig()), "extrapolator is 'warp'"),
        (({SEED: recording}, WARP, LidarConfig(rate_hz=5)), "lidar_hz is 10, expected 5"),
    ):
        with pytest.raises(ValueError, match=message):
            TraceFolder(tmp_path, *arguments)
    with pytest.raises(FileNotFoundError, match=r"found no trace of 1 of 2 recordings .*such as 6"):
        TraceFolder(tmp_path, {SEED: recording, 6: recording}, WARP, LidarConfig())
    recording.write_bytes(b"what was recorded later")
    with pytest.raises(ValueError, match=r"5.safetensors: .*recording is"):
        pickle.loads(pickle.dumps(folder))[SEED]


def test_an_extrapolator_is_known_by_its_weights_and_how_they_are_run(tmp_path):
    from nl_env.depth.extrapolators import WEIGHTS

    shipped, copy = WEIGHTS / "unet.safetensors", tmp_path / "mine.safetensors"
    shutil.copy(shipped, copy)
    shutil.copy(shipped.with_suffix(".json"), copy.with_suffix(".json"))
    assert identify_extrapolator("unet") == identify_extrapolator(copy)
    assert identify_extrapolator("unet") != identify_extrapolator("unet", odometry=True)
    card = json.loads(copy.with_suffix(".json").read_text())
    copy.with_suffix(".json").write_text(json.dumps({**card, "metrics": {"log_mae": 0.0}}))
    assert identify_extrapolator("unet") == identify_extrapolator(copy)
    copy.with_suffix(".json").write_text(json.dumps({**card, "options": {**card["options"], "threshold": 9}}))
    assert weights_digest(copy) != weights_digest(shipped)
    os.unlink(copy.with_suffix(".json"))
    with open(copy, "ab") as file:
        file.write(b" ")
    assert weights_digest(copy) != weights_digest(shipped)
    assert identify_extrapolator("warp") == WARP
    with pytest.raises(ValueError, match="extrapolator: found 'wrap', expected one of 'repeat'"):
        identify_extrapolator("wrap")
    with pytest.raises(FileNotFoundError, match=r"none.safetensors"):
        identify_extrapolator(tmp_path / "none.safetensors")


def test_tables_lie_beside_the_data(tmp_path):
    data = tmp_path / "train"
    data.mkdir()
    assert default_folder(data, "unet") == tmp_path / "train-tables-unet"
    assert default_folder(data, "warp", True) == tmp_path / "train-tables-warp-odometry"
    assert default_folder(data, "runs/x/mine.safetensors").name == "train-tables-mine"
    (data / "7.h5").touch()
    assert default_folder(data / "7.h5", "unet") == data / "7-tables-unet"
