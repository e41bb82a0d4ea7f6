import math

import pytest

from slotfilm_dist.evaluation.study.collection import collect_study
from slotfilm_dist.evaluation.study.numbers import study_numbers


def by_variant(folder):
    return {n.variant: n for n in study_numbers(collect_study(folder))}


def test_numbers_are_at_scale_ten_and_without_the_random_policy(tmp_path, write_small_run):
    write_small_run(tmp_path, "slotfilm", 0, level=10.0)
    numbers = by_variant(tmp_path)["slotfilm"]
    # 24 episodes of the learning policy rise by 0.1 to 10: their mean is 8.85.
    assert numbers.last_return.value == pytest.approx(88.5)
    assert numbers.area.value == pytest.approx(88.5)
    assert numbers.runs[0].until == 1500


def test_reward_scale_of_a_variant_does_not_change_the_yardstick(tmp_path, write_small_run):
    write_small_run(tmp_path, "slotfilm", 0)
    write_small_run(tmp_path, "reward_scale_5", 0)
    numbers = by_variant(tmp_path)
    assert numbers["reward_scale_5"].last_return.value == numbers["slotfilm"].last_return.value


def test_improvement_is_over_the_proposed_agent_s_seeds(tmp_path, write_small_run):
    for seed, level in enumerate((10.0, 12.0)):
        write_small_run(tmp_path, "slotfilm", seed, level=level)
    for seed, level in enumerate((11.0, 13.0, 14.0)):
        write_small_run(tmp_path, "state_only", seed, level=level)
    numbers = by_variant(tmp_path)
    assert numbers["slotfilm"].over_proposed is None
    assert numbers["state_only"].over_proposed.value == pytest.approx(5 / 6)
    low, high = numbers["state_only"].over_proposed.interval
    assert low < 5 / 6 < high


def test_area_of_a_shorter_variant_is_compared_over_its_own_steps(tmp_path, write_small_run):
    write_small_run(tmp_path, "slotfilm", 0)
    write_small_run(tmp_path, "drqv2", 0)
    numbers = by_variant(tmp_path)
    assert numbers["slotfilm"].runs[0].until == 1500
    assert numbers["drqv2"].runs[0].until == 1050
    # Up to step 1000 drqv2 has reached its level already, and slotfilm is still a step of 0.1 an episode below.
    assert numbers["drqv2"].area_over_proposed.value == 1.0


def test_success_is_pooled_over_seeds_with_a_wilson_interval(tmp_path, write_small_run):
    write_small_run(tmp_path, "slotfilm", 0, num_solved=10)
    write_small_run(tmp_path, "slotfilm", 1, num_solved=6)
    numbers = by_variant(tmp_path)["slotfilm"]
    rate, low, high = numbers.success
    assert (numbers.num_solved, numbers.num_evaluated, rate) == (16, 20, 0.8)
    assert (low, high) == pytest.approx((0.5840, 0.9193), abs=1e-4)


def test_without_the_proposed_agent_there_is_no_improvement_but_all_else(tmp_path, write_small_run):
    write_small_run(tmp_path, "state_only", 0)
    numbers = by_variant(tmp_path)["state_only"]
    assert numbers.over_proposed is None
    assert math.isfinite(numbers.area.value)


def test_area_stops_where_the_proposed_agent_s_last_episode_ended(tmp_path, write_small_run):
    episodes = write_small_run(tmp_path, "slotfilm", 0) / "episodes.jsonl"
    episodes.write_text("".join(episodes.read_text().splitlines(keepends=True)[:-2]))
    write_small_run(tmp_path, "state_only", 0)
    numbers = by_variant(tmp_path)
    assert [numbers[name].runs[0].until for name in ("slotfilm", "state_only")] == [1400, 1400]
