import json

import numpy as np
import pytest

from agents import Evenly
from agents.catalogue import FAMILIES, PolicyName, make_policy, parse_policy
from scripts import compare

SHORT = (
    "--sequences 3 --duration 0.4 --extrapolator repeat --policies periodic:2 event-rate --workers 0".split()
)


def run(folder, *more):
    return compare.main([*SHORT, "--out", str(folder), *more])


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compare") / "run"
    assert run(folder) == 0
    return folder


def test_one_command_writes_the_whole_report(finished):
    assert {path.name for path in finished.iterdir()} == {
        "results.json",
        "table.md",
        "report.html",
        "error_vs_rate.png",
        "frontier.png",
        "rate_vs_time.png",
        "rate_vs_speed.png",
        "settings.json",
        "sequences",
    }
    found = json.loads((finished / "results.json").read_text())
    listed = [policy["name"] for policy in found["policies"] if policy["listed"]]
    assert listed == ["never", "always", "periodic:2", "event-rate:0.15"]
    assert [sequence["seed"] for sequence in found["sequences"]] == [2_000_000_000 + i for i in range(3)]
    assert {curve["family"] for curve in found["frontier"]} == {"oracle", "periodic", "event-rate"}
    always = found["policies"][1]
    assert always["recall"]["mean"] in (1.0, None)
    assert always["rate"]["mean"] == pytest.approx(50.0)


def test_an_interrupted_run_resumes_to_the_same_bytes(finished, tmp_path, monkeypatch, capsys):
    trace_sequence = compare.trace_sequence

    def interrupted(stream, extrapolator, seed, **more):
        if seed == 2_000_000_001:
            raise KeyboardInterrupt
        return trace_sequence(stream, extrapolator, seed, **more)

    monkeypatch.setattr(compare, "trace_sequence", interrupted)
    assert run(tmp_path / "run") == 130
    assert "--resume" in capsys.readouterr().err
    assert not (tmp_path / "run" / "results.json").exists()
    monkeypatch.setattr(compare, "trace_sequence", trace_sequence)
    assert run(tmp_path / "run", "--resume", "--json") == 0
    printed = capsys.readouterr()
    results = (finished / "results.json").read_bytes()
    assert (tmp_path / "run" / "results.json").read_bytes() == results
    assert json.loads(printed.out) == json.loads(results)
    assert printed.err == ""  # no progress bar without a terminal


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--policies", "sometimes"], "policy: found 'sometimes', expected one of 'never', 'always'"),
        (["--policies", "never:2"], "has no parameter"),
        (["--policies", "random:often"], "expected random:NUMBER (probability)"),
        (["--policies", "random:1.5"], "p: found 1.5"),
        (["--policies", "periodic:2.5"], "expected a whole number"),
        (["--resolution", "tiny"], "resolution: found 'tiny', expected one of 'full', 'half', 'quarter'"),
        (["--extrapolator", "magic"], "'magic'"),
        (["--sequences", "0"], "sequences: found 0"),
        (["--seed", "-1"], "seed: found -1"),
        (["--overwrite", "--resume"], "expected at most one"),
    ],
)
def test_bad_options_are_refused_before_any_work(tmp_path, capsys, arguments, message):
    assert compare.main([*arguments, "--out", str(tmp_path / "run")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_finished_run_is_not_overwritten_unasked(finished, capsys):
    before = (finished / "results.json").read_bytes()
    assert run(finished) == 2
    assert "already holds another run" in capsys.readouterr().err
    assert run(finished, "--resume", "--duration", "0.6") == 2
    assert "other settings: duration" in capsys.readouterr().err
    assert (finished / "results.json").read_bytes() == before


def test_help_documents_every_option(capsys):
    with pytest.raises(SystemExit, match="0"):
        compare.main(["--help"])
    text = capsys.readouterr().out
    for (
        option
    ) in "sequences duration seed resolution extrapolator policies workers out json overwrite resume".split():
        assert f"--{option}" in text


@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_and_its_sweep_can_be_made(family):
    names = [PolicyName(family, value) for value in FAMILIES[family].sweep]
    for name in names:
        assert parse_policy(str(name)) == name
    assert len({str(name) for name in names}) == len(names)
    assert parse_policy(family).family == family
    if FAMILIES[family].available:
        for name in (family, *map(str, names)):
            make_policy(name, seed=0)


def test_names_of_schedules_keep_their_zeros_and_weights_their_path():
    assert str(parse_policy("schedule:0010")) == "schedule:0010"
    assert make_policy("schedule:0010", seed=0).pattern == "0010"
    name = parse_policy("keyframe-cnn@runs/mine/best.safetensors:0.3")
    assert name == ("keyframe-cnn", 0.3, "runs/mine/best.safetensors")
    assert str(name) == "keyframe-cnn@runs/mine/best.safetensors:0.3"
    with pytest.raises(ValueError, match="expected a path to weights after @, of a learned policy"):
        parse_policy("periodic@runs/mine:2")
    with pytest.raises(FileNotFoundError, match="nothing"):
        make_policy("keyframe-cnn@nothing.safetensors", seed=0)


def test_the_default_rows_can_all_be_made():
    for name in compare.Settings().policies:
        make_policy(name, seed=0)
    assert {"accumulated:0.5", "keyframe-cnn", "oracle:30"} <= set(compare.Settings().policies)


@pytest.mark.parametrize("rate", [10, 17.5, 20, 30, 40, 41, 50])
@pytest.mark.parametrize("period", [5, 10])
def test_even_triggers_have_their_rate_and_never_meet_a_lidar_frame(rate, period):
    policy, state, slices = Evenly(rate, period), None, 1000
    triggers = []
    for k in range(1, slices + 1):
        action, state = policy.predict(np.zeros((1, 4, 4), np.uint8), state)
        if action:
            triggers.append(k)
    frames = slices // period + len(triggers)
    assert frames / (slices * 0.02) == pytest.approx(rate, abs=0.06)
    assert not [k for k in triggers if k % period == 0]
    free = [k - k // period for k in triggers]  # counted without the LiDAR's slices
    assert np.ptp(np.diff(free)) <= 1 if len(free) > 1 else True


def test_even_rates_below_the_lidar_or_above_the_slices_are_refused():
    for rate in (9.9, 50.1):
        with pytest.raises(ValueError, match=r"rate_hz: found .* expected 10 to 50"):
            Evenly(rate)
