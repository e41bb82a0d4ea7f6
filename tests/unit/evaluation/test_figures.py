"""The axis of episodes above a run's return."""

import numpy as np
import pytest

from slotfilm_dist.evaluation.figures import episode_counts


def test_axis_of_episodes_goes_through_each_of_them() -> None:
    # Two short random episodes, then two long ones; the random data of another run leave a gap before the first.
    for steps in ([50.0, 100, 500, 900], [20_400.0, 20_800, 21_200, 21_600]):
        number_at, steps_at = episode_counts(np.array(steps))
        assert number_at(np.array(steps)).tolist() == [1, 2, 3, 4]
        assert steps_at(np.array([1.0, 2, 3, 4])).tolist() == steps


def test_episodes_of_several_workers_that_ended_together_count_each() -> None:
    number_at, _ = episode_counts(np.array([100.0, 100, 100, 200, 200, 200]))
    assert number_at(np.array([0.0, 100, 150, 200])).tolist() == [0, 3, 4.5, 6]


def test_axis_of_episodes_leads_back_to_the_same_step_also_beyond_the_last() -> None:
    number_at, steps_at = episode_counts(np.array([50.0, 100, 500, 900]))
    steps = np.linspace(-100, 2000, 50)
    assert steps_at(number_at(steps)) == pytest.approx(steps)
    assert number_at(1125.0) == pytest.approx(5)


def test_episode_at_step_zero_is_counted() -> None:
    number_at, _ = episode_counts(np.array([0.0, 100.0]))
    assert number_at(100.0) == pytest.approx(2)
