"""Faults that are switched on from outside happen as often as asked, to one process."""

from pathlib import Path

from slotfilm_dist.chaos.switches import Switches


def test_fault_happens_as_often_as_it_was_armed(tmp_path: Path) -> None:
    outside, inside = Switches(tmp_path), Switches(tmp_path)
    assert inside.take("hang") is None
    outside.arm("hang", 2.5, count=2)
    outside.arm("hangover")
    assert not outside.taken("hang")
    assert [inside.take("hang") for _ in range(3)] == [2.5, 2.5, None]
    assert outside.taken("hang")
    assert inside.take("hangover") == 1.0


def test_lasting_fault_stays_with_the_process_that_met_it_until_it_is_disarmed(tmp_path: Path) -> None:
    outside, inside = Switches(tmp_path), Switches(tmp_path)
    outside.arm("slow", 10.0)
    assert [inside.lasting("slow") for _ in range(3)] == [10.0] * 3
    (claimed,) = tmp_path.iterdir()
    claimed.rename(tmp_path / "slow.0@1")  # another process has it now
    assert inside.lasting("slow") is None
    outside.disarm("slow")
    assert list(tmp_path.iterdir()) == []
