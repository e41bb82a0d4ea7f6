"""How many workers a run needs so that the learner neither starves nor is waited for. Plain, without Ray or clocks."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

WINDOW_S = 10.0
"""Time over which both sides' waiting is measured before the number of workers may change."""
STARVING_SHARE = 0.1
"""Share of its time that the learner must wait before workers are added."""
RESERVE = 1.1
"""Workers are removed only while those that stay could collect so many times what the learner takes."""
LARGEST_STEP = 1.5
"""The number of workers grows at most by this factor at once, for what is measured changes with it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Load:
    """What a run knows of its balance at one instant."""

    at_s: float
    """Seconds that only grow."""
    wanted_workers: int
    """Workers asked for."""
    alive_workers: int
    """Workers that run."""
    free_cpus: float
    """Cores in the cluster that nobody has asked for."""
    learner_waited_s: float
    """Time that the learner has waited for something to learn from, summed."""
    workers_waited_s: Mapping[int, float]
    """Time that each worker has waited until its blocks were taken, summed, by worker."""


class WorkerScaler:
    """Decides how many workers a run should have. A busy worker gives what it gives and a busy learner takes what it
    takes, so with both sides' shares of waiting over a window, w and l, the learner is just fed by

        needed = workers (1 - w) / (1 - l).

    Workers are added where the learner starves and cores are free, and removed where fewer would still feed it with a
    reserve. Just after adding, `needed` is above workers - 1, so nothing is removed again: the two conditions never
    hold together. A window begins anew whenever the workers are not those that it began with.

    Args:
        min_workers: never fewer.
        max_workers: never more; 0 for as many as the cluster has cores.
        worker_cpus: cores that another worker takes.
        window_s: time over which waiting is measured.
    """

    def __init__(
        self, *, min_workers: int = 1, max_workers: int = 0, worker_cpus: float = 1.0, window_s: float = WINDOW_S
    ) -> None:
        self._min_workers, self._max_workers = min_workers, max_workers or math.inf
        self._worker_cpus, self._window_s = worker_cpus, window_s
        self._began: Load | None = None

    def wanted(self, load: Load) -> int:
        """Workers that the run should have: more, fewer, or as many as it has asked for."""
        began = self._began
        if began is None or not _comparable(began, load):
            self._began = load
            return load.wanted_workers
        elapsed_s = load.at_s - began.at_s
        if elapsed_s < self._window_s:
            return load.wanted_workers
        self._began = load
        learner = _share((load.learner_waited_s - began.learner_waited_s) / elapsed_s)
        waited_s = sum(load.workers_waited_s.values()) - sum(began.workers_waited_s.values())
        workers = _share(waited_s / (elapsed_s * load.alive_workers))
        wanted = self._balance(load, learner, workers)
        return int(max(self._min_workers, min(self._max_workers, wanted)))

    def _balance(self, load: Load, learner_share: float, workers_share: float) -> int:
        count = load.alive_workers
        needed = count * (1 - workers_share) / max(1e-3, 1 - learner_share)
        if learner_share > STARVING_SHARE and needed > count:
            room = int(load.free_cpus / self._worker_cpus + 1e-9)
            return count + min(room, math.ceil(min(needed, count * LARGEST_STEP)) - count)
        if learner_share <= STARVING_SHARE and needed * RESERVE <= count - 1:
            return max(1, math.ceil(needed * RESERVE))
        return count


def _comparable(began: Load, load: Load) -> bool:
    """The same learner and the same workers, all of them running: no time of waiting began anew in between."""
    steady = began.wanted_workers == began.alive_workers == load.wanted_workers == load.alive_workers > 0
    before, after = began.workers_waited_s, load.workers_waited_s
    same = before.keys() == after.keys() and all(after[worker] >= waited for worker, waited in before.items())
    return steady and same and load.learner_waited_s >= began.learner_waited_s


def _share(value: float) -> float:
    return min(1.0, max(0.0, value))
