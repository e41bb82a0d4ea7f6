"""Which workers are replaced, settled, set to work again, and which stand still."""

from dataclasses import replace

import pytest

from slotfilm_dist.backend import RunFailedError
from slotfilm_dist.cluster.failures import RoleLostError
from slotfilm_dist.cluster.memory_guard import FIRST_HOLD_S, LONGEST_HOLD_S
from slotfilm_dist.cluster.messages import WorkerBeat
from slotfilm_dist.cluster.system import FAILURE_WINDOW_S, MAX_FAILURES, START_LIMIT_S, Supervisor


class Handle:
    """A worker that says what it is told to."""

    silent_s = 0.0
    killed = 0

    def __init__(self, worker_id: int) -> None:
        self.worker_id = worker_id
        self.beat: WorkerBeat | None = None
        self.lost: RoleLostError | None = None

    def poll(self) -> WorkerBeat | None:
        if self.lost is not None:
            raise self.lost
        return self.beat

    def begin_stop(self, timeout_s: float) -> object:
        return None

    def stopped(self, request: object, timeout_s: float) -> bool:
        return True

    def kill(self) -> None:
        self.killed += 1


def working(worker_id: int, incarnation: int, memory_share: float = 0.0) -> WorkerBeat:
    """A beat of a worker with which all is well."""
    return WorkerBeat(
        worker_id=worker_id,
        incarnation=incarnation,
        activity="stepping",
        limit_s=30.0,
        idle_s=0.0,
        num_steps=0,
        num_blocks=1,
        policy_version=0,
        waited_s=0.0,
        step_s=0.0,
        memory_share=memory_share,
        running=True,
    )


class Crew:
    """A supervisor of one worker, and what it did to it."""

    def __init__(self, steps_taken_back: int) -> None:
        self.handle = Handle(0)
        self.employed: list[int] = []
        self.settled: list[int] = []
        self._steps_taken_back = steps_taken_back
        self.supervisor = Supervisor(lambda _: self.handle, self._employ, self._settle)
        self.supervisor.scale(1)

    def _employ(self, handle: object, incarnation: int) -> None:
        self.employed.append(incarnation)
        self.handle.beat = working(0, incarnation)

    def _settle(self, worker_id: int, incarnation: int) -> int:
        self.settled.append(incarnation)
        return self._steps_taken_back if len(self.settled) == 1 else 0

    def end(self) -> None:
        """The worker comes to its end."""
        assert self.handle.beat is not None
        self.handle.beat = replace(self.handle.beat, running=False, ended=True)


def test_worker_that_is_done_is_settled_once_and_left_alone() -> None:
    crew = Crew(steps_taken_back=0)
    crew.supervisor.tick()
    assert crew.settled == []
    crew.end()
    for _ in range(3):
        crew.supervisor.tick()
    assert crew.settled == [0]
    assert crew.employed == [0]


def test_worker_whose_last_blocks_were_lost_is_set_to_work_again_for_them() -> None:
    crew = Crew(steps_taken_back=16)
    crew.supervisor.tick()
    crew.end()
    crew.supervisor.tick()
    assert (crew.settled, crew.employed) == ([0], [0, 1])
    crew.supervisor.tick()
    crew.end()
    crew.supervisor.tick()
    assert (crew.settled, crew.employed) == ([0, 1], [0, 1])
    assert not crew.supervisor.restarts


class Clock:
    """Seconds that pass when told to."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_worker_without_progress_or_answer_within_its_own_limit_is_replaced(caplog: pytest.LogCaptureFixture) -> None:
    crew = Crew(steps_taken_back=0)
    crew.supervisor.tick()
    assert crew.handle.beat is not None
    crew.handle.beat = replace(crew.handle.beat, idle_s=30.5)
    crew.supervisor.tick()
    assert (crew.supervisor.restarts["hang"], crew.handle.killed, crew.employed) == (1, 1, [0, 1])
    assert "worker 0 is replaced (hang): no progress for 30 s while stepping" in caplog.text
    crew.handle.silent_s = 31.0
    crew.supervisor.tick()
    assert (crew.supervisor.restarts["hang"], crew.handle.killed, crew.employed) == (2, 2, [0, 1, 2])
    assert "no answer for 31 s" in caplog.text
    crew.handle.silent_s = 30.0
    crew.supervisor.tick()
    assert crew.handle.killed == 2


def test_worker_that_never_answers_is_replaced_and_given_up_after_five_times() -> None:
    clock, handle = Clock(), Handle(0)
    supervisor = Supervisor(lambda _: handle, lambda worker, incarnation: None, lambda *_: 0, clock=clock)
    supervisor.scale(1)
    for failures in range(1, MAX_FAILURES):
        clock.now += START_LIMIT_S - 1
        supervisor.tick()
        clock.now += 2
        supervisor.tick()
        assert supervisor.restarts["hang"] == failures
    clock.now += START_LIMIT_S + 1
    with pytest.raises(RunFailedError, match=r"worker 0 failed 5 times .* `slotfilm doctor` checks"):
        supervisor.tick()


def test_failures_long_ago_or_before_a_collected_block_do_not_count() -> None:
    crew = Crew(steps_taken_back=0)
    for _ in range(2 * MAX_FAILURES):  # each incarnation has collected a block
        assert crew.handle.beat is not None
        crew.handle.beat = replace(crew.handle.beat, error="broken")
        crew.supervisor.tick()
    assert crew.supervisor.restarts["crash"] >= MAX_FAILURES
    clock, handle = Clock(), Handle(0)
    supervisor = Supervisor(lambda _: handle, lambda worker, incarnation: None, lambda *_: 0, clock=clock)
    supervisor.scale(1)
    for _ in range(2 * MAX_FAILURES):
        clock.now += FAILURE_WINDOW_S / 2
        supervisor.tick()
    assert supervisor.restarts["hang"] == 2 * MAX_FAILURES


class Machine:
    """A supervisor of workers on one machine, whose memory is in use to some share."""

    def __init__(self) -> None:
        self.clock, self.share = Clock(), 0.5
        self.handles: dict[int, Handle] = {}
        self.employed: list[tuple[int, int]] = []
        self.settled: list[tuple[int, int]] = []
        self.lost_steps, self.num_blocks = 0, 1
        self.supervisor = Supervisor(
            self._launch,
            self._employ,
            self._settle,
            max_memory_share=0.9,
            clock=self.clock,
            memory_share=lambda: self.share,
        )

    def run(self, num_workers: int, seconds: float = 0.0) -> int:
        """Look after so many workers for some time; gives how many run then."""
        until = self.clock.now + seconds
        while True:
            for handle in self.handles.values():
                if handle.beat is not None:
                    handle.beat = replace(handle.beat, memory_share=self.share)
            self.supervisor.tick()
            self.supervisor.scale(num_workers)
            if self.clock.now >= until:
                return self.supervisor.num_alive
            self.clock.now += 0.25

    def _launch(self, worker_id: int) -> Handle:
        self.handles[worker_id] = Handle(worker_id)
        return self.handles[worker_id]

    def _employ(self, handle: object, incarnation: int) -> None:
        assert isinstance(handle, Handle)
        self.employed.append((handle.worker_id, incarnation))
        handle.beat = replace(working(handle.worker_id, incarnation, self.share), num_blocks=self.num_blocks)

    def _settle(self, worker_id: int, incarnation: int) -> int:
        self.settled.append((worker_id, incarnation))
        return self.lost_steps


@pytest.fixture
def machine() -> Machine:
    made = Machine()
    made.run(2)
    assert made.run(2) == 2
    return made


def test_worker_of_a_machine_short_of_memory_stands_still_and_comes_back(
    machine: Machine, caplog: pytest.LogCaptureFixture
) -> None:
    machine.share = 0.95
    assert machine.run(2, FIRST_HOLD_S + 5) == 1
    assert (machine.settled, dict(machine.supervisor.restarts)) == ([(1, 1)], {"memory": 1})
    assert machine.supervisor.num_held == 1
    assert "worker 1 stands still for 60 s: 95 % of its machine's memory are in use" in caplog.text
    machine.share = 0.5
    assert machine.run(2, 1.0) == 2
    assert machine.employed == [(0, 0), (1, 1), (1, 2)]
    assert machine.supervisor.num_held == 0


def test_worker_that_the_system_ended_for_its_memory_stands_still_and_is_no_failure(machine: Machine) -> None:
    machine.share = 0.97
    machine.run(2, 0.5)
    for _ in range(2 * MAX_FAILURES):
        for handle in machine.handles.values():
            handle.lost = RoleLostError("worker", "crash", "killed")
        machine.run(2, 20.0)
    assert dict(machine.supervisor.restarts).keys() == {"memory"}
    machine.share = 0.5
    assert machine.run(2, LONGEST_HOLD_S) == 2


def test_error_that_a_worker_tells_is_no_lack_of_memory_however_full_its_machine_is(machine: Machine) -> None:
    machine.share, machine.num_blocks = 0.97, 0

    def fail_again_and_again() -> None:
        for _ in range(3 * MAX_FAILURES):
            for handle in machine.handles.values():
                if handle.beat is not None:
                    handle.beat = replace(handle.beat, num_blocks=0, running=False, error="no Vulkan driver")
            machine.run(2, 1.0)

    with pytest.raises(RunFailedError, match="no Vulkan driver"):
        fail_again_and_again()


def test_only_worker_that_the_system_ends_again_and_again_before_it_collects_ends_the_run(machine: Machine) -> None:
    machine.share, machine.num_blocks = 0.97, 0
    machine.run(1, 0.5)

    def lose_again_and_again() -> None:
        for _ in range(3 * MAX_FAILURES):
            for handle in machine.handles.values():
                handle.beat, handle.lost = None, RoleLostError("worker", "crash", "killed")
            machine.run(1, 1.0)

    with pytest.raises(RunFailedError, match="killed"):
        lose_again_and_again()


def test_one_can_do_without_held_workers_only_where_none_of_a_higher_number_runs(machine: Machine) -> None:
    assert machine.run(4) in (2, 4)
    assert machine.run(4) == 4
    machine.share = 0.97
    machine.run(4, 1.5)
    assert (machine.supervisor.num_held, machine.supervisor.num_surplus) == (1, 1)
    machine.handles[0].lost = RoleLostError("worker", "crash", "killed")
    machine.run(4)
    assert (machine.supervisor.num_held, machine.supervisor.num_surplus) == (2, 1)


def test_crash_with_room_is_a_failure(machine: Machine) -> None:
    machine.handles[1].lost = RoleLostError("worker", "crash", "killed")
    machine.run(2)
    assert dict(machine.supervisor.restarts) == {"crash": 1}


def test_only_worker_that_is_wanted_runs_though_it_should_stand_still(machine: Machine) -> None:
    machine.share = 0.97
    machine.run(2, 0.5)
    machine.handles[0].lost = RoleLostError("worker", "crash", "killed")
    assert machine.run(2, 2.0) == 1
    assert machine.supervisor.num_held == 1
    machine.run(1)
    assert machine.run(1, 2.0) == 1
    assert machine.employed[-1][0] == 0


def test_steps_that_a_dismissed_worker_has_lost_are_collected_by_one_that_was_done(machine: Machine) -> None:
    machine.handles[0].beat = replace(working(0, 0), running=False, ended=True)
    machine.supervisor.tick()
    machine.lost_steps = 16
    machine.supervisor.scale(1)
    assert machine.employed == [(0, 0), (1, 1), (0, 2)]
