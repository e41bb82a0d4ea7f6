"""What the soak computes of a run's reports."""

import math

import pytest

from slotfilm_dist.chaos.soak import WINDOW_STEPS, worst_ratio_error


def reports(updates_per_step: list[float], steps: int = 1_000) -> list[dict[str, float]]:
    """A report every so many steps, with that many updates per step in between."""
    lines, updates = [{"env_steps": 0.0, "updates": 1.0}], 1.0
    for index, ratio in enumerate(updates_per_step, start=1):
        updates += ratio * steps
        lines.append({"env_steps": float(index * steps), "updates": updates})
    return lines


def test_constant_ratio_has_no_error() -> None:
    assert worst_ratio_error(reports([0.5] * 30), 0.5) == pytest.approx(0.0, abs=1e-12)


def test_stretch_without_updates_counts_in_the_windows_that_hold_it() -> None:
    lines = reports([0.5] * 15 + [0.0] + [0.5] * 15)
    assert worst_ratio_error(lines, 0.5) == pytest.approx(1_000 / WINDOW_STEPS)


def test_updates_made_up_for_within_a_window_are_no_error() -> None:
    lines = reports([0.5] * 15 + [0.0, 1.0] + [0.5] * 15, steps=10_000)
    assert worst_ratio_error(lines, 0.5) == pytest.approx(1.0)
    assert worst_ratio_error(reports([0.5, 0.0, 1.0, 0.5] * 10, steps=2_500), 0.5) == pytest.approx(0.0, abs=1e-12)


def test_too_short_a_run_has_no_figure() -> None:
    assert math.isnan(worst_ratio_error(reports([0.5] * 3), 0.5))
