"""What the soak computes of a run's counters."""

import math

import pytest

from slotfilm_dist.chaos.soak import WINDOW_STEPS, worst_ratio_error


def counted(updates_per_step: list[float], steps: int = 1_000) -> list[tuple[int, int]]:
    """Counts taken every so many steps, with that many updates per step in between."""
    pairs = [(0, 0)]
    for index, ratio in enumerate(updates_per_step, start=1):
        pairs.append((index * steps, pairs[-1][1] + int(ratio * steps)))
    return pairs


def test_constant_ratio_has_no_error() -> None:
    assert worst_ratio_error(counted([0.5] * 30), 0.5) == pytest.approx(0.0, abs=1e-12)


def test_stretch_without_updates_counts_in_the_windows_that_hold_it() -> None:
    pairs = counted([0.5] * 15 + [0.0] + [0.5] * 15)
    assert worst_ratio_error(pairs, 0.5) == pytest.approx(1_000 / WINDOW_STEPS)


def test_updates_made_up_for_within_a_window_are_no_error() -> None:
    pairs = counted([0.5] * 15 + [0.0, 1.0] + [0.5] * 15, steps=10_000)
    assert worst_ratio_error(pairs, 0.5) == pytest.approx(1.0)
    assert worst_ratio_error(counted([0.5, 0.0, 1.0, 0.5] * 10, steps=2_500), 0.5) == pytest.approx(0.0, abs=1e-12)


def test_too_short_a_run_has_no_figure() -> None:
    assert math.isnan(worst_ratio_error(counted([0.5] * 3), 0.5))
