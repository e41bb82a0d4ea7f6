"""A plan follows from its names and one seed."""

import pytest

from slotfilm_dist.chaos.plan import FEWEST_STEPS, KINDS, MOST_STEPS, PLANS, FaultPlan


def test_same_seed_gives_the_same_plan_and_another_seed_another() -> None:
    first, again, other = (FaultPlan.draw(PLANS["long"], seed) for seed in (3, 3, 4))
    assert first == again
    assert [f.kind.name for f in first.faults] != [f.kind.name for f in other.faults]
    assert [f.rng().random() for f in first.faults] == [f.rng().random() for f in again.faults]
    assert len({f.seed for f in first.faults}) == len(first.faults)


def test_order_of_the_names_does_not_matter() -> None:
    names = PLANS["short"]
    assert FaultPlan.draw(names, 1) == FaultPlan.draw(names[::-1], 1)


def test_long_plan_has_every_fault_once_and_the_short_one_is_part_of_it() -> None:
    plan = FaultPlan.draw(PLANS["long"], 0)
    assert sorted(f.kind.name for f in plan.faults) == sorted(KINDS)
    assert set(PLANS["short"]) < set(KINDS)
    assert all(FEWEST_STEPS <= f.after_steps <= MOST_STEPS for f in plan.faults)


def test_scenes_share_out_the_plan_in_its_order() -> None:
    plan = FaultPlan.draw(PLANS["long"], 0)
    live = plan.of("live")
    assert len(live) + len(plan.of("driver")) + len(plan.of("files")) == len(plan.faults)
    assert [f for f in plan.faults if f in live] == list(live)


@pytest.mark.parametrize(
    ("names", "seed", "message"),
    [
        (["worker_kiled"], 0, r"'worker_kiled' is no fault; did you mean 'worker_killed'\?"),
        (["zzz"], 0, "'zzz' is no fault; known: worker_killed, "),
        (["diverged", "diverged"], 0, "a fault is named twice: diverged"),
        ([], 0, "no fault is named"),
        (["diverged"], -1, "seed = -1: must be 0 or more"),
    ],
)
def test_plan_that_makes_no_sense_is_refused(names: list[str], seed: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FaultPlan.draw(names, seed)


def test_every_row_of_a_live_run_that_a_plan_can_bring_about_is_there() -> None:
    rows = {int(n) for kind in KINDS.values() for n in kind.rows.split(", ")}
    assert rows >= {1, 2, 3, 4, 5, 6, 7, 8, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 21, 22, 23, 24, 26}
