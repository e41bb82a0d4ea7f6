"""What has become of every job of a grid: one JSON file each, replaced in one step. It outlives Ray and the driver.

A job's record is written by the process that works on it, and after that process is gone by the driver, never by two
at once. A record that says `running` while no driver holds the grid is of a job that was cut short.
"""

import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, get_args

from filelock import FileLock, Timeout

from slotfilm_dist.atomic import write_atomic
from slotfilm_dist.tuning.jobs import Job

JobState = Literal["waiting", "running", "stopped", "failed", "pruned", "done"]
"""`stopped` was ended on request and goes on; `failed` gave up after its retries; `pruned` was ended by ASHA."""
OVER: tuple[JobState, ...] = ("done", "pruned")
"""States of a trial that is never run again."""
LEDGER = "ledger"
"""Folder of the records in a grid's directory."""
MAKING = "making"
"""Folder in it of the jobs that make data and encoders for its trials."""


def directory_of(grid: Path, key: str, kind: str) -> Path:
    """Where the run of a grid's job lives."""
    return grid / key if kind == "trial" else grid / MAKING / key


@dataclass(frozen=True, kw_only=True, slots=True)
class Record:
    """One job so far."""

    key: str
    config_hash: str
    """Of all that decides the trial's result."""
    kind: str
    variant: str
    seed: int
    state: JobState = "waiting"
    num_starts: int = 0
    """How often it was begun, over all commands."""
    worked_s: float = 0.0
    """Time that it has run, over all starts, in seconds."""
    began_at: float = 0.0
    """Wall clock of its last start, in seconds since the epoch."""
    process: str = ""
    """Host and process id of its last start."""
    error: str = ""
    """One line on why it failed last; kept when a retry went well."""
    trace: str = ""
    """The whole of that error."""
    result: dict[str, Any] = field(default_factory=dict)
    """Of a trial that is done: `mean_return`, `success_rate`, `success_interval` of its final evaluation."""


class Ledger:
    """The records of a grid.

    Args:
        grid: the grid's directory.
    """

    def __init__(self, grid: Path) -> None:
        self._folder = grid / LEDGER

    def read(self, job: Job) -> Record:
        """A job's record; a new one if there is none.

        Raises:
            ValueError: the record is unreadable or of another config.
        """
        fresh = Record(
            key=job.key,
            config_hash=job.config_hash if job.kind == "trial" else job.key.rpartition("-")[2],
            kind=job.kind,
            variant=job.config.variant,
            seed=job.config.seed,
        )
        path = self._path(job.key)
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
            record = Record(**{f.name: values[f.name] for f in fields(Record)})
        except FileNotFoundError:
            return fresh
        except (UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError) as error:
            raise ValueError(f"{path} is no record of a trial ({error!r}); delete it to run the trial again") from None
        if record.state not in get_args(JobState) or record.config_hash != fresh.config_hash:
            raise ValueError(f"{path} is the record of another config; delete it to run the trial again")
        return record

    def write(self, record: Record) -> None:
        """Replace a job's record."""
        self._folder.mkdir(parents=True, exist_ok=True)
        write_atomic(self._path(record.key), [json.dumps(asdict(record), indent=1).encode()])

    def begin(self, job: Job) -> Record:
        """Note that this process begins to work on a job."""
        before = self.read(job)
        record = replace(
            before,
            state="running",
            num_starts=before.num_starts + 1,
            began_at=time.time(),
            process=f"{socket.gethostname()} {os.getpid()}",
        )
        self.write(record)
        return record

    def end(self, job: Job, state: JobState, **values: Any) -> Record:
        """Note how the work on a job has ended; `values` are fields of the record."""
        before = self.read(job)
        worked_s = before.worked_s + (time.time() - before.began_at if before.state == "running" else 0.0)
        record = replace(before, state=state, worked_s=worked_s, **values)
        self.write(record)
        return record

    def _path(self, key: str) -> Path:
        return self._folder / f"{key}.json"


@contextmanager
def held_by_one_driver(grid: Path) -> Iterator[None]:
    """Keep other drivers away from a grid while the body runs; a driver that died has let go of it.

    Raises:
        ValueError: another driver works on it.
    """
    grid.mkdir(parents=True, exist_ok=True)
    lock = FileLock(grid / ".lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise ValueError(
            f"{grid} is in use by another `slotfilm grid`; wait for it or stop it, or choose another --name"
        ) from None
    try:
        yield
    finally:
        lock.release()
