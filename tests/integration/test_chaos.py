"""The short plan of `slotfilm chaos`, on a real run: minutes."""

from pathlib import Path

import pytest

from slotfilm_dist.chaos.outcome import as_text
from slotfilm_dist.chaos.plan import PLANS, FaultPlan
from slotfilm_dist.chaos.runner import carry_out


@pytest.mark.slow
def test_faults_of_the_short_plan_have_the_expected_effect(tmp_path: Path) -> None:
    plan = FaultPlan.draw(PLANS["short"], 0)
    outcomes = list(carry_out(plan, tmp_path / "plan", "toy"))
    print(as_text(outcomes))
    assert [outcome.fault for outcome in outcomes if not outcome.holds] == []
    assert len(outcomes) == len(plan.faults)
