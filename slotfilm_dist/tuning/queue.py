"""The order of a grid's jobs for Ray Tune: an artifact before the trials that need it, and nothing after a stop."""

from collections.abc import Callable, Sequence, Set
from typing import Any

from ray.tune import Trainable
from ray.tune.experiment import Trial
from ray.tune.schedulers import AsyncHyperBandScheduler, FIFOScheduler, TrialScheduler
from ray.tune.search import Searcher

from slotfilm_dist.config_files import config_hash
from slotfilm_dist.tuning.jobs import Job
from slotfilm_dist.tuning.work import Orders, Work

REPORT_S = 2.0
"""Seconds between a job's reports."""
CLEANUP_S = 300.0
"""Longest wait for a job that Tune ends to write its checkpoint."""
ASHA_REDUCTION = 3
"""One trial in so many goes on at each comparison."""


class JobTrainable(Trainable):
    """A job in the process that Tune gives it; its config is the job's key, everything else is in the orders."""

    def setup(self, config: dict[str, Any], orders: Orders) -> None:  # type: ignore[override]  # tune.with_parameters
        """Begin the work."""
        self._work = Work(orders.jobs[config["key"]], orders)
        self._work.start()

    def step(self) -> dict[str, Any]:
        """How far it is, every few seconds; raises what it failed with."""
        ended = self._work.wait(REPORT_S)
        return self._work.standing() | {"done": ended}

    def save_checkpoint(self, checkpoint_dir: str) -> None:
        """Nothing: the run writes its own checkpoints."""

    def load_checkpoint(self, checkpoint: Any) -> None:
        """Nothing: the run goes on from its own checkpoints."""

    def cleanup(self) -> None:
        """Tune wants the process back: ASHA has ended the trial, the driver stops, or it has failed."""
        self._work.end()
        self._work.wait(CLEANUP_S)


class JobQueue(Searcher):
    """Hands out jobs in their order, each when what it needs is there; a failed artifact takes its trials along.

    Args:
        jobs: those to do, each after what it needs.
        there: keys of artifacts that exist.
        stop: no job is handed out after it.
        give_up: told of a job that cannot begin, and why.
        homeless: keys of jobs that no node of the cluster has room for as it is. They are handed out one at a time, for
            a cluster that grows by what waits: more of them would block those that fit.
    """

    def __init__(
        self,
        jobs: Sequence[Job],
        there: set[str],
        stop: Callable[[], bool],
        give_up: Callable[[Job, str], None],
        homeless: Set[str] = frozenset(),
    ) -> None:
        super().__init__()
        self._homeless = homeless
        self._waiting = list(jobs)
        self._there = set(there)
        self._lost: set[str] = set()
        self._given: dict[str, Job] = {}
        self._stop, self._give_up = stop, give_up

    def suggest(self, trial_id: str) -> Any:
        """The next job that can begin as a config; None while all have to wait, `Searcher.FINISHED` after the last."""
        if self._stop():
            return Searcher.FINISHED
        for job in list(self._waiting):
            if missing := [key for key in job.needs if key in self._lost]:
                self._waiting.remove(job)
                self._lost.add(job.key)
                self._give_up(job, f"{missing[0]} could not be made")
            elif self._there.issuperset(job.needs) and not self._is_one_too_many(job):
                self._waiting.remove(job)
                self._given[trial_id] = job
                return {"key": job.key}
        return None if self._waiting else Searcher.FINISHED

    def _is_one_too_many(self, job: Job) -> bool:
        return job.key in self._homeless and any(given.key in self._homeless for given in self._given.values())

    def on_trial_complete(self, trial_id: str, result: dict[str, Any] | None = None, error: bool = False) -> None:
        """A job has ended."""
        job = self._given.pop(trial_id, None)
        if job is not None:
            (self._lost if error else self._there).add(job.key)

    def set_search_properties(self, metric: str | None, mode: str | None, config: dict[str, Any], **spec: Any) -> bool:
        """There is nothing to search for."""
        return True

    def save(self, checkpoint_path: str) -> None:
        """Nothing: the ledger knows what is done."""

    def restore(self, checkpoint_path: str) -> None:
        """Nothing: a grid begins anew from its ledger."""


class HalvingByReward(FIFOScheduler):
    """ASHA on the return of training episodes, among trials that are paid alike and for as long.

    Returns of different rewards say nothing about each other, so each reward has a halving of its own. A comparison
    knows the trials of this start of the grid only.

    Args:
        jobs: by key.
        mark: told of a trial that is ended.
    """

    def __init__(self, jobs: dict[str, Job], mark: Callable[[str], None]) -> None:
        super().__init__()
        self._jobs, self._mark = jobs, mark
        self._halvings: dict[str, AsyncHyperBandScheduler] = {}

    def on_trial_add(self, tune_controller: Any, trial: Trial) -> None:
        """A trial joins those of its reward."""
        if halving := self._halving(trial):
            halving.on_trial_add(tune_controller, trial)

    def on_trial_result(self, tune_controller: Any, trial: Trial, result: dict[str, Any]) -> str:
        """Whether a trial goes on."""
        halving = self._halving(trial)
        decision = halving.on_trial_result(tune_controller, trial, result) if halving else TrialScheduler.CONTINUE
        if decision == TrialScheduler.STOP:
            self._mark(trial.config["key"])
        return decision

    def on_trial_complete(self, tune_controller: Any, trial: Trial, result: dict[str, Any]) -> None:
        """A trial has ended; its last result stays in the comparison."""
        if halving := self._halving(trial):
            halving.on_trial_complete(tune_controller, trial, result)

    def on_trial_remove(self, tune_controller: Any, trial: Trial) -> None:
        """A trial was ended before it began."""
        if halving := self._halving(trial):
            halving.on_trial_remove(tune_controller, trial)

    def _halving(self, trial: Trial) -> AsyncHyperBandScheduler | None:
        job = self._jobs[trial.config["key"]]
        if job.kind != "trial":
            return None
        config, schedule = job.config, job.config.schedule
        name = config_hash(config.reward, config.success, schedule.total_steps, schedule.random_steps)
        if name not in self._halvings:
            learning = schedule.total_steps - schedule.random_steps
            self._halvings[name] = AsyncHyperBandScheduler(
                time_attr="env_steps",
                metric="episode_return",
                mode="max",
                grace_period=max(1, schedule.random_steps + learning // ASHA_REDUCTION**2),
                max_t=schedule.total_steps,
                reduction_factor=ASHA_REDUCTION,
                stop_last_trials=False,
            )
        return self._halvings[name]
