"""Event frame and voxel grid on cases small enough to check by hand."""

import numpy as np
import pytest

from nl_env.representations import event_frame, frame_from_bins, validate_events, voxel_from_bins, voxel_grid
from nl_env.types import EVENT_DTYPE

SHAPE = (3, 4)


def make(rows, polarity="i1"):
    """Events from (t, x, y, p) rows; p is given as -1 or +1."""
    dtype = [("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", polarity)]
    code = (lambda p: p) if polarity == "i1" else (lambda p: p > 0)
    return np.array([(t, x, y, code(p)) for t, x, y, p in rows], dtype)


ROWS = [(9, 0, 0, 1), (10, 1, 2, 1), (13, 1, 2, 1), (14, 3, 0, -1), (19, 1, 2, -1), (20, 0, 1, 1)]


def random_events(count, start, stop, shape, seed=0):
    rng = np.random.default_rng(seed)
    events = np.empty(count, EVENT_DTYPE)
    events["t"] = np.sort(rng.integers(start, stop, count))
    events["x"], events["y"] = rng.integers(0, shape[1], count), rng.integers(0, shape[0], count)
    events["p"] = rng.choice([-1, 1], count)
    return events


@pytest.mark.parametrize("polarity", ["i1", "u1", "?"])
def test_event_frame_sums_signed_events_of_the_half_open_window(polarity):
    events = make(ROWS, polarity)
    before = events.copy()
    frame = event_frame(events, SHAPE, 10, 20)
    expected = np.zeros(SHAPE, np.int16)
    expected[2, 1], expected[0, 3] = 1, -1
    assert frame.dtype == np.int16
    np.testing.assert_array_equal(frame, expected)
    np.testing.assert_array_equal(events, before)


@pytest.mark.parametrize("polarity", ["i1", "u1", "?"])
def test_voxel_grid_bins_by_floor(polarity):
    grid = voxel_grid(make(ROWS, polarity), SHAPE, 10, 20)
    expected = np.zeros((5, *SHAPE), np.float32)
    expected[0, 2, 1], expected[1, 2, 1], expected[2, 0, 3], expected[4, 2, 1] = 1, 1, -1, -1
    assert grid.dtype == np.float32
    np.testing.assert_array_equal(grid, expected)


def test_voxel_grid_floor_is_exact_for_odd_windows_late_times_and_any_bin_count():
    start = 36_000_000_000
    for bins, length in ((5, 7), (3, 100_003), (7, 5), (1, 20)):
        events = random_events(400, start, start + length, SHAPE)
        expected = np.zeros((bins, *SHAPE), np.float32)
        for t, x, y, p in events.tolist():
            expected[bins * (t - start) // length, y, x] += p
        np.testing.assert_array_equal(voxel_grid(events, SHAPE, start, start + length, bins), expected)


def test_empty_window_no_events_and_a_single_event():
    assert not event_frame(make(ROWS), SHAPE, 100, 200).any()
    assert not voxel_grid(make([]), SHAPE, 0, 10).any()
    grid = voxel_grid(make([(0, 2, 1, -1)]), SHAPE, 0, 10)
    assert grid[0, 1, 2] == grid.sum() == -1


@pytest.mark.parametrize("slices", [1, 2, 3, 5, 10])
def test_summed_slice_bins_equal_the_voxel_grid_of_the_events(slices):
    shape, stop = (11, 17), slices * 20_000
    events = random_events(20_000, 0, stop, shape, slices)
    fine = voxel_grid(events, shape, 0, stop, 5 * slices).astype(np.int16).reshape(slices, 5, *shape)
    before = fine.copy()
    np.testing.assert_array_equal(voxel_from_bins(list(fine)), voxel_grid(events, shape, 0, stop))
    np.testing.assert_array_equal(frame_from_bins(fine[-1]), event_frame(events, shape, stop - 20_000, stop))
    assert frame_from_bins(fine[0]).dtype == np.int16
    np.testing.assert_array_equal(fine, before)


@pytest.mark.parametrize(
    ("events", "error", "message"),
    [
        (make([(5, 0, 0, 1), (4, 0, 0, 1)]), ValueError, "index 1"),
        (make([(5, 4, 0, 1)]), ValueError, "x = 4"),
        (make([(5, 0, 3, 1)]), ValueError, "y = 3"),
        (make([(5, 0, 0, 0)]), ValueError, "p = 0"),
        (np.zeros((2, 4)), TypeError, "fields t, x, y, p"),
        (np.zeros(1, [("t", "f8"), ("x", "u2"), ("y", "u2"), ("p", "i1")]), TypeError, "found t"),
        (np.array([(np.nan, 0, 0, 1)], [("t", "f8"), ("x", "u2"), ("y", "u2"), ("p", "i1")]), TypeError, "t"),
        (np.zeros(1, [("t", "i8"), ("x", "u2"), ("y", "u2"), ("p", "f4")]), TypeError, "found p"),
        (
            np.array([(5, -1, 0, 1)], [("t", "i8"), ("x", "i2"), ("y", "i2"), ("p", "i1")]),
            ValueError,
            "x = -1",
        ),
    ],
)
def test_refuses_bad_events(events, error, message):
    with pytest.raises(error, match=message):
        validate_events(events, SHAPE)
    with pytest.raises(error, match=message):
        event_frame(events, SHAPE, 0, 10)


def test_refuses_bad_windows_and_slices():
    with pytest.raises(ValueError, match="t1"):
        event_frame(make(ROWS), SHAPE, 10, 10)
    with pytest.raises(ValueError, match="bins"):
        voxel_grid(make(ROWS), SHAPE, 0, 10, 0)
    with pytest.raises(ValueError, match="slices"):
        voxel_from_bins([])
    with pytest.raises(ValueError, match="slices"):
        voxel_from_bins([np.zeros((5, 3, 4), np.int16), np.zeros((5, 4, 3), np.int16)])
    with pytest.raises(ValueError, match="slices"):
        voxel_from_bins([np.zeros((5, 3, 4), np.float32)])
    with pytest.raises(ValueError, match="bins"):
        frame_from_bins(np.zeros((3, 4), np.int16))
