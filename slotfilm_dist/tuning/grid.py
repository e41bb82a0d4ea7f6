"""Runs a grid: Ray Tune starts, retries and ends the jobs, the ledger says what is left of them.

    loop     consumes              produces                   waits for                stops
    driver   Tune's events,        trials' processes,         an event, a tenth of     all jobs are over, or a signal
             signals               the stop file, the table   a second at most         and no job runs any more
    work     the stop file         run, ledger record         its backend              done, failed, or stop file

The driver asks for an end with a file in the grid's directory, which every job looks for: a job that is behind on a
heavy machine gets as long as it needs for its checkpoint, and nothing depends on how Tune ends processes.
"""

import contextlib
import logging
import os
import shutil
import time
from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ray import tune
from ray.exceptions import RayActorError, RayTaskError
from ray.tune.experiment import Trial

from slotfilm_dist.tuning.board import Board
from slotfilm_dist.tuning.jobs import Job
from slotfilm_dist.tuning.ledger import Ledger
from slotfilm_dist.tuning.queue import HalvingByReward, JobQueue, JobTrainable
from slotfilm_dist.tuning.work import STOP_FILE, Orders, one_line

STOP_LIMIT_S = 1800.0
"""Longest wait for the jobs' checkpoints after a signal; a second signal ends everything at once."""
MAX_PENDING = 8
"""Jobs that Tune asks the cluster to place at the same time."""
TUNE_FOLDER = "tune"
"""Tune's own notes in the grid's directory; nothing is read from them."""
TUNE_SETTINGS = {
    "TUNE_DISABLE_SIGINT_HANDLER": "1",  # signals are the driver's
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",  # every run writes its own metrics
    "TUNE_MAX_PENDING_TRIALS_PG": str(MAX_PENDING),
    "RAY_CHDIR_TO_TRIAL_DIR": "0",
    "RAY_AIR_NEW_OUTPUT": "0",
}


@dataclass(frozen=True, kw_only=True, slots=True)
class GridLimits:
    """How a grid uses the cluster and its patience."""

    num_retries: int = 2
    """Further attempts of a job that failed."""
    max_concurrent: int = 0
    """Most jobs at the same time; 0 is as many as fit."""
    asha: bool = False
    """End trials early that lag behind those of the same reward."""


def jobs_to_do(jobs: Sequence[Job], ledger: Ledger, artifacts: Path) -> list[Job]:
    """What is left: trials that are not over, and the artifacts that they need and that are not there."""
    trials = [job for job in jobs if job.kind == "trial" and ledger.read(job).state not in ("done", "pruned")]
    wanted = {key for trial in trials for key in trial.needs}
    made = [job for job in jobs if job.kind != "trial" and job.key in wanted and not job.artifact_is_there(artifacts)]
    # An encoder is made from data that its trials may find gone.
    wanted |= {key for job in made for key in job.needs}
    made = [job for job in jobs if job.kind != "trial" and job.key in wanted and not job.artifact_is_there(artifacts)]
    return [*made, *trials]


def run_grid(
    todo: Sequence[Job],
    orders: Orders,
    limits: GridLimits,
    board: Board,
    stop: Callable[[], bool],
    homeless: Set[str] = frozenset(),
) -> None:
    """Do these jobs on the Ray cluster that this process is connected to; the ledger and the board tell the outcome.

    Args:
        todo: of `jobs_to_do`.
        orders: for the jobs' processes.
        limits: how.
        board: shows it.
        stop: asked ten times a second; the jobs write their checkpoints and end once it holds.
        homeless: keys of jobs that no node has room for as the cluster is.
    """
    (orders.grid / STOP_FILE).unlink(missing_ok=True)
    shutil.rmtree(orders.grid / TUNE_FOLDER, ignore_errors=True)
    os.environ.update(TUNE_SETTINGS)
    logging.getLogger("ray.tune").setLevel(logging.CRITICAL)  # the board says what happened
    driver = Driver(orders, board, stop)
    there = {job.key for job in orders.jobs.values() if job.artifact_is_there(orders.artifacts)}
    resources = {job.key: orders.resources[job.key].bundles for job in todo}
    trainable = tune.with_resources(
        tune.with_parameters(JobTrainable, orders=orders),
        lambda config: tune.PlacementGroupFactory(resources[config["key"]], strategy="PACK"),
    )
    tuner = tune.Tuner(
        trainable,
        tune_config=tune.TuneConfig(
            num_samples=len(todo),
            search_alg=JobQueue(todo, there, stop, driver.give_up, homeless),
            scheduler=HalvingByReward(dict(orders.jobs), driver.mark_pruned) if limits.asha else None,
            max_concurrent_trials=limits.max_concurrent or None,
            reuse_actors=False,
            trial_name_creator=lambda trial: trial.config["key"],
            trial_dirname_creator=lambda trial: trial.config["key"],
        ),
        run_config=tune.RunConfig(
            name=TUNE_FOLDER,
            storage_path=str(orders.grid),
            checkpoint_config=tune.CheckpointConfig(checkpoint_at_end=False),
            failure_config=tune.FailureConfig(max_failures=limits.num_retries),
            callbacks=[driver],
            stop=EndOfGrid(driver),
            verbose=0,
        ),
    )
    with board:
        tuner.fit()
    shutil.rmtree(orders.grid / TUNE_FOLDER, ignore_errors=True)


class Driver(tune.Callback):
    """Hears of every event from Tune: keeps the board, and the records of jobs whose process died.

    Args:
        orders: of the grid.
        board: told of everything.
        stop: whether a signal has come.
    """

    def __init__(self, orders: Orders, board: Board, stop: Callable[[], bool]) -> None:
        self._orders, self._board, self._stop = orders, board, stop
        self._ledger = Ledger(orders.grid)
        self._stopping_since = 0.0

    def __reduce__(self) -> tuple[type, tuple[()]]:
        """Tune writes its callbacks into its notes, which nobody reads: no board, no terminal."""
        return tune.Callback, ()

    def over(self) -> bool:
        """Whether nothing more is to be waited for."""
        if not self._stop():
            return False
        waited_s = time.monotonic() - self._stopping_since if self._stopping_since else 0.0
        return waited_s > STOP_LIMIT_S or not self._board.counts["running"]

    def give_up(self, job: Job, reason: str) -> None:
        """A job that cannot begin."""
        with contextlib.suppress(OSError):  # a full disk ends no other job; the next start tries this one again
            self._ledger.end(job, "failed", error=reason)
        self._board.note(job.key, "failed", error=reason)

    def mark_pruned(self, key: str) -> None:
        """ASHA ends this trial: for good, where that can be written down, else until the next start."""
        mark = self._orders.prune_mark(key)
        with contextlib.suppress(OSError):
            mark.parent.mkdir(exist_ok=True)
            mark.touch()

    def on_step_begin(self, iteration: int, trials: list[Trial], **values: Any) -> None:
        """About ten times a second."""
        if self._stop() and not self._stopping_since:
            with contextlib.suppress(OSError):  # on a full disk it is tried again, ten times a second
                (self._orders.grid / STOP_FILE).touch()
                self._stopping_since = time.monotonic()
                self._board.say(f"    stop  {self._board.counts['running']} jobs write their checkpoints and end")
        self._board.refresh()

    def on_trial_start(self, iteration: int, trials: list[Trial], trial: Trial, **values: Any) -> None:
        """A job's process is there."""
        self._board.note(trial.config["key"], "running")

    def on_trial_result(
        self, iteration: int, trials: list[Trial], trial: Trial, result: dict[str, Any], **values: Any
    ) -> None:
        """A job has reported."""
        self._board.note(trial.config["key"], result["state"], standing=result)

    def on_trial_complete(self, iteration: int, trials: list[Trial], trial: Trial, **values: Any) -> None:
        """A job has ended by itself, or ASHA has ended it."""
        job = self._orders.jobs[trial.config["key"]]
        state = (trial.last_result or {}).get("state", "stopped")
        self._board.note(job.key, "pruned" if state == "running" else state)
        record = self._ledger.read(job)
        self._board.rows[job.key].result = record.result
        if job.kind == "trial" and state == "done":
            self._board.say(f"    done  {job.key}  return {record.result.get('mean_return', float('nan')):.1f}")

    def on_trial_recover(self, iteration: int, trials: list[Trial], trial: Trial, **values: Any) -> None:
        """A job has failed and will be tried again."""
        self._note_failure(trial, "again ")

    def on_trial_error(self, iteration: int, trials: list[Trial], trial: Trial, **values: Any) -> None:
        """A job has failed for good."""
        self._note_failure(trial, "failed")

    def _note_failure(self, trial: Trial, word: str) -> None:
        job = self._orders.jobs[trial.config["key"]]
        if self._ledger.read(job).state == "running":  # its process died before it could write anything
            with contextlib.suppress(OSError):
                self._ledger.end(job, "failed", error=_cause(trial))
        error = self._ledger.read(job).error or _cause(trial)
        self._board.note(job.key, "failed", error=error)
        self._board.say(f"  {word}  {job.key}: {error}")


class EndOfGrid(tune.Stopper):
    """Ends Tune after a signal, once no job runs any more.

    Args:
        driver: knows.
    """

    def __init__(self, driver: Driver) -> None:
        self._driver = driver

    def __call__(self, trial_id: str, result: dict[str, Any]) -> bool:
        """Jobs end by themselves."""
        return False

    def stop_all(self) -> bool:
        """Whether to end."""
        return self._driver.over()


def _cause(trial: Trial) -> str:
    error = trial.get_pickled_error()
    if isinstance(error, RayTaskError):
        return one_line(error.cause)
    if isinstance(error, RayActorError):
        return f"its process died: {one_line(error).partition(': ')[2]}"
    return one_line(error) if error is not None else "its process died"
