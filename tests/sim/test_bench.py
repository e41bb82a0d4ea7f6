"""A row of the bench that needs the simulator, with next to no work: that it can be measured, not what it says."""

import pytest

from slotfilm_dist.bench.results import BenchOptions
from slotfilm_dist.bench.suite import run_subject

pytestmark = pytest.mark.sim


def test_environment_step_is_compared_with_stock_maniskill() -> None:
    (row,) = run_subject("env", BenchOptions(rounds=1, quick=True))
    assert row.measured is not None, row.how
    assert row.measured > 0
    assert row.goal == 2.0
    assert "PickCube-v1" in row.how
