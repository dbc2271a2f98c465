from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest

from agents.oracle import OptimalOracle, optimal_schedule, oracle_curve, priced_schedule


def random_table(rng, slices, period):
    """Errors without any order: fresh frames may be worse than old ones, so interval costs are not convex."""
    errors = rng.uniform(size=(slices + 1, period))
    for k in range(slices + 1):
        errors[k, k % period + 1 :] = np.nan
    return errors


def total_error(errors, period, schedule):
    total, held = 0.0, 0
    for k in range(1, len(errors)):
        if k % period == 0 or schedule[k]:
            held = k
        total += errors[k, k - held]
    return total


def brute_force(errors, period):
    """Least total for every number of triggers, by trying all schedules."""
    free = [k for k in range(1, len(errors)) if k % period]
    least = []
    for count in range(len(free) + 1):
        totals = []
        for chosen in combinations(free, count):
            schedule = np.zeros(len(errors), bool)
            schedule[list(chosen)] = True
            totals.append(total_error(errors, period, schedule))
        least.append(min(totals))
    return np.array(least)


@pytest.mark.parametrize(
    ("slices", "period"), [(10, 5), (12, 5), (9, 2), (4, 5), (11, 10), (13, 4), (6, 1), (5, 5)]
)
@pytest.mark.parametrize("seed", range(3))
def test_optimum_equals_brute_force(slices, period, seed):
    errors = random_table(np.random.default_rng(seed), slices, period)
    expected = brute_force(errors, period)
    counts, totals = oracle_curve(errors, period)
    np.testing.assert_array_equal(counts, np.arange(len(expected)))
    np.testing.assert_allclose(totals, expected)
    for count in counts:
        schedule = optimal_schedule(errors, period, count)
        assert schedule.sum() == count and not schedule[::period].any()
        assert total_error(errors, period, schedule) == pytest.approx(expected[count])


@pytest.mark.parametrize("price", [0.0, 0.1, 0.5, 3.0])
def test_a_price_gives_the_best_total_with_the_price(price):
    errors = random_table(np.random.default_rng(7), 12, 5)
    counts, totals = oracle_curve(errors, 5)
    schedule = priced_schedule(errors, 5, price)
    assert total_error(errors, 5, schedule) + price * schedule.sum() == pytest.approx(
        np.min(totals + price * counts)
    )


def test_interval_costs_that_are_not_convex_are_solved_exactly():
    """One trigger saves nothing and two save 1: a price never gives one trigger, the knapsack still does."""
    errors = np.full((5, 5), 5.0)  # an extrapolated frame is useless once it is held
    errors[range(5), range(5)] = 1.0  # the LiDAR frame of t = 0
    errors[:, 0] = 1.0
    errors[3, 0] = 0.0  # the only good extrapolation, which needs another right after it
    np.testing.assert_array_equal(oracle_curve(errors, 5)[1], [4, 4, 3, 3, 3])
    np.testing.assert_array_equal(brute_force(errors, 5), [4, 4, 3, 3, 3])
    assert optimal_schedule(errors, 5, 1).tolist() == [False, False, False, False, True]
    assert {priced_schedule(errors, 5, price).sum() for price in (0.0, 0.3, 0.49, 0.51, 2.0)} == {0, 2}


def test_long_sequence_at_1_hz():
    errors = random_table(np.random.default_rng(0), 1000, 50)
    counts, totals = oracle_curve(errors, 50)
    assert len(counts) == 1000 - 20 + 1
    schedule = optimal_schedule(errors, 50, 300)
    assert total_error(errors, 50, schedule) == pytest.approx(totals[300])


def trace(errors, period):
    lidar = np.arange(len(errors)) % period == 0
    return SimpleNamespace(lidar=lidar, keyframe=lidar, errors={"log_mae": errors})


@pytest.mark.parametrize(
    ("rate", "triggers"), [(10.0, 0), (0.0, 0), (20.0, 10), (35.0, 25), (50.0, 40), (99.0, 40)]
)
def test_policy_follows_the_schedule_for_its_rate(rate, triggers):
    errors = random_table(np.random.default_rng(3), 50, 5)
    policy = OptimalOracle(rate_hz=rate)
    policy.begin(trace(errors, 5))
    observation, state, actions = np.zeros((1, 4, 4), np.uint8), None, [0]
    for _ in range(50):
        action, state = policy.predict(observation, state)
        actions.append(int(action))
    np.testing.assert_array_equal(actions, optimal_schedule(errors, 5, triggers))


def test_bad_input():
    errors = random_table(np.random.default_rng(0), 10, 5)
    with pytest.raises(ValueError, match="triggers: found 9, expected 0 to 8"):
        optimal_schedule(errors, 5, 9)
    with pytest.raises(ValueError, match="errors: found shape"):
        oracle_curve(errors[:, :3], 5)
    broken = errors.copy()
    broken[7, 1] = np.nan
    with pytest.raises(ValueError, match="NaN"):
        oracle_curve(broken, 5)
    with pytest.raises(ValueError, match="exactly one"):
        OptimalOracle()
    with pytest.raises(ValueError, match="exactly one"):
        OptimalOracle(rate_hz=20, price=0.1)
    with pytest.raises(TypeError, match="begin"):
        OptimalOracle(price=0.1).bind(None)
