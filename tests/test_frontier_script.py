import json

import pytest
from analytic_stream import WallStream

from nl_env.depth.extrapolators import make_extrapolator
from nl_env.trace_files import write_trace
from nl_env.trace_source import TraceSource
from nl_env.traces import trace_sequence
from scripts import frontier

SOURCE = TraceSource("0" * 64, "linear", "", False, 10, 0, 1.0)
POLICIES = ("periodic:2", "accumulated:0.2", "speed-age", "keyframe-rule")


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tables")
    for seed in (5, 6, 7):
        stream = WallStream(slices=50, speed=4.0 * (seed - 4), distance=60.0)
        trace = trace_sequence(stream, make_extrapolator("linear"), seed)
        write_trace(folder / f"{seed}.safetensors", trace, SOURCE)
    return folder


def run(tables, out, *more):
    return frontier.main(
        ["--data", str(tables), "--out", str(out), "--policies", *POLICIES, "--workers", "0", *more]
    )


@pytest.fixture(scope="module")
def finished(tables, tmp_path_factory):
    folder = tmp_path_factory.mktemp("frontier")
    document = folder / "frontier.md"
    document.write_text("before\n\n<!-- begin frontier -->\nstale numbers\n<!-- end frontier -->\n\nafter\n")
    assert run(tables, folder / "run", "--document", str(document)) == 0
    return folder


def test_the_report_and_the_document(finished):
    found = json.loads((finished / "run" / "results.json").read_text())
    regrets = {curve["family"]: curve["regret"]["mean"] for curve in found["frontier"]}
    assert set(regrets) == {"oracle", "periodic", "accumulated", "speed-age", "keyframe-rule"}
    assert (regrets["oracle"], regrets["periodic"]) == (0, pytest.approx(1))
    assert [sequence["seed"] for sequence in found["sequences"]] == [5, 6, 7]
    text = (finished / "frontier.md").read_text()
    assert text.startswith("before") and text.rstrip().endswith("after") and "stale" not in text
    assert "python scripts/frontier.py --data" in text
    assert f"| accumulated | {regrets['accumulated']:.3f} |" in text
    assert "Frame rate by scenario" in text and "wall (3)" in text
    assert (finished / "run" / "report.html").stat().st_size > 10_000


def test_a_finished_run_resumes_to_the_same_bytes_and_other_settings_do_not(finished, tables, capsys):
    before = (finished / "run" / "results.json").read_bytes()
    assert run(tables, finished / "run", "--resume") == 0
    assert (finished / "run" / "results.json").read_bytes() == before
    assert run(tables, finished / "run", "--resume", "--sequences", "2") == 2
    assert "other settings: sequences" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--policies", "sometimes"], "policy: found 'sometimes'"),
        (["--policies", "value-planned@missing.safetensors"], "missing.safetensors"),
        (["--data", "nowhere"], "nowhere"),
        (["--sequences", "0"], "sequences: found 0"),
    ],
)
def test_bad_options_are_refused_before_any_work(tables, tmp_path, capsys, arguments, message):
    assert run(tables, tmp_path / "run", *arguments) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_document_without_its_block_is_refused(tables, tmp_path, capsys):
    document = tmp_path / "plain.md"
    document.write_text("nothing here\n")
    assert run(tables, tmp_path / "run", "--document", str(document)) == 2
    assert "<!-- begin frontier -->" in capsys.readouterr().err


def test_traces_of_other_extrapolators_are_not_mixed(tables, tmp_path, capsys):
    mixed = tmp_path / "mixed"
    mixed.mkdir()
    (mixed / "5.safetensors").write_bytes((tables / "5.safetensors").read_bytes())
    trace = trace_sequence(WallStream(slices=50), make_extrapolator("repeat"), 6)
    write_trace(mixed / "6.safetensors", trace, TraceSource("1" * 64, "repeat", "", False, 10, 0, 1.0))
    assert run(mixed, tmp_path / "run") == 2
    assert "'repeat'" in capsys.readouterr().err
