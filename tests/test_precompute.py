import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from short_recordings import record
from stored_traces import SEEDS, SLICES, store

from nl_env.config import LidarConfig
from nl_env.depth.extrapolators import Warp
from nl_env.recording_stream import RecordingStream
from nl_env.trace_files import open_traces, read_source, trace_files
from nl_env.trace_source import TraceSource, file_digest, identify_extrapolator
from nl_env.traces import trace_sequence

ROOT = Path(__file__).parents[1]


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def default_out(data):
    return data.with_name(f"{data.name}-tables-warp")


def test_a_table_is_the_trace_of_its_recording(stored):
    traces = open_traces(default_out(stored))
    assert list(traces) == list(SEEDS)
    stream = RecordingStream(stored)
    for seed, trace in traces.items():
        expected = trace_sequence(stream, Warp(), seed)
        assert trace.slices == SLICES
        np.testing.assert_array_equal(trace.images, expected.images)
        for name, table in expected.errors.items():
            np.testing.assert_array_equal(trace.errors[name], table)
    source = TraceSource.of(
        file_digest(stored / f"sequences/{SEEDS[0]}.h5"), identify_extrapolator("warp"), LidarConfig()
    )
    assert read_source(trace_files(default_out(stored))[SEEDS[0]]) == source


def test_a_folder_that_holds_something_is_never_overwritten_unasked(stored, tmp_path, capsys):
    before = contents(default_out(stored))
    assert store(stored) == 2
    assert "already holds another run" in capsys.readouterr().err
    assert store(stored, "--resume", "--out", str(default_out(stored)), extrapolator="repeat") == 2
    assert (
        "holds a run with other settings: extrapolator is 'warp', asked 'repeat'" in capsys.readouterr().err
    )
    assert contents(default_out(stored)) == before


def test_a_run_grows_and_ends_with_the_bytes_of_a_whole_one(stored, tmp_path):
    out = tmp_path / "tables"
    assert store(stored, "--out", str(out), "--sequences", "1") == 0
    assert len(trace_files(out)) == 1
    (out / "sequences" / ".8.safetensors").write_bytes(b"half a file of a killed worker")
    assert store(stored, "--out", str(out), "--resume") == 0
    assert contents(out) == contents(default_out(stored))


def test_damaged_and_outdated_tables_are_made_again(stored, tmp_path, capsys):
    out = tmp_path / "tables"
    assert store(stored, "--out", str(out)) == 0
    first, second = trace_files(out).values()
    whole = contents(out)
    first.write_bytes(first.read_bytes()[:1000])
    flipped = bytearray(second.read_bytes())
    flipped[-1] ^= 1
    second.write_bytes(flipped)
    assert store(stored, "--out", str(out), "--resume") == 0
    assert contents(out) == whole
    errors = capsys.readouterr().err
    assert f"makes again {first}: found no" in errors and f"makes again {second}: " in errors


def test_the_table_of_a_changed_recording_is_made_again(tmp_path, capsys):
    data = record(tmp_path / "data", SEEDS[:1], 0.2)
    assert store(data, extrapolator="repeat") == 0
    (data / f"sequences/{SEEDS[0]}.h5").unlink()
    other = record(tmp_path / "other", SEEDS[:1], 0.3)
    (other / f"sequences/{SEEDS[0]}.h5").rename(data / f"sequences/{SEEDS[0]}.h5")
    assert store(data, "--resume", extrapolator="repeat") == 0
    assert "recording is" in capsys.readouterr().err
    assert open_traces(tmp_path / "data-tables-repeat")[SEEDS[0]].slices == 15


def test_killed_and_resumed_gives_the_same_bytes(stored, tmp_path):
    out = tmp_path / "tables"
    command = [sys.executable, "scripts/precompute.py", "--data", str(stored), "--extrapolator", "warp"]
    command += ["--workers", "0", "--out", str(out)]
    process = subprocess.Popen(command, cwd=ROOT, start_new_session=True, stderr=subprocess.DEVNULL)
    finished = out / "sequences" / f"{SEEDS[0]}.safetensors"
    deadline = time.monotonic() + 300
    while not finished.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert finished.exists()
    assert store(stored, "--out", str(out), "--resume") == 0
    assert contents(out) == contents(default_out(stored))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--data", "nowhere"], "nowhere"),
        (["--sequences", "3"], "sequences: found 3"),
        (["--workers", "-1"], "workers: found -1"),
        (["--extrapolator", "wrap"], "extrapolator: found 'wrap'"),
        (["--lidar-hz", "7"], "lidar_hz: found 7"),
        (["--runtime", "abacus"], "runtime: found 'abacus'"),
    ],
)
def test_bad_options_are_named_and_nothing_is_made(stored, tmp_path, capsys, arguments, message):
    out = tmp_path / "tables"
    assert store(stored, "--out", str(out), *arguments) == 2
    assert message in capsys.readouterr().err
    assert not out.exists()
