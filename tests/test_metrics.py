import math

import numpy as np
import pytest

from nl_env.depth.metrics import (
    FULL_METRICS,
    LOWER_IS_BETTER,
    METRIC_NAMES,
    PAPER_METRICS,
    all_metrics,
    error,
    full_metrics,
    paper_metrics,
    returns_from_depth,
)


def image(*values):
    return np.array([values], np.float32)


def test_paper_metrics_by_hand():
    # Valid pixels: 10 m read as 12 m and 20 m read as 10 m. Sky truth and truth at the range do not count.
    measured = paper_metrics(image(12, 10, 50, 50), image(10, 20, 0, 200), 200.0)
    assert measured.rmse == pytest.approx(math.sqrt((4 + 100) / 2))
    assert measured.log_rmse == pytest.approx(math.sqrt((math.log(1.2) ** 2 + math.log(2) ** 2) / 2))
    assert measured.abs_rel == pytest.approx((0.2 + 0.5) / 2)
    assert measured.sq_rel == pytest.approx((4 / 10 + 100 / 20) / 2)
    assert (measured.delta_1, measured.delta_2, measured.delta_3) == (0.5, 0.5, 0.5)


def test_deltas_are_nested_thresholds():
    measured = paper_metrics(image(12, 14, 18, 30), image(10, 10, 10, 10), 200.0)
    assert (measured.delta_1, measured.delta_2, measured.delta_3) == (0.25, 0.5, 0.75)


def test_sky_predicted_where_there_is_depth_is_clipped_at_1e_8():
    measured = paper_metrics(image(0), image(10), 200.0)
    assert measured.log_rmse == pytest.approx(math.log(10 / 1e-8), rel=1e-6)
    assert measured.rmse == pytest.approx(10)


def test_a_perfect_prediction_is_exactly_perfect():
    depths = np.random.default_rng(2).uniform(0.1, 250, (40, 50)).astype(np.float32)
    assert paper_metrics(depths, depths, 200.0) == (0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0)
    assert full_metrics(depths, depths, 200.0) == (0.0,) * len(FULL_METRICS)


def test_image_of_sky_has_no_paper_metric_but_full_ones():
    sky = image(0, 0)
    assert all(math.isnan(value) for value in paper_metrics(sky, sky, 200.0))
    assert full_metrics(sky, sky, 200.0) == (0.0,) * len(FULL_METRICS)


def test_full_metrics_by_hand():
    # 10 m read as 12.8 m; a missed and a false return; half a metre read as 1 m is right outdoors.
    measured = full_metrics(image(12.8, 0, 100, 1), image(10, 50, 0, 0.5), 200.0)
    log_errors = [math.log(1.28), math.log(4), math.log(2), 0.0]
    inverse_errors = [1000 / 10 - 1000 / 12.8, 1000 / 50 - 1000 / 200, 1000 / 100 - 1000 / 200, 0.0]
    assert measured.log_mae == pytest.approx(np.mean(log_errors), rel=1e-6)
    assert measured.imae == pytest.approx(np.mean(inverse_errors), rel=1e-6)
    assert measured.irmse == pytest.approx(math.sqrt(np.mean(np.square(inverse_errors))), rel=1e-6)
    assert (measured.bad_25, measured.bad_10) == (0.75, 0.75)
    assert (measured.false_return, measured.missed_return) == (0.25, 0.25)


def test_min_depth_is_where_indoor_and_outdoor_differ():
    near, far = image(0.5), image(1.0)
    assert full_metrics(near, far, 200.0).log_mae == 0.0
    assert full_metrics(near, far, 9.0, min_depth=0.1).log_mae == pytest.approx(math.log(2), rel=1e-6)


def test_full_metrics_do_not_care_which_side_is_the_prediction():
    generator = np.random.default_rng(0)
    depths = generator.uniform(1, 250, (2, 30, 40)).astype(np.float32)
    a, b = np.where(generator.random(depths.shape) < 0.2, np.float32(0), depths)
    ab, ba = full_metrics(a, b, 200.0), full_metrics(b, a, 200.0)
    assert ab.log_mae == pytest.approx(ba.log_mae)
    assert (ab.false_return, ab.missed_return) == (ba.missed_return, ba.false_return)


def test_log_follows_the_library_over_its_whole_domain():
    generator = np.random.default_rng(1)
    truth = np.exp(generator.uniform(-8, 5.2, (100, 100))).astype(np.float32)
    pred = np.exp(generator.uniform(-18, 10, (100, 100))).astype(np.float32)
    expected = np.sqrt(np.mean((np.log(pred.astype(float)) - np.log(truth.astype(float))) ** 2))
    assert paper_metrics(pred, truth, 200.0).log_rmse == pytest.approx(expected, rel=1e-6)


def scene(shape, seed):
    """Prediction and truth with sky, depths beyond the range and below the nearest, and many exact hits."""
    rng = np.random.default_rng(seed)
    truth = np.exp(rng.uniform(-1.0, 6.0, shape))
    pred = truth * np.exp(rng.normal(0.0, 0.3, shape))
    truth[rng.random(shape) < 0.2], pred[rng.random(shape) < 0.2] = 0, 0
    exact = rng.random(shape) < 0.3
    exact.flat[: truth.size // 3] = True
    return np.where(exact, truth, pred).astype(np.float32), truth.astype(np.float32)


def reference(pred, truth, max_depth, min_depth):
    """Every metric by name, the formulas in float64."""
    use = (truth > 0) & (truth < max_depth)
    g, p = truth[use].astype(float), np.maximum(pred[use].astype(float), 1e-8)
    factor = np.maximum(p / g, g / p)
    log = np.log(p / g)
    paper = [
        np.sqrt(np.mean((p - g) ** 2)),
        np.sqrt(np.mean(log**2)),
        np.mean(abs(p - g) / g),
        np.mean((p - g) ** 2 / g),
        *(np.mean(factor < 1.25**k) for k in (1, 2, 3)),
    ]
    returns = [(depth > 0) & (depth < max_depth) for depth in (pred, truth)]
    p, g = (
        np.where(there, np.maximum(depth.astype(float), min_depth), max_depth)
        for depth, there in zip((pred, truth), returns, strict=True)
    )
    factor = np.maximum(p / g, g / p)
    full = [
        np.mean(np.log(factor)),
        1000 * np.mean(abs(1 / p - 1 / g)),
        1000 * np.sqrt(np.mean((1 / p - 1 / g) ** 2)),
        np.mean(factor > 1.25),
        np.mean(factor > 1.1),
        np.mean(returns[0] & ~returns[1]),
        np.mean(returns[1] & ~returns[0]),
    ]
    return dict(zip(METRIC_NAMES, (*paper, *full), strict=True))


@pytest.mark.parametrize("shape", [(1, 3), (1, 8), (3, 5), (7, 9), (120, 160)])
@pytest.mark.parametrize("limits", [(200.0, 1.0), (9.0, 0.1)])
def test_both_sets_follow_their_formulas_at_any_size(shape, limits):
    for seed in range(3):
        pred, truth = scene(shape, seed)
        if not np.any((truth > 0) & (truth < limits[0])):
            continue
        measured = all_metrics(pred, truth, *limits)
        assert measured == pytest.approx(reference(pred, truth, *limits), rel=1e-5, abs=1e-7)


@pytest.mark.parametrize("shape", [(1, 1), (1, 13), (6, 8), (60, 80)])
def test_both_sets_at_once_are_each_set_in_every_bit(shape):
    pred, truth = scene(shape, 3)
    other = np.roll(pred, 1, axis=1)
    for if_return in (None, pred, other):
        measured = all_metrics(pred, truth, 200.0, 1.0, if_return)
        paper = paper_metrics(pred if if_return is None else if_return, truth, 200.0)
        expected = dict(zip(METRIC_NAMES, (*paper, *full_metrics(pred, truth, 200.0)), strict=True))
        assert np.array(list(measured.values())).tobytes() == np.array(list(expected.values())).tobytes()
        assert list(measured) == list(METRIC_NAMES)


def test_pixels_are_summed_in_eight_lanes_whatever_the_machine():
    """Terms are powers of two, so small beside 1 that each is lost or not as the order of summation says."""
    far = 2.0**100
    pred = np.full((1, 26), far, np.float32)
    pred[0, 0], pred[0, [1, 8, 9, 16]], pred[0, 24:] = 1.0, 2.0**53, 2.0**54
    # Pixels 8 and 16 are lost in the lane of pixel 0, as are 24 and 25 one after the other at the end; 1 and
    # 9 have a lane of their own and together are large enough.
    expected = 1.0 + 2.0**-52
    truth = np.full_like(pred, far)
    assert full_metrics(pred, truth, 2.0**101, 2.0**-10).imae == 1000.0 * expected / 26


def test_errors_are_smaller_for_the_better_prediction():
    truth, good, poor = image(10, 20, 0, 0), image(10, 20, 0, 0), image(30, 0, 20, 0)
    for name in METRIC_NAMES:
        assert error(name)(good, truth, 200.0, 1.0) < error(name)(poor, truth, 200.0, 1.0), name
    assert METRIC_NAMES == PAPER_METRICS + FULL_METRICS
    assert {name for name in METRIC_NAMES if not LOWER_IS_BETTER[name]} == {"delta_1", "delta_2", "delta_3"}


def test_network_without_return_head_means_no_return_below_a_metre():
    assert returns_from_depth(image(0.2, 0.99, 1.0, 30)).tolist() == image(0, 0, 1.0, 30).tolist()


def test_bad_input_is_named():
    good = image(10, 20)
    with pytest.raises(ValueError, match=r"pred: found shape \(1, 3\), expected .* \(1, 2\)"):
        paper_metrics(image(1, 2, 3), good, 200.0)
    with pytest.raises(ValueError, match=r"truth: found shape \(2,\)"):
        full_metrics(good[0], good[0], 200.0)
    for broken in (math.nan, math.inf):
        with pytest.raises(ValueError, match="pred: found NaN or infinity"):
            paper_metrics(image(broken, 20), good, 200.0)
    for broken in (math.nan, math.inf, -1.0):
        with pytest.raises(ValueError, match="negative or non-finite"):
            full_metrics(image(broken, 20), good, 200.0)
            all_metrics(good, image(10, broken), 200.0)
    with pytest.raises(ValueError, match="min_depth: found 300"):
        full_metrics(good, good, 200.0, min_depth=300)
    with pytest.raises(ValueError, match="min_depth: found 0"):
        all_metrics(good, good, 200.0, min_depth=0)
    with pytest.raises(ValueError, match=r"'mae'.*log_mae.*missed_return"):
        error("mae")
