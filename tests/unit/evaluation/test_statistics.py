import numpy as np
import pytest

from slotfilm_dist.evaluation.statistics import (
    bootstrap_mean_interval,
    causal_mean,
    not_superseded,
    paired_difference,
    wilson_interval,
)


def test_wilson_interval_of_46_of_50_is_81_2_to_96_8_percent():
    low, high = wilson_interval(46, 50)
    assert (round(100 * low, 1), round(100 * high, 1)) == (81.2, 96.8)


def test_wilson_interval_stays_inside_0_and_1_and_is_not_a_point():
    assert wilson_interval(0, 10) == pytest.approx((0.0, 0.2775), abs=1e-4)
    assert wilson_interval(10, 10) == pytest.approx((0.7225, 1.0), abs=1e-4)
    assert wilson_interval(0, 0) == (0.0, 1.0)


@pytest.mark.parametrize(("successes", "trials"), [(-1, 5), (6, 5)])
def test_impossible_counts_are_refused(successes, trials):
    with pytest.raises(ValueError, match="successes"):
        wilson_interval(successes, trials)


def test_bootstrap_interval_agrees_with_the_normal_one_on_normal_samples():
    values = np.random.default_rng(1).normal(3.0, 2.0, 400)
    low, high = bootstrap_mean_interval(values, np.random.default_rng(2))
    half = 1.96 * values.std(ddof=1) / 20
    assert low == pytest.approx(values.mean() - half, abs=0.03)
    assert high == pytest.approx(values.mean() + half, abs=0.03)


def test_bootstrap_of_nothing_is_refused():
    with pytest.raises(ValueError, match="at least one sample"):
        bootstrap_mean_interval(np.zeros(0), np.random.default_rng(0))


def test_paired_difference_uses_common_seeds_only_and_cancels_their_luck():
    ours = {seed: 1000.0 * seed + 5.0 for seed in range(20)} | {99: -1e6}
    theirs = {seed: 1000.0 * seed for seed in range(20)}
    difference = paired_difference(ours, theirs, np.random.default_rng(0))
    assert (difference.mean, difference.interval) == (5.0, (5.0, 5.0))
    assert (difference.num_pairs, difference.num_better) == (20, 20)


def test_paired_difference_without_common_seed_is_refused():
    with pytest.raises(ValueError, match="no seed in common"):
        paired_difference({1: 0.0}, {2: 0.0}, np.random.default_rng(0))


def test_causal_mean_averages_the_past_only():
    values = np.array([0.0, 0.0, 3.0, 6.0, 0.0])
    assert causal_mean(values, 3).tolist() == [0.0, 0.0, 1.0, 3.0, 3.0]
    assert causal_mean(values, 1).tolist() == values.tolist()
    assert causal_mean(np.zeros(0), 3).tolist() == []


def test_points_that_a_resumed_run_repeats_are_dropped():
    steps = np.array([10.0, 20, 30, 40, 20, 25, 30, 30, 50])
    assert steps[not_superseded(steps)].tolist() == [10, 20, 20, 25, 30, 30, 50]
    assert not_superseded(np.zeros(0)).tolist() == []
