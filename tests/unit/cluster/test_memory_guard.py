"""Which worker stands still, when, and for how long."""

from collections.abc import Mapping

from slotfilm_dist.cluster.memory_guard import FIRST_HOLD_S, LONGEST_HOLD_S, PATIENCE_S, MemoryGuard


class Workers:
    """A guard, and the shares of memory that workers report to it."""

    def __init__(self, max_share: float = 0.9) -> None:
        self.now_s = 0.0
        self.guard = MemoryGuard(max_share, lambda: self.now_s)

    def pick(self, shares: Mapping[int, float], after_s: float = 0.0) -> int | None:
        self.now_s += after_s
        return self.guard.pick(shares)

    def pick_in_time(self, shares: Mapping[int, float]) -> int | None:
        """When the machine has been short of memory for long enough."""
        assert self.pick(shares) is None
        return self.pick(shares, PATIENCE_S)

    def may_run(self, worker_id: int, share: float = 0.5) -> bool:
        """While another worker reports that share."""
        return self.guard.may_run(worker_id, {9: share})


def test_nobody_stands_still_while_there_is_room() -> None:
    workers = Workers()
    assert workers.pick_in_time({0: 0.9, 1: 0.9}) is None
    assert workers.may_run(1, share=0.99)


def test_newest_worker_of_the_machine_without_room_stands_still() -> None:
    workers = Workers()
    assert workers.pick_in_time({0: 0.95, 1: 0.95, 2: 0.5}) == 1
    assert workers.guard.hold(1) == FIRST_HOLD_S
    assert [workers.may_run(worker_id) for worker_id in range(3)] == [True, False, True]


def test_next_one_follows_only_if_it_did_not_help() -> None:
    workers = Workers()
    assert workers.pick_in_time({0: 0.95, 1: 0.95, 2: 0.95}) == 2
    workers.guard.look_again()
    assert workers.pick({0: 0.95, 1: 0.95}, PATIENCE_S) is None
    assert workers.pick({0: 0.95, 1: 0.95}, PATIENCE_S / 2) is None
    assert workers.pick({0: 0.95, 1: 0.95}, PATIENCE_S / 2) == 1


def test_moment_without_room_is_passed_over() -> None:
    workers = Workers()
    assert workers.pick({0: 0.95, 1: 0.95}) is None
    assert workers.pick({0: 0.85, 1: 0.85}, PATIENCE_S / 2) is None
    assert workers.pick({0: 0.95, 1: 0.95}, PATIENCE_S / 2) is None


def test_last_worker_of_a_run_goes_on() -> None:
    assert Workers().pick_in_time({0: 0.99}) is None


def test_worker_comes_back_when_its_time_is_over_and_there_is_room() -> None:
    workers = Workers()
    workers.guard.hold(1)
    workers.now_s += FIRST_HOLD_S - 0.1
    assert not workers.may_run(1, share=0.5)
    workers.now_s += 0.1
    assert not workers.may_run(1, share=0.95)
    assert workers.may_run(1, share=0.5)
    assert workers.guard.may_run(1, {0: 0.95, 2: 0.5}), "another machine has room"
    assert workers.guard.may_run(1, {}), "nobody says that there is none"


def test_worker_stands_still_twice_as_long_each_time_until_it_has_run_for_as_long() -> None:
    workers, held = Workers(), []
    for _ in range(8):
        held.append(workers.guard.hold(1))
        workers.now_s += held[-1] + 1.0
    assert held == [min(LONGEST_HOLD_S, FIRST_HOLD_S * 2**i) for i in range(8)]
    assert held[-1] == LONGEST_HOLD_S
    workers.now_s += LONGEST_HOLD_S
    assert workers.guard.hold(1) == FIRST_HOLD_S
    assert workers.guard.hold(2) == FIRST_HOLD_S


def test_share_of_one_stops_nobody() -> None:
    assert Workers(max_share=1.0).pick_in_time({0: 1.0, 1: 1.0}) is None
