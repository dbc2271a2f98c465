import dataclasses
import itertools
import json
import math

import numpy as np
import pytest

from agents.keyframe_cnn import ARCHITECTURES
from agents.oracle import priced_schedule
from nl_env.depth import learned_networks, unet
from nl_env.depth.extrapolators import Repeat
from nl_env.depth.metrics import METRIC_NAMES
from nl_env.recording import Recording, record_sequence
from nl_env.recording_stream import RecordingStream
from nl_env.reproduction import document, end_to_end, published, schedules, targets
from nl_env.reproduction.data import find_sequences
from nl_env.reproduction.end_to_end import EndToEndTask, SequenceRun
from nl_env.reproduction.figures import bootstrap_weights, interval, summarise
from nl_env.reproduction.gap_tables import ablation_sections
from nl_env.reproduction.gaps import GROUPS, ChangedEvents, GapsTask, Method, SequenceErrors, with_mean
from nl_env.reproduction.keyframe_tables import DetectorFile, summarise_keyframes
from nl_env.reproduction.keyframes import ScoredSequence, ScoreTask
from nl_env.reproduction.variants import Variant, read_variant
from nl_env.traces import score, trace_sequence
from nl_env.types import Camera, Extrapolation, ExtrapolationInput
from nl_env.weight_files import Card, write_card, write_weights
from scripts import record, reproduce

SECONDS = "0.8"


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Two recorded test sequences of 0.8 s: room for one pair of every gap."""
    folder = tmp_path_factory.mktemp("recordings") / "test"
    arguments = "--split test --sequences 2 --depth-period-ms 10 --workers 0".split()
    assert record.main([*arguments, "--duration", SECONDS, "--out", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def detectors(tmp_path_factory):
    """Untrained detectors that trigger at some slices, as the options of the command."""
    folder = tmp_path_factory.mktemp("weights")
    options = []
    for option, name in (
        ("--keyframe-weights", "keyframe-cnn"),
        ("--temporal-weights", "keyframe-cnn-temporal"),
    ):
        path = folder / f"{name}.safetensors"
        card = Card("untrained", name, metrics={"thresholds": {"default": 0.5}})
        write_weights(path, ARCHITECTURES[name]().state_dict(), card)
        options += [option, str(path)]
    return options


# Statistics


def test_figures_of_rows_with_training_seeds_against_a_base_row():
    """Row "net" has two seeds, errors 1 and 3 on every sequence; the base row is at 4."""
    values = np.array([[4.0, 1.0, 3.0]] * 5)[:, :, None, None]
    found = summarise(values, ["base", "net", "net"], ["g"], ["m"], "base", np.random.default_rng(0))
    net = found["net"]["g"]["m"]
    assert (net.mean, net.change, net.standard_error) == (2.0, -0.5, 0.0)
    assert (net.low, net.high, net.change_low, net.change_high) == (2.0, 2.0, -0.5, -0.5)
    assert net.spread == pytest.approx(math.sqrt(2))
    assert math.isnan(found["base"]["g"]["m"].spread)
    with pytest.raises(ValueError, match="base: found 'other'"):
        summarise(values, ["base", "net", "net"], ["g"], ["m"], "other", np.random.default_rng(0))


def test_changes_are_paired_by_sequence():
    """A row that is always at half of the base has no uncertain change, however sequences differ."""
    base = np.random.default_rng(1).uniform(1, 100, 40)
    values = np.stack([base, base / 2], axis=1)[:, :, None, None]
    found = summarise(values, ["base", "half"], ["g"], ["m"], "base", np.random.default_rng(0))["half"]["g"][
        "m"
    ]
    assert found.change_low == pytest.approx(-0.5) == pytest.approx(found.change_high)
    assert found.low < found.mean < found.high
    assert found.standard_error == pytest.approx((base / 2).std(ddof=1) / math.sqrt(40))


def test_what_could_not_be_measured_is_left_out():
    values = np.array([[1.0, np.nan], [3.0, np.nan]])[:, :, None, None]
    found = summarise(values, ["base", "none"], ["g"], ["m"], "base", np.random.default_rng(0))
    assert found["base"]["g"]["m"].mean == 2.0
    assert math.isnan(found["none"]["g"]["m"].mean)
    assert math.isnan(found["none"]["g"]["m"].low)


def test_bootstrap_weights_count_the_sequences_of_each_sample():
    weights = bootstrap_weights(7, np.random.default_rng(0))
    assert (weights.sum(axis=1) == 7).all()
    assert interval(np.arange(1001.0)) == pytest.approx([25.0, 975.0])


# Gaps


def test_repeat_at_the_gaps_equals_the_metrics_of_its_frames(data):
    """With one possible pair, the measured error is that of the LiDAR frame at 0.1 or 0.2 or 0.3 s."""
    files = find_sequences(data).files
    seed = min(files)
    task = GapsTask(files, (Method("repeat", "repeat"), Method("warp", "warp", odometry=True)), pairs=1)
    result = task(seed)
    assert result.errors.shape == (2, len(GROUPS), len(METRIC_NAMES))
    with Recording(files[seed]) as recording:
        candidates = []
        for now in (100_000, 200_000, 300_000):
            prior = Extrapolation(recording.depth(now))
            rows = [
                list(score(prior, recording.depth(now + 1000 * int(gap)), 200.0, 1.0).values())
                for gap in GROUPS[:5]
            ]
            candidates.append(rows)
    assert any(np.array_equal(result.errors[0, :5], rows, equal_nan=True) for rows in np.array(candidates))
    repeat, warp = with_mean(result.errors)[:, -1, METRIC_NAMES.index("log_mae")]
    assert warp < repeat
    assert repeat == pytest.approx(result.errors[0, :5, METRIC_NAMES.index("log_mae")].mean())


def test_results_of_a_sequence_survive_their_file(data, tmp_path):
    files = find_sequences(data).files
    result = GapsTask(files, (Method("repeat", "repeat"),), pairs=2)(max(files))
    result.save(tmp_path / "x.npz")
    loaded = SequenceErrors.load(tmp_path / "x.npz")
    assert (loaded.seed, loaded.description) == (result.seed, result.description)
    np.testing.assert_array_equal(loaded.errors, result.errors)


def test_gaps_need_depth_between_slices_and_enough_time(tmp_path):
    config = record.Settings(duration=0.4).config
    record_sequence(tmp_path / "3.h5", config, 3, 10_000)
    with pytest.raises(ValueError, match=r"3\.h5: found 0\.4 s, expected at least 0\.6 s"):
        GapsTask({3: tmp_path / "3.h5"}, (Method("repeat", "repeat"),), pairs=1)(3)
    record_sequence(tmp_path / "4.h5", record.Settings(duration=0.6).config, 4, 20_000)
    with pytest.raises(ValueError, match=r"4\.h5.*multiple of 20000"):
        GapsTask({4: tmp_path / "4.h5"}, (Method("repeat", "repeat"),), pairs=1)(4)


class Spy(Repeat):
    """Keeps its inputs."""

    def __call__(self, inputs):
        self.inputs = inputs
        return super().__call__(inputs)


@pytest.mark.parametrize("slices", [1, 4])
def test_controls_change_the_events_alone(slices):
    rng = np.random.default_rng(0)
    bins = tuple(rng.integers(-3, 4, (5, 4, 6)).astype(np.int16) for _ in range(slices))
    frame = np.ones((4, 6), np.float32)
    inputs = ExtrapolationInput(80_000, Camera.from_fov(4, 6, 70.0), 200.0, (frame,), (0,), bins)
    spy = Spy()
    ChangedEvents(spy, "no events")(inputs)
    assert len(spy.inputs.bins) == slices
    assert not any(changed.any() for changed in spy.inputs.bins)
    ChangedEvents(spy, "shuffled events")(inputs)
    before, after = (np.concatenate(b).reshape(5, slices, 4, 6).sum(axis=1) for b in (bins, spy.inputs.bins))
    assert not np.array_equal(before, after)
    assert sorted(map(bytes, before)) == sorted(map(bytes, after))  # the same voxel bins in another order
    assert spy.inputs.lidar_frames[0] is frame
    with pytest.raises(ValueError, match="control: found 'reversed'"):
        Method("x", "repeat", control="reversed").make()


# End to end


def make_run(seed, slices=20, period=5):
    """A run with random errors: holding gets worse with age, and a frame's own error is random."""
    rng = np.random.default_rng(seed)
    made = rng.uniform(0.0, 1.0, slices + 1)
    errors = np.full((slices + 1, period), np.nan)
    for k in range(slices + 1):
        for age in range(k % period + 1):
            errors[k, age] = made[k - age] * (k - age) % period + 0.3 * age
    zeros = np.zeros(slices + 1)
    columns = {name: zeros for name in end_to_end._COLUMNS}
    columns |= {
        "lidar": np.arange(slices + 1) % period == 0,
        "active_fraction": rng.uniform(0, 1, slices + 1),
        "keyframe": rng.uniform(0, 1, slices + 1) > 0.5,
    }
    return SequenceRun(seed, {}, period, columns, {}, {"x": np.array([errors] * len(METRIC_NAMES))})


def held(run, schedule):
    return run.play("p", schedule, "x").held["log_mae"]


@pytest.mark.parametrize("rate", [10.0, 17.5, 30.0, 42.5, 50.0])
def test_matched_schedules_have_the_rate(rate):
    runs = [make_run(seed) for seed in range(4)]
    even = [schedules.evenly(run, rate) for run in runs]
    assert schedules.mean_rate(runs, even) == pytest.approx(rate)
    assert {run.play("p", s, "x").effective_rate for run, s in zip(runs, even, strict=True)} == {rate}
    shared = schedules.event_rate(runs, rate)
    assert schedules.mean_rate(runs, shared) == pytest.approx(rate)
    shares = [run.columns["active_fraction"] for run in runs]
    triggered = np.concatenate([x[s] for x, s in zip(shares, shared, strict=True)])
    left = np.concatenate([x[run.free & ~s] for run, x, s in zip(runs, shares, shared, strict=True)])
    assert not len(triggered) or not len(left) or triggered.min() > left.max()


def test_even_triggers_are_spread():
    run = make_run(0, slices=50)
    gaps = np.diff(np.flatnonzero(schedules.evenly(run, 30.0)[run.free]))
    assert set(gaps.tolist()) == {2}


def test_the_oracle_is_at_least_as_good_as_any_schedule_with_its_triggers():
    runs = [make_run(seed, slices=9) for seed in (5, 6)]
    found = schedules.oracle(runs, "x", 30.0, priced_schedule)
    assert schedules.mean_rate(runs, found) <= 30.0
    triggers = sum(int(s.sum()) for s in found)
    tried = [[(int(s.sum()), held(run, s)) for s in every_schedule(run)] for run in runs]
    best = min(first + second for (n, first), (m, second) in itertools.product(*tried) if n + m == triggers)
    assert sum(held(run, s) for run, s in zip(runs, found, strict=True)) == pytest.approx(best)


def every_schedule(run):
    """Every schedule of a short run."""
    free = np.flatnonzero(run.free)
    for chosen in itertools.product([False, True], repeat=len(free)):
        schedule = np.zeros(run.slices + 1, bool)
        schedule[free] = chosen
        yield schedule


def test_once_triggers_once_per_interval():
    run = make_run(0)
    assert np.flatnonzero(schedules.once(run, 2)).tolist() == [2, 7, 12, 17]


@pytest.fixture(scope="module")
def run(data):
    """One recorded sequence, cut to 0.5 s."""
    files = find_sequences(data).files
    methods = (Method("repeat", "repeat"), Method("warp", "warp"))
    task = EndToEndTask(files, methods, lambda trace: {"all": np.ones(trace.slices + 1, bool)}, slices=25)
    return task(min(files)), files


def test_a_run_equals_the_trace_of_its_sequence(run):
    found, files = run
    assert found.slices == 25
    stream = RecordingStream([files[found.seed]])
    trace = trace_sequence(stream, Method("warp", "warp").make(), found.seed)
    for name, table in zip(METRIC_NAMES, found.errors["warp"], strict=True):
        np.testing.assert_array_equal(table, trace.errors[name][:26])
    record = found.play("all", found.schedules["all"], "warp")
    assert record.effective_rate == 50.0
    ages = np.zeros(25, int)
    assert record.held["log_mae"] == pytest.approx(trace.errors["log_mae"][np.arange(1, 26), ages].mean())


def test_a_run_survives_its_file(run, tmp_path):
    found = run[0]
    found.save(tmp_path / "x.npz")
    loaded = SequenceRun.load(tmp_path / "x.npz")
    assert loaded.description == found.description
    np.testing.assert_array_equal(loaded.errors["warp"], found.errors["warp"])
    np.testing.assert_array_equal(loaded.free, found.free)
    assert loaded.play("p", loaded.schedules["all"], "repeat") == found.play(
        "p", found.schedules["all"], "repeat"
    )


# Keyframes


def test_a_perfect_detector_and_one_that_always_answers(data, tmp_path):
    files = find_sequences(data).files
    with Recording(files[min(files)]) as recording:
        labels = recording.keyframe[1:].astype(float)
    task = ScoreTask(
        files, lambda: [lambda frames: labels[: len(frames)], lambda frames: np.ones(len(frames))]
    )
    result = task(min(files))
    result.save(tmp_path / "x.npz")
    loaded = ScoredSequence.load(tmp_path / "x.npz")
    np.testing.assert_array_equal(loaded.scores, result.scores)
    assert loaded.lidar.sum() == len(labels) // 5
    found = summarise_keyframes(
        {"test": [loaded]}, [DetectorFile("perfect", 0.5, 0), DetectorFile("always", 0.5, 1)], seed=0
    )
    test = found.splits["test"]
    assert test.rows["perfect"]["f1"].mean == 1.0
    assert test.rows["always"]["f1"].mean == pytest.approx(test.always_f1.mean)
    assert test.rows["always"]["rate"].mean == 50.0
    assert test.keyframes == pytest.approx(labels.mean())
    assert loaded.weather in found.weathers
    with pytest.raises(ValueError, match="expected test among them"):
        summarise_keyframes({"train": [loaded]}, [], seed=0)


def test_rows_join_training_seeds(data):
    files = find_sequences(data).files
    result = ScoreTask(files, lambda: [lambda f: np.zeros(len(f)), lambda f: np.ones(len(f))])(min(files))
    rows = [DetectorFile("net", 0.5, 0), DetectorFile("net", 0.5, 1)]
    recall = summarise_keyframes({"test": [result]}, rows, seed=0).splits["test"].rows["net"]["recall"]
    assert (recall.mean, recall.spread) == (0.5, pytest.approx(math.sqrt(0.5)))


# Variants and targets

OURS_CARD = {"motion": None, "refine": {"heads": 3}, "warped": True, "events": True}


@pytest.mark.parametrize(
    ("options", "training", "row", "odometry"),
    [
        ({}, {}, "ours", False),
        ({"motion": {"channels": [8]}}, {}, "ours: motion network", False),
        ({"motion": {"channels": [8]}, "refine": None}, {}, "ours: motion and warp only", False),
        ({"warped": False}, {}, "ours: refinement only", False),
        ({}, {"odometry": True}, "ours: true motion", True),
        ({"events": False}, {}, "ours: without events", False),
        ({"refine": {"heads": 1}}, {}, "ours: one head", False),
    ],
)
def test_rows_of_our_variants_follow_from_their_cards(tmp_path, options, training, row, odometry):
    path = tmp_path / "x.safetensors"
    write_card(path, Card("x", learned_networks.ARCHITECTURE, {**OURS_CARD, **options}, training=training))
    assert read_variant(path) == Variant(row, odometry)


def test_rows_of_the_papers_family_follow_from_their_cards(tmp_path):
    path = tmp_path / "x.safetensors"
    keys = set()
    for name, options in unet.VARIANTS.items():
        card = Card("x", unet.ARCHITECTURE, dataclasses.asdict(options))
        write_card(path, card)
        variant = read_variant(path)
        assert variant.row == f"paper's network: {name}"
        keys.add(variant.published)
        write_card(path, dataclasses.replace(card, training={"loss": {"weights": "paper"}}))
        assert read_variant(path) == Variant(f"{variant.row}, paper loss weights")
    assert keys == set(published.ABLATION)
    write_card(path, Card("x", "keyframe-cnn"))
    with pytest.raises(ValueError, match="found architecture 'keyframe-cnn'"):
        read_variant(path)
    with pytest.raises(FileNotFoundError, match=r"lost\.safetensors"):
        read_variant(tmp_path / "lost.safetensors")


def errors_of(rows):
    """Figures of rows with ``rows[row]`` times Repeat's errors, but ``worse`` has more false returns."""
    repeat = np.full((3, 1, len(GROUPS), len(METRIC_NAMES)), 2.0)
    values = np.concatenate([repeat * factor for factor in rows.values()], axis=1)
    delta = [i for i, name in enumerate(METRIC_NAMES) if name.startswith("delta")]
    values[..., delta] = 4.0 - values[..., delta]  # larger is better
    if "worse" in rows:
        values[:, list(rows).index("worse"), 1, METRIC_NAMES.index("false_return")] = 2.1
    rng = np.random.default_rng(0)
    return summarise(with_mean(values), list(rows), (*GROUPS, "mean"), METRIC_NAMES, "repeat", rng)


def test_targets_of_the_gaps_find_the_one_metric_that_is_worse():
    figures = errors_of({"repeat": 1.0, "good": 0.5, "worse": 0.5, "weak": 0.62})
    assert all(target.met for target in targets.rate_targets(figures, "good", "quarter"))
    (missed,) = [t for t in targets.rate_targets(figures, "worse", "quarter") if not t.met]
    assert "false_return at 50 ms" in missed.name and missed.value == pytest.approx(0.05)
    failed = [t.name.split()[2] for t in targets.rate_targets(figures, "weak", "quarter") if not t.met]
    assert failed == ["log_mae", "imae", "rmse"]  # bad_25 is asked for 35 %
    assert [t.met for t in targets.rate_targets(figures, "good", "half")] == [True] * 6
    assert targets.rate_targets(figures, "missing", "quarter") == []


def test_events_are_worth_what_is_lost_without_them():
    figures = errors_of({"repeat": 1.0, "ours": 0.5, "ours: without events": 0.56, "ours, shuffled": 0.54})
    rows = ("ours: without events", "ours, shuffled", "not measured")
    found = targets.ablation_targets(figures, "ours", rows)
    assert [target.met for target in found] == [True, False]
    assert found[0].value == pytest.approx(0.06)


def test_ablation_tables_stand_beside_the_papers():
    figures = errors_of({"repeat": 1.0, "paper's network: without-skip": 0.7})
    sections = ablation_sections(figures, {"paper's network: without-skip": "without skip"})
    text = document.markdown(sections)
    assert "| without skip | published | 5.935 |" in text
    assert "| without skip | paper's network: without-skip | 1.4 |" in text
    assert "1.4 (-30 %)" in text


# Published figures and documents


def test_published_figures_agree_with_the_papers_own_claims():
    """ "31.43 % lower RMSE" (adaptive), "29 % in RMSE" (end to end), and every row has seven metrics."""
    assert 1 - published.ADAPTIVE_NETWORK[0] / published.ADAPTIVE_REPEAT[0] == pytest.approx(0.3143, abs=5e-4)
    repeat, network = published.END_TO_END["repeat"][0], published.END_TO_END["network"][0]
    assert 1 - network / repeat == pytest.approx(0.29, abs=0.005)
    tables = [published.REPEAT, published.NETWORK, published.ABLATION, published.END_TO_END]
    assert {len(row) for table in tables for row in table.values()} == {7}


def test_only_what_is_between_the_marks_is_replaced(tmp_path):
    path = tmp_path / "results.md"
    path.write_text("# A\n<!-- begin one -->old<!-- end one -->\nB\n<!-- begin two -->\n<!-- end two -->\n")
    document.update_document(path, "one", "new")
    document.update_document(path, "one", "newer\n")
    assert path.read_text() == (
        "# A\n<!-- begin one -->\n\nnewer\n\n<!-- end one -->\nB\n<!-- begin two -->\n<!-- end two -->\n"
    )
    with pytest.raises(ValueError, match="found no <!-- begin three -->"):
        document.update_document(path, "three", "x")


def test_json_has_no_nan():
    figure = SequenceErrors(1, {"a": float("nan")}, np.zeros(1)).description
    assert document.jsonable({1: [figure, (1.5, True)]}) == {"1": [{"a": None}, [1.5, True]]}


def test_every_table_has_its_marks_in_the_document():
    text = (reproduce.ROOT / "docs" / "results.md").read_text()
    for table in ("table-keyframe", "table-weather", "table-rates", "table-ablation", "table-end-to-end"):
        begin, end = document.marks(table)
        assert text.count(begin) == text.count(end) == 1


# The command

NO_NETWORKS = "table-rates --weights --paper-weights --pairs 2 --workers 0".split()


def test_table_rates_writes_resumes_and_updates_the_document(data, tmp_path, capsys, monkeypatch):
    path = tmp_path / "results.md"
    path.write_text("head\n<!-- begin table-rates -->\n<!-- end table-rates -->\ntail\n")
    options = [*NO_NETWORKS, "--data", str(data), "--markdown", str(path)]
    out = tmp_path / "whole"
    assert reproduce.main([*options, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "| repeat |" in printed and "Repeat, published" in printed
    text = path.read_text()
    assert text.startswith("head\n") and text.endswith("tail\n") and "12.21" in text
    results = json.loads((out / "results.json").read_text())
    assert set(results["figures"]) == {"repeat", "linear", "exponential", "warp", "warp (true motion)"}
    assert set(results["figures"]["warp"]) == {*GROUPS, "mean"}

    call = GapsTask.__call__

    def interrupted(task, seed):
        if seed == max(find_sequences(data).files):
            raise KeyboardInterrupt
        return call(task, seed)

    monkeypatch.setattr(GapsTask, "__call__", interrupted)
    again = [*options, "--out", str(tmp_path / "parts")]
    assert reproduce.main(again) == 130
    assert "--resume" in capsys.readouterr().err
    monkeypatch.setattr(GapsTask, "__call__", call)
    assert reproduce.main([*again, "--resume"]) == 0
    capsys.readouterr()
    assert json.loads((tmp_path / "parts" / "results.json").read_text())["figures"] == results["figures"]
    assert reproduce.main(again) == 2
    assert "already holds another run" in capsys.readouterr().err
    assert reproduce.main([*again, "--resume", "--pairs", "1"]) == 2
    assert "other settings: pairs" in capsys.readouterr().err


def test_table_end_to_end_and_table_keyframe_run(data, detectors, tmp_path, capsys):
    options = ["--data", str(data), "--workers", "0", "--sequences", "1"]
    end = ["table-end-to-end", *options, "--weights", "None", "--paper-weights", "None", "--duration", "0.3"]
    assert reproduce.main([*end, *detectors, "--out", str(tmp_path / "end")]) == 0
    found = json.loads((tmp_path / "end" / "results.json").read_text())["figures"]
    alone, always = (found["held"][policy] for policy in ("never", "always"))
    assert alone["warp"]["log_mae"]["mean"] == alone["repeat"]["log_mae"]["mean"]
    assert always["repeat"]["log_mae"]["mean"] == pytest.approx(alone["repeat"]["log_mae"]["mean"])
    assert always["warp"]["log_mae"]["change"] < 0
    assert found["policies"]["always"]["rate"]["mean"] == pytest.approx(50.0)
    assert found["policies"]["keyframe-rule*"]["f1"]["mean"] in (1.0, None)

    frames, temporal = detectors[1], detectors[3]
    keyframe = ["table-keyframe", *options, "--weights", frames, frames, "--temporal-weights", temporal]
    keyframe += ["--recipe-weights", frames]
    assert reproduce.main([*keyframe, "--out", str(tmp_path / "keyframe")]) == 0
    assert "published" in capsys.readouterr().out
    row = json.loads((tmp_path / "keyframe" / "results.json").read_text())["figures"]["splits"]["test"][
        "rows"
    ]
    assert row["keyframe-cnn"]["f1"]["spread"] == 0.0
    assert row["keyframe-cnn-temporal"]["f1"]["spread"] is None
    assert row["keyframe-cnn, the paper's recipe"]["f1"]["mean"] == row["keyframe-cnn"]["f1"]["mean"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--data", "{tmp}"], "found no {tmp}/manifest.json"),
        (["--sequences", "3"], "sequences: found 3, expected 1 to 2"),
        (["--pairs", "0"], "pairs: found 0"),
        (["--weights", "{tmp}/lost.safetensors"], "lost.safetensors"),
        (["--markdown", "{tmp}/lost.md"], "lost.md"),
    ],
)
def test_bad_options_are_refused_before_any_work(data, tmp_path, capsys, change, message):
    options = [*NO_NETWORKS, "--data", str(data), "--out", str(tmp_path / "out")]
    assert reproduce.main([*options, *(part.format(tmp=tmp_path) for part in change)]) == 2
    assert message.format(tmp=tmp_path) in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_other_splits_and_broken_manifests_are_refused(data, tmp_path, capsys):
    manifest = json.loads((data / "manifest.json").read_text())
    folder = tmp_path / "data"
    (folder / "sequences").mkdir(parents=True)
    for entry in manifest["sequences"]:
        (folder / entry["file"]).symlink_to(data / entry["file"])
    options = [*NO_NETWORKS, "--data", str(folder), "--out", str(tmp_path / "out")]
    for content, message in (
        (json.dumps({**manifest, "split": "val"}), "found val sequences"),
        ("[]", "found no manifest of recordings"),
        (json.dumps({"sequences": [{"seed": 1}]}), "found no manifest of recordings"),
    ):
        (folder / "manifest.json").write_text(content)
        assert reproduce.main(options) == 2
        assert message in capsys.readouterr().err
    (folder / "manifest.json").write_text(json.dumps(manifest))
    (folder / manifest["sequences"][1]["file"]).unlink()
    assert reproduce.main(options) == 2
    assert "which" in (error := capsys.readouterr().err) and "lists" in error
