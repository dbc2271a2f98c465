import itertools

import numpy as np
import pytest

from nl_env.comparison import pooled_floor
from nl_env.curves import Curve, OperatingPoints, lower_hull, oracle_points
from nl_env.frontier import MATCHED_RATES, frontier

ENDS = OperatingPoints(np.array([[10.0, 10.0], [50.0, 50.0]]), np.array([[5.0, 7.0], [1.0, 1.0]]))
"""Two sequences, errors 6 and 1 on average at 10 and 50 Hz."""
RESAMPLES = np.random.default_rng(0).integers(2, size=(200, 2))


def points(*pairs):
    """Operating points that are the same in both sequences."""
    return OperatingPoints(
        *(np.repeat(np.array([column]).T, 2, axis=1) for column in zip(*pairs, strict=True))
    )


def shifted(rate, error, by):
    """One point whose error is ``by`` higher in the second sequence."""
    return OperatingPoints(np.array([[rate, rate]]), np.array([[error - by / 2, error + by / 2]]))


def test_the_hull_keeps_what_time_sharing_cannot_beat():
    rate = np.array([10.0, 20.0, 20.0, 30.0, 40.0, 50.0])
    error = np.array([6.0, 3.0, 4.0, 2.9, 1.0, 1.5])
    curve = lower_hull(rate, error)
    assert curve.rate.tolist() == [10, 20, 40, 50]
    assert curve.error.tolist() == [6, 3, 1, 1.5]
    slopes = np.diff(curve.error) / np.diff(curve.rate)
    assert (np.diff(slopes) > 0).all()
    shuffled = np.random.default_rng(1).permutation(len(rate))
    assert lower_hull(rate[shuffled], error[shuffled]).rate.tolist() == curve.rate.tolist()


def test_points_on_one_line_make_that_line():
    rate = np.linspace(10, 50, 9)
    assert lower_hull(rate, 6 - 0.1 * rate).at(np.array([17.0])) == pytest.approx(6 - 1.7)


def test_areas_and_rates_of_a_curve_are_exact():
    curve = Curve(np.array([10.0, 20.0, 50.0]), np.array([6.0, 2.0, 1.0]))
    assert curve.area(10, 50) == pytest.approx(10 * 4 + 30 * 1.5)
    assert curve.area(15, 35) == pytest.approx(5 * 3 + 15 * 1.75)
    assert np.isnan(curve.area(5, 50))
    assert curve.at(np.array([9.0, 10.0, 15.0, 50.0 + 1e-9])) == pytest.approx([np.nan, 6, 4, 1], nan_ok=True)
    assert curve.rate_for(4.0) == pytest.approx(15.0)
    assert curve.rate_for(7.0) == 10.0
    assert np.isnan(curve.rate_for(0.5))


def run(families, oracle=None):
    oracle = points((20.0, 2.0), (30.0, 1.0)) if oracle is None else oracle
    return frontier(families, oracle, ENDS, RESAMPLES)


def test_regret_is_one_for_periodic_and_zero_for_the_oracle():
    periodic = {"periodic": [points((30.0, 3.0))], "evenly": [points((20.0, 4.0))]}
    # Areas: periodic 50+35+40, the oracle's 40+15+20, a family's on the chord between 20 and 40 Hz.
    family = points((20.0, 2.0), (40.0, 1.2))
    found = run({**periodic, "ours": [family]})
    assert [curve.family for curve in found.families] == ["oracle", "ours", "periodic"]
    assert found["oracle"].regret.mean == 0
    assert found["periodic"].regret.mean == pytest.approx(1)
    assert (found["periodic"].regret.low, found["periodic"].regret.high) == pytest.approx((1, 1))
    ours = 40 + 20 * 1.6 + 10 * 1.1
    assert found["ours"].regret.mean == pytest.approx((ours - 75) / (125 - 75))
    with pytest.raises(KeyError):
        found["evenly"]


def test_matched_points_and_paired_differences():
    # The sequences differ by more than the policies, and the differences are the same in both.
    baseline, ours = shifted(40.6, 2.0, by=0.6), shifted(40.6, 1.5, by=0.6)
    periodic = {"periodic": [points((20.0, 4.0), (30.0, 3.0))]}
    found = run({**periodic, "keyframe-cnn": [baseline], "ours": [ours]})
    at = {matched.rate: matched for matched in found["ours"].matched}
    assert tuple(at) == MATCHED_RATES
    assert at[40.6].error.mean == pytest.approx(1.5)
    assert at[40.6].error.high - at[40.6].error.low == pytest.approx(0.6)
    assert at[40.6].below_baseline.mean == pytest.approx(0.5)
    assert at[40.6].below_baseline.low == pytest.approx(0.5)
    assert at[40.6].below_baseline.high == pytest.approx(0.5)
    assert at[20.0].error.mean == pytest.approx(6 - 4.5 * 10 / 30.6)
    same = {matched.rate: matched for matched in found["keyframe-cnn"].matched}
    assert same[27.8].below_baseline.mean == 0
    oracle = {matched.rate: matched for matched in found["oracle"].matched}
    assert oracle[27.8].closed.mean == pytest.approx(1)
    target = found["periodic"].matched[2].error.mean
    reached = found["oracle"].rate_for_periodic.mean
    assert np.interp(reached, found["oracle"].rate, found["oracle"].error) == pytest.approx(target, abs=1e-2)


def test_trainings_are_averaged_and_their_spread_is_told():
    periodic = {"periodic": [points((20.0, 4.0), (30.0, 3.0))]}
    found = run({**periodic, "ours": [points((30.0, 2.0)), points((30.0, 1.0))]})
    alone = [run({**periodic, "ours": [points((30.0, error))]})["ours"].regret.mean for error in (2.0, 1.0)]
    assert found["ours"].runs == 2
    assert found["ours"].regret.mean == pytest.approx(np.mean(alone))
    assert (found["ours"].regret_high, found["ours"].regret_low) == pytest.approx(tuple(alone))
    at_30 = found["ours"].error[found["ours"].rate == 30.0]
    assert at_30 == pytest.approx([1.5])


def test_the_priced_oracle_is_the_hull_of_the_exact_floor():
    rng = np.random.default_rng(3)
    slices, lidar_frames, duration = 20, 4, 0.4
    floors = [np.sort(rng.gamma(2.0, 0.02, 17))[::-1] * slices for _ in range(3)]
    oracle = oracle_points(floors, lidar_frames, slices, duration)
    exact = pooled_floor(floors) / (slices * len(floors))
    rates = (lidar_frames + np.arange(len(exact)) / len(floors)) / duration
    hull = lower_hull(rates, exact)
    (found,) = oracle.curves(np.full((1, 3), 1 / 3))
    assert found.area(10, 50) == pytest.approx(hull.area(10, 50), rel=2e-3)
    assert (found.at(rates) >= hull.at(rates) - 1e-12).all()


def test_no_schedule_is_below_the_oracle():
    rng = np.random.default_rng(4)
    errors = rng.gamma(2.0, 0.02, (2, 5))
    floors = [np.array([errors[i].sum(), errors[i].sum() - errors[i].max() + 1e-3]) for i in range(2)]
    oracle = oracle_points(floors, 1, 5, 0.1)
    curve = oracle.curves(np.full((1, 2), 0.5))[0]
    for choice in itertools.product((0, 1), repeat=2):
        rate = np.mean([(1 + n) / 0.1 for n in choice])
        error = np.mean([floor[n] / 5 for floor, n in zip(floors, choice, strict=True)])
        assert curve.at(np.array([rate]))[0] <= error + 1e-12


@pytest.mark.filterwarnings("error")
def test_regret_is_unknown_where_nothing_can_be_gained():
    found = run({"periodic": [points((20.0, 2.0))], "ours": [points((20.0, 3.0))]}, points((20.0, 2.0)))
    assert np.isnan(found["ours"].regret.mean)
    assert np.isnan(found["ours"].matched[0].closed.mean)
    assert found["ours"].matched[0].saved.mean == pytest.approx(-1)


def test_bad_input_is_named():
    with pytest.raises(ValueError, match=r"families: found \['ours'\], expected one of periodic, evenly"):
        run({"ours": [points((30.0, 2.0))]})
    with pytest.raises(ValueError, match=r"points: found rates of shape \(2,\)"):
        OperatingPoints(np.zeros(2), np.zeros(2))
    with pytest.raises(ValueError, match=r"resamples: found shape \(4, 3\), expected \(n, 2\)"):
        frontier({"periodic": [points((30.0, 2.0))]}, points((20.0, 1.0)), ENDS, np.zeros((4, 3), int))
