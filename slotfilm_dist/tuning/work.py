"""Works on one job of a grid: a thread that goes through the phases, and what it says of itself. Free of Tune."""

import os
import shutil
import signal
import sys
import threading
import time
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from slotfilm_dist.evaluation.record import read_run
from slotfilm_dist.pipeline import Pipeline
from slotfilm_dist.progress import Phase, Progress, steady_console
from slotfilm_dist.runs import RunDirectory
from slotfilm_dist.stopping import Interrupted, StopFlag
from slotfilm_dist.tuning.jobs import Job
from slotfilm_dist.tuning.ledger import Ledger, directory_of
from slotfilm_dist.tuning.places import MakeBackend
from slotfilm_dist.tuning.resources import TrialResources

STOP_FILE = "stop"
"""In a grid's directory: its driver wants all jobs to write their checkpoints and end."""
PRUNE_FOLDER = "pruned"
"""In a grid's directory: a file for each trial that ASHA ended."""
LOOK_S = 0.5
"""Seconds between two looks for the stop file."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Orders:
    """What the process of a job has to know."""

    grid: Path
    """Absolute; every node sees it."""
    artifacts: Path
    """Absolute; every node sees it."""
    jobs: Mapping[str, Job]
    resources: Mapping[str, TrialResources]
    """By the job's key."""
    make_backend: MakeBackend
    command: tuple[str, ...]
    """The words of the command that this is part of, for the runs' records."""

    def prune_mark(self, key: str) -> Path:
        """The file by which the driver tells a trial that ASHA has ended it."""
        return self.grid / PRUNE_FOLDER / key

    def directory(self, job: Job) -> Path:
        """Where a job's run lives."""
        return directory_of(self.grid, job.key, job.kind)


class StopFile(StopFlag):
    """A stop that is asked for by a file, or from another thread.

    Args:
        path: of the file.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path
        self._looked_at = -LOOK_S
        self.pruned = False
        """The stop means that this trial is not worth its time."""

    def __call__(self) -> bool:
        """Whether to stop."""
        now = time.monotonic()
        if not self.signal_number and now - self._looked_at >= LOOK_S:
            self._looked_at = now
            if self._path.exists():
                self.signal_number = signal.SIGTERM
        return super().__call__()

    def check(self) -> None:
        """Raise `Interrupted` if a stop has been asked for."""
        self()
        super().check()

    def end(self, *, pruned: bool) -> None:
        """Ask for the end of a job, a final one if this trial is not worth its time."""
        if not self.signal_number:
            self.pruned = pruned and not self._path.exists()
            self.signal_number = signal.SIGTERM


class Standing(Progress):
    """Keeps how far a job is, to be asked for from another thread, and writes sentences to the process's log."""

    def __init__(self) -> None:
        super().__init__(steady_console(force_terminal=False))
        self.now: dict[str, Any] = {"phase": "start", "share": 0.0}

    def say(self, text: str) -> None:
        """A sentence for the log; the table shows it while a phase has nothing else to show."""
        super().say(text)
        if self.now["phase"] == "start":
            self.now = self.now | {"note": text.strip()}

    def begin(self, phase: Phase, text: str) -> None:
        """Start of a phase."""
        super().begin(phase, text)
        self.now = {"phase": phase, "share": 0.0}

    def show(self, done: float, total: float, values: Mapping[str, str]) -> None:
        """How far the phase is."""
        super().show(done, total, values)
        now: dict[str, Any] = {"phase": self._phase, "share": min(done / total, 1.0) if total else 1.0}
        if "steps/s" in values:
            now["steps_per_s"] = float(values["steps/s"])
        if self._phase == "train":
            now["env_steps"] = int(done)
            if "return" in values:
                now["episode_return"] = float(values["return"])
        self.now = now


class Work:
    """The thread that works on a job. Ends when the job is done, has failed, or was stopped.

    Consumes nothing but the stop file; produces the run's directory and the ledger's record; waits for the backend.

    Args:
        job: what to do.
        orders: where and with what.
    """

    def __init__(self, job: Job, orders: Orders) -> None:
        self._job, self._orders = job, orders
        self._ledger = Ledger(orders.grid)
        self._stop = StopFile(orders.grid / STOP_FILE)
        self._standing = Standing()
        self._error: Exception | None = None
        self._state = "running"
        self._thread = threading.Thread(target=self._run, name=job.key, daemon=True)

    def start(self) -> None:
        """Begin."""
        os.environ["LP_NUM_THREADS"] = "0"  # the software Vulkan driver draws in the calling thread
        sys.argv[1:] = self._orders.command  # what the run's versions.json gives as its command
        self._thread.start()

    def wait(self, timeout_s: float) -> bool:
        """Wait for the end; whether it has come."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def end(self) -> None:
        """Ask for an end. It is final where ASHA decided so; any other end, an error of the driver too, is a stop."""
        self._stop.end(pruned=self._orders.prune_mark(self._job.key).exists())

    def standing(self) -> dict[str, Any]:
        """How far it is, as plain values; raises what the job failed with."""
        if self._error is not None:
            raise self._error
        return self._standing.now | {"state": self._state}

    def _run(self) -> None:
        job, ledger = self._job, self._ledger
        try:
            self._stop.check()
            self._orders.prune_mark(job.key).unlink(missing_ok=True)
            ledger.begin(job)
            self._go_through()
            result = _result(self._orders.directory(job)) if job.kind == "trial" else {}
            ledger.end(job, "done", result=result)
            self._state = "done"
        except Interrupted:
            self._state = "pruned" if self._stop.pruned else "stopped"
            ledger.end(job, "pruned" if self._stop.pruned else "stopped")
        except Exception as error:  # whatever it is, it is this trial's; the others go on
            self._error = error
            ledger.end(job, "failed", error=one_line(error), trace=traceback.format_exc())
        if job.kind == "trial" and self._state in ("done", "pruned"):
            shutil.rmtree(self._orders.directory(job) / "checkpoints" / "replay", ignore_errors=True)

    def _go_through(self) -> None:
        job, orders, stop = self._job, self._orders, self._stop
        path = orders.directory(job)
        backend = orders.make_backend(job.config, path, orders.resources[job.key])
        try:
            backend.prepare()
            with RunDirectory(path, job.config) as run:
                pipeline = Pipeline(run, backend, orders.artifacts, self._standing, stop)
                if job.kind == "trial":
                    pipeline.execute()
                else:
                    pipeline.make_artifacts(encoder=job.kind == "encoder")
        finally:
            self._standing.end()
            backend.close()


def one_line(error: BaseException) -> str:
    """Kind and first line of an error."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__


def _result(run: Path) -> dict[str, Any]:
    final = read_run(run).final
    if final is None:
        return {}
    return {
        "mean_return": final.mean_return,
        "success_rate": final.success_rate,
        "success_interval": list(final.success_interval),
    }
