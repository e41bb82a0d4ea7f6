import math

import numpy as np
import pytest

from slotfilm_dist.evaluation.study.estimates import (
    area_under_curve,
    curve_band,
    estimate_improvement,
    estimate_iqm,
    held_curve,
    improvement,
    iqm,
    mean_of_last,
    stratified_bootstrap,
)


def test_interquartile_mean_of_eight_is_that_of_the_middle_four():
    assert iqm(np.array([100.0, 5, 3, 4, 6, 1, -90, 2])) == pytest.approx((2 + 3 + 4 + 5) / 4)


@pytest.mark.parametrize(
    ("scores", "expected"),
    [
        ([7.0], 7.0),
        ([2.0, 4.0], 3.0),
        ([0.0, 10.0, 40.0], (0.25 * 0 + 10 + 0.25 * 40) / 1.5),
        ([0.0, 1.0, 2.0, 9.0, 100.0], (0.75 * 1 + 2 + 0.75 * 9) / 2.5),
    ],
)
def test_scores_that_the_quartile_cuts_count_in_part(scores, expected):
    assert iqm(np.array(scores)) == pytest.approx(expected)


def test_interquartile_mean_needs_a_score():
    with pytest.raises(ValueError, match="at least one"):
        iqm(np.array([]))


def test_interquartile_mean_works_on_many_resamples_at_once():
    rows = np.array([[4.0, 1, 2, 3], [10, 20, 30, 1000]])
    assert iqm(rows).tolist() == [2.5, 25.0]


def test_improvement_counts_pairs_and_half_of_the_ties():
    assert improvement(np.array([1.0, 3.0]), np.array([1.0, 2.0])) == pytest.approx((0.5 + 0 + 1 + 1) / 4)
    assert improvement(np.array([5.0, 6.0]), np.array([1.0, 2.0])) == 1.0


def test_bootstrap_interval_covers_the_truth_about_as_often_as_it_says():
    rng = np.random.default_rng(1)
    hits = 0
    for _ in range(100):
        low, high = stratified_bootstrap([rng.normal(3.0, 1.0, 40)], lambda drawn: drawn[0].mean(axis=-1), rng)
        hits += low <= 3.0 <= high
    assert 88 <= hits <= 99


def test_bootstrap_resamples_within_each_variant():
    # The difference of two constant variants has no spread: mixing them would give one.
    strata = [np.full(5, 10.0), np.full(5, 4.0)]
    low, high = stratified_bootstrap(
        strata, lambda drawn: drawn[0].mean(axis=-1) - drawn[1].mean(axis=-1), np.random.default_rng(0)
    )
    assert (low, high) == (6.0, 6.0)


def test_a_single_seed_has_no_interval():
    estimate = estimate_iqm([12.0])
    assert estimate.value == 12.0
    assert all(math.isnan(end) for end in estimate.interval)
    assert all(math.isnan(end) for end in estimate_improvement([1.0, 2.0], [3.0]).interval)


def test_bootstrap_refuses_a_variant_without_scores():
    with pytest.raises(ValueError, match="at least one score"):
        stratified_bootstrap([np.array([1.0]), np.array([])], lambda drawn: drawn[0], np.random.default_rng(0))


def test_same_scores_give_the_same_interval():
    assert estimate_iqm([1.0, 2.0, 5.0]) == estimate_iqm([1.0, 2.0, 5.0])


def test_interval_holds_the_value_and_lies_within_the_scores():
    estimate = estimate_iqm([1.0, 2.0, 5.0, 9.0])
    low, high = estimate.interval
    assert 1.0 <= low <= estimate.value <= high <= 9.0
    assert low < high
    assert estimate.num_seeds == 4


def test_area_weighs_an_episode_by_what_it_lasted():
    steps, values = np.array([10.0, 40.0, 50.0]), np.array([1.0, 2.0, 9.0])
    assert area_under_curve(steps, values, 0, 50) == pytest.approx((10 * 1 + 30 * 2 + 10 * 9) / 50)


def test_area_counts_every_episode_of_workers_that_ended_between_two_reports():
    steps, values = np.repeat([100.0, 200.0, 300.0], 3), np.tile([0.0, 15.0, 15.0], 3)
    assert area_under_curve(steps, values, 0, 300) == pytest.approx(10)


def test_area_of_unequal_runs_is_cut_to_the_range_given():
    short = area_under_curve(np.array([10.0, 20.0]), np.array([4.0, 6.0]), 5, 20)
    longer = area_under_curve(np.array([10.0, 20.0, 900.0]), np.array([4.0, 6.0, 1e6]), 5, 20)
    assert short == longer == pytest.approx((5 * 4 + 10 * 6) / 15)


def test_area_refuses_a_range_beyond_the_curve_or_empty():
    steps, values = np.array([10.0]), np.array([1.0])
    with pytest.raises(ValueError, match="cut to the shortest"):
        area_under_curve(steps, values, 0, 11)
    with pytest.raises(ValueError, match="range of steps"):
        area_under_curve(steps, values, 10, 10)


def test_mean_of_last_takes_what_there_is():
    assert mean_of_last(np.array([0.0, 2.0, 4.0]), 2) == 3.0
    assert mean_of_last(np.array([0.0, 2.0, 4.0]), 100) == 2.0
    with pytest.raises(ValueError, match="no episode"):
        mean_of_last(np.array([]), 100)


def test_held_curve_knows_nothing_of_what_comes():
    steps, values = np.array([10.0, 20.0, 30.0]), np.array([1.0, 3.0, 100.0])
    curve = held_curve(steps, values, np.array([5.0, 10.0, 19.0, 20.0, 29.9, 30.0, 31.0]), window=2)
    np.testing.assert_allclose(curve, [math.nan, 1, 1, 2, 2, 51.5, math.nan])


def test_band_has_no_value_where_a_seed_has_none():
    curves = np.array([[1.0, 1.0, 1.0], [3.0, 3.0, math.nan]])
    middle, low, high = curve_band(curves)
    np.testing.assert_allclose(middle, [2, 2, math.nan])
    np.testing.assert_allclose(low[:2], [1, 1])
    np.testing.assert_allclose(high[:2], [3, 3])
    assert math.isnan(low[2])


def test_band_of_one_seed_is_the_seed_without_interval():
    middle, low, high = curve_band(np.array([[1.0, 2.0]]))
    assert middle.tolist() == [1.0, 2.0]
    assert np.isnan(low).all()
    assert np.isnan(high).all()
