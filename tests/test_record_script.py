import hashlib
import json

import pytest

from nl_env.config import SPLITS
from nl_env.recording import Recording
from nl_env.recording_stream import RecordingStream
from scripts import record

SHORT = "--split val --duration 0.2 --depth-period-ms 10 --workers 0".split()
FIRST = SPLITS["val"][0]


def run(folder, *more, sequences=2):
    return record.main([*SHORT, "--sequences", str(sequences), "--out", str(folder), *more])


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("record") / "run"
    assert run(folder) == 0
    return folder


def test_the_manifest_lists_what_was_recorded(finished):
    manifest = json.loads((finished / "manifest.json").read_text())
    assert manifest["split"] == "val" and manifest["seeds"] == [FIRST, FIRST + 1]
    assert manifest["config"]["scene"]["duration_s"] == 0.2
    assert {path.name for path in finished.iterdir()} == {"manifest.json", "settings.json", "sequences"}
    for entry, seed in zip(manifest["sequences"], manifest["seeds"], strict=True):
        data = (finished / entry["file"]).read_bytes()
        assert entry["file"] == f"sequences/{seed}.h5"
        assert (entry["bytes"], entry["sha256"]) == (len(data), hashlib.sha256(data).hexdigest())
        with Recording(finished / entry["file"]) as recording:
            recording.verify()
            assert (recording.seed, recording.slices, recording.depth_period_us) == (seed, 10, 10_000)
            assert entry["events"] == len(recording.events(0, 200_000)) > 0
            assert entry["description"] == recording.description
    assert RecordingStream(finished).seeds == (FIRST, FIRST + 1)


def test_worker_processes_write_the_same_bytes(finished, tmp_path):
    assert run(tmp_path / "run", "--workers", "2") == 0
    assert contents(tmp_path / "run") == contents(finished)


def test_an_interrupted_run_resumes_to_the_same_bytes(finished, tmp_path, monkeypatch, capsys):
    record_sequence = record.record_sequence

    def interrupted(path, config, seed, *rest, **more):
        if seed == FIRST + 1:
            raise KeyboardInterrupt
        record_sequence(path, config, seed, *rest, **more)

    folder = tmp_path / "run"
    monkeypatch.setattr(record, "record_sequence", interrupted)
    assert run(folder) == 130
    assert "finished sequences are kept. Continue with: python scripts/record.py" in capsys.readouterr().err
    assert not (folder / "manifest.json").exists()
    left = folder / "sequences" / ".killed.h5"  # what a killed process cannot remove
    left.write_bytes(b"half")
    first = folder / "sequences" / f"{FIRST}.h5"
    written = first.stat().st_mtime_ns
    monkeypatch.setattr(record, "record_sequence", record_sequence)
    assert run(folder, "--resume") == 0
    printed = capsys.readouterr()
    assert printed.err == ""  # no progress bar without a terminal
    assert "2 sequences" in printed.out
    assert not left.exists() and first.stat().st_mtime_ns == written
    assert contents(folder) == contents(finished)


def test_a_run_grows_and_a_lost_file_is_recorded_again(finished, tmp_path, capsys):
    folder = tmp_path / "run"
    assert run(folder, sequences=1) == 0
    (folder / "sequences" / f"{FIRST}.h5").unlink()
    assert run(folder, "--resume") == 0
    assert contents(folder) == contents(finished)
    capsys.readouterr()
    assert run(folder, "--resume", sequences=1) == 2
    assert "sequences: found 1, but" in capsys.readouterr().err
    assert contents(folder) == contents(finished)


def test_a_finished_run_is_not_overwritten_unasked(finished, capsys):
    before = contents(finished)
    assert run(finished) == 2
    assert "already holds another run" in capsys.readouterr().err
    assert run(finished, "--resume", "--depth-period-ms", "20") == 2
    assert "other settings: depth_period_ms" in capsys.readouterr().err
    assert contents(finished) == before


def test_a_failed_write_is_reported_and_the_run_can_go_on(tmp_path, monkeypatch, capsys):
    def full(path, *rest, **more):
        raise OSError(f"{path}: cannot write the recording (no space left)")

    monkeypatch.setattr(record, "record_sequence", full)
    assert run(tmp_path / "run") == 2
    error = capsys.readouterr().err
    assert f"{FIRST}.h5: cannot write the recording" in error and "--resume" in error


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--split", "trial"], "split: found 'trial', expected one of 'train', 'val', 'test'"),
        (["--depth-period-ms", "15"], "depth_period_ms: found 15"),
        (["--resolution", "tiny"], "resolution: found 'tiny'"),
        (["--noise", "some"], "noise: found 'some'"),
        (["--lidar-hz", "3"], "lidar_hz: found 3"),
        (["--sequences", "0"], "sequences: found 0"),
        (["--start", "-1"], "start: found -1"),
        (["--workers", "-1"], "workers: found -1"),
        (["--overwrite", "--resume"], "expected at most one"),
    ],
)
def test_bad_options_are_refused_before_any_work(tmp_path, capsys, arguments, message):
    assert record.main([*arguments, "--out", str(tmp_path / "run")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_help_documents_every_option(capsys):
    with pytest.raises(SystemExit, match="0"):
        record.main(["--help"])
    text = capsys.readouterr().out
    for option in (
        "split sequences start resolution duration noise lidar-hz beams depth-period-ms intensity "
        "workers out overwrite resume"
    ).split():
        assert f"--{option}" in text
