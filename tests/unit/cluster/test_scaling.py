"""The controller of `--workers auto`, on balances made up by hand."""

from itertools import pairwise

from slotfilm_dist.cluster.scaling import Load, WorkerScaler


class Balance:
    """A run whose sides wait a fixed share of their time, or what a rate of each gives."""

    def __init__(self, scaler: WorkerScaler, workers: int, free_cpus: float = 8.0) -> None:
        self._scaler = scaler
        self.workers, self.free_cpus = workers, free_cpus
        self._at_s = self._learner_s = 0.0
        self._workers_s = dict.fromkeys(range(workers), 0.0)

    def window(self, *, learner: float, worker: float) -> int:
        """One window of waiting on each side; takes over and gives the number wanted."""
        self._look()
        self._at_s += 10.0
        self._learner_s += 10.0 * learner
        self._workers_s = {worker_id: s + 10.0 * worker for worker_id, s in self._workers_s.items()}
        wanted = self._look()
        if wanted != self.workers:
            self.free_cpus -= wanted - self.workers
            self.workers, self._workers_s = wanted, dict.fromkeys(range(wanted), 0.0)
        return wanted

    def settle(self, takes: float) -> list[int]:
        """Windows in which a worker gives 1 and the learner takes `takes`; gives the numbers until they stay."""
        seen = [self.workers]
        while len(seen) < 30:
            given = min(float(self.workers), takes)
            seen.append(self.window(learner=1 - given / takes, worker=1 - given / self.workers))
            if seen[-1] == seen[-2]:
                break
        return seen

    def _look(self) -> int:
        return self._scaler.wanted(
            Load(
                at_s=self._at_s,
                wanted_workers=self.workers,
                alive_workers=self.workers,
                free_cpus=self.free_cpus,
                learner_waited_s=self._learner_s,
                workers_waited_s=self._workers_s,
            )
        )


def load(at_s: float, *, wanted: int = 2, alive: int = 2, learner: float = 0.0, workers: float = 0.0) -> Load:
    return Load(
        at_s=at_s,
        wanted_workers=wanted,
        alive_workers=alive,
        free_cpus=8.0,
        learner_waited_s=learner,
        workers_waited_s=dict.fromkeys(range(alive), workers),
    )


def test_workers_are_added_until_the_learner_is_fed_and_then_stay() -> None:
    assert Balance(WorkerScaler(), 1).settle(takes=4.0) == [1, 2, 3, 4, 4]


def test_workers_that_wait_are_removed_and_a_reserve_stays() -> None:
    # 3 busy workers feed it; 3.3 with the reserve
    assert Balance(WorkerScaler(), 8).settle(takes=3.0) == [8, 4, 4]


def test_no_number_of_workers_is_left_for_another_and_taken_again() -> None:
    for tenths in range(5, 80):
        seen = Balance(WorkerScaler(), 4, free_cpus=16).settle(takes=tenths / 10)
        assert seen[-1] == seen[-2], seen
        rises = [b > a for a, b in pairwise(seen) if a != b]
        assert len(set(rises)) <= 1, seen


def test_nothing_is_added_without_a_free_core() -> None:
    assert Balance(WorkerScaler(), 2, free_cpus=0.5).settle(takes=8.0) == [2, 2]
    assert Balance(WorkerScaler(worker_cpus=0.5), 2, free_cpus=0.5).settle(takes=8.0) == [2, 3, 3]


def test_bounds_hold() -> None:
    assert Balance(WorkerScaler(max_workers=3), 2).settle(takes=8.0) == [2, 3, 3]
    assert Balance(WorkerScaler(min_workers=2), 4).settle(takes=0.1) == [4, 2, 2]
    assert Balance(WorkerScaler(), 4).settle(takes=0.1) == [4, 1, 1]


def test_learner_that_waits_a_little_gets_no_more_workers() -> None:
    assert Balance(WorkerScaler(), 2).window(learner=0.09, worker=0.0) == 2
    assert Balance(WorkerScaler(), 2).window(learner=0.12, worker=0.0) == 3


def test_nothing_changes_while_both_sides_wait_for_something_else() -> None:
    assert Balance(WorkerScaler(), 4).window(learner=0.5, worker=0.5) == 4


def test_nothing_is_decided_before_a_whole_window() -> None:
    scaler = WorkerScaler(window_s=10.0)
    assert [scaler.wanted(load(at_s, learner=at_s)) for at_s in (0.0, 5.0, 9.9)] == [2, 2, 2]
    assert scaler.wanted(load(10.0, learner=10.0)) == 3


def test_window_begins_anew_when_a_worker_is_missing_or_was_replaced() -> None:
    scaler = WorkerScaler()
    scaler.wanted(load(0.0, workers=5.0))
    assert scaler.wanted(load(10.0, learner=10.0, alive=1)) == 2  # one is being replaced
    assert scaler.wanted(load(20.0, learner=20.0, workers=5.0)) == 2  # it is back: the window begins here
    assert scaler.wanted(load(30.0, learner=30.0, workers=0.0)) == 2  # its count began anew: another one
    assert scaler.wanted(load(40.0, learner=40.0, workers=0.0)) == 3


def test_window_begins_anew_with_another_learner() -> None:
    scaler = WorkerScaler()
    scaler.wanted(load(0.0, learner=50.0))
    assert scaler.wanted(load(10.0, wanted=2, learner=0.0, workers=8.0)) == 2
    assert scaler.wanted(load(20.0, wanted=2, learner=9.0, workers=8.0)) == 3
