"""Absolute time rebuilt from the extrapolation CSV, and CSVs that are refused."""

import numpy as np
import pytest
from elidar_files import HEADER, ROWS, TICKS, write_pairs

from nl_env.elidar import frame_ticks, read_metadata, rebuild_timelines
from nl_env.elidar.metadata import SequencePairs, write_metadata
from nl_env.elidar.plan import draw_pairs

NAME = "Town01_Opt_00"


def metadata(folder, rows, name=NAME):
    path = folder / "metadata.csv"
    path.write_text("\n".join([HEADER, *(f"train,{name},{','.join(map(str, row))}" for row in rows)]) + "\n")
    return read_metadata(path)


def ticks(folder, rows):
    return frame_ticks(metadata(folder, rows).sequences[0])


def test_ticks_of_a_small_graph(tmp_path):
    np.testing.assert_array_equal(ticks(tmp_path, ROWS), TICKS)


def test_rows_in_any_order_give_the_same_ticks(tmp_path):
    rng = np.random.default_rng(0)
    for _ in range(5):
        rows = [ROWS[k] for k in rng.permutation(len(ROWS))]
        np.testing.assert_array_equal(ticks(tmp_path, rows), TICKS)


@pytest.mark.parametrize("seed", range(5))
def test_drawn_pairs_are_rebuilt_exactly(tmp_path, seed):
    plan = draw_pairs(4000, np.random.default_rng(seed))
    rows = np.arange(len(plan.prior), dtype=np.int64)
    pairs = SequencePairs(tmp_path, NAME, "train", rows + 2, rows, plan.prior, plan.truth, plan.duration)
    np.testing.assert_array_equal(frame_ticks(pairs), plan.ticks)
    write_metadata(tmp_path / "metadata.csv", [pairs])
    again = read_metadata(tmp_path / "metadata.csv").sequences[0]
    for column in ("lines", "events_id", "prior", "truth", "duration"):
        np.testing.assert_array_equal(getattr(again, column), getattr(pairs, column))


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([*ROWS, (5, 0, 3, 31)], r"found durations that contradict .* without one .* \(line 7\)"),
        ([(0, 0, 1, 4), (1, 1, 2, 4), (2, 0, 2, 9)], r"found durations .* without one .* \(lines 2, 3, 4\)"),
        ([*ROWS, (5, 0, 3, 31), (6, 1, 3, 25)], r"found durations .* earlier rows \(lines 7, 8\)"),
        ([(0, 0, 1, 4), (1, 2, 3, 4), (2, 2, 3, 4)], r"found 2 frames \(first 2\) .*\(lines 3, 4\)"),
        ([(0, 1, 2, 4), (1, 2, 1, 4)], r"found 2 frames \(first 1\) that no chain of rows joins to frame 0"),
        ([(0, 0, 1, 4), (1, 1, 3, 4), (2, 0, 3, 8)], r"found 1 frames \(first 2\)"),
        ([(0, 0, 1, 10), (1, 0, 2, 4)], r"found frame 2 at tick 4, not after frame 1 at 10 \(line 3\)"),
        ([(0, 1, 0, 4)], "found frame 1 at tick -4, not after frame 0 at 0"),
        (
            [(0, 0, 1, 4), (1, 0, 2_000_000_000, 4)],
            r"found frame 2000000000, while 2 rows can place 3 .*line 3",
        ),
        ([(0, 0, 0, 4)], r"found durations that contradict .* \(line 2\)"),
    ],
)
def test_a_sequence_whose_rows_give_no_time_line_is_refused_by_name(tmp_path, rows, message):
    with pytest.raises(ValueError, match=rf"metadata.csv: {NAME}: {message}"):
        ticks(tmp_path, rows)


def test_refused_sequences_can_be_skipped(tmp_path):
    _, path = write_pairs(tmp_path, [("train", "Town01_Opt_00"), ("test", "Town02_Opt_00")])
    path.write_text(path.read_text() + "train,Town01_Opt_00,5,0,3,32\n")
    table = read_metadata(path)
    found, problems = rebuild_timelines(table, on_error="skip")
    assert list(found) == ["Town02_Opt_00"]
    assert problems[0].sequence == "Town01_Opt_00"
    with pytest.raises(ValueError, match=r"without one of these rows the rest agree \(line 12\)"):
        rebuild_timelines(table)


def test_a_byte_order_mark_crlf_and_extra_columns_are_read(tmp_path):
    path = tmp_path / "metadata.csv"
    lines = ["," + HEADER, *(f"{k},train,{NAME},{','.join(map(str, row))}" for k, row in enumerate(ROWS))]
    path.write_bytes("\r\n".join(lines).encode("utf-8-sig"))
    np.testing.assert_array_equal(frame_ticks(read_metadata(path).sequences[0]), TICKS)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "found columns an empty file, missing split"),
        (HEADER + "\n", "found a header and no row"),
        (HEADER.replace(",", ";") + "\ntrain;a;0;0;1;4\n", "in one column, expected commas: split,sequence"),
        (HEADER.replace(",", "\t") + "\n", "in one column, expected commas"),
        (HEADER.replace(",duration", "") + "\n", "missing duration; expected split,sequence"),
        (HEADER + "\ntrain,a,0,0,1\n", "line 2: found 5 columns, expected 6"),
        (HEADER + "\ntrain,a,0,0,1,4\ntrain,a,0,-1,1,4\n", "a: line 3: prior_depth_frame_id: found -1"),
        (HEADER + "\ntrain,a,0,0,1,0\n", "a: line 2: duration: found 0, expected an integer from 1"),
        (HEADER + "\ntrain,a,0.5,0,1,4\n", "a: line 2: events_id: found '0.5', expected an integer"),
        (HEADER + "\ntrain,a,99999999999,0,1,4\n", "a: line 2: events_id: found 99999999999"),
        (HEADER + "\nval,a,0,0,1,4\n", "a: line 2: split: found 'val', expected one of 'train', 'test'"),
        (HEADER + "\ntrain,a,0,0,1,4\ntest,a,0,0,1,4\n", "a: line 3: found splits test and train"),
        (HEADER + '\ntrain,"a,0,0,1,4\n', "not a CSV"),
        (b"\xff\xfe\x00\x01", "found bytes that are not UTF-8 text"),
    ],
)
def test_files_that_are_not_such_a_csv_are_refused(tmp_path, content, message):
    path = tmp_path / "metadata.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError, match=message):
        read_metadata(path)


def test_a_bad_row_costs_its_sequence_only(tmp_path):
    path = tmp_path / "metadata.csv"
    path.write_text(HEADER + "\ntrain,a,0,0,1,4\ntrain,b,0,0,1,x\ntest,c,0,0,1,4\n")
    table = read_metadata(path, on_error="skip")
    assert [pairs.name for pairs in table.sequences] == ["a", "c"]
    assert [problem.sequence for problem in table.problems] == ["b"]
    with pytest.raises(ValueError, match="on_error: found 'ignore'"):
        read_metadata(path, on_error="ignore")
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_metadata(tmp_path / "nowhere.csv")
