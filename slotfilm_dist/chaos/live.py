"""A training run to damage: the whole pipeline on Ray, driven in a thread, seen through its own metrics file."""

import contextlib
import itertools
import json
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

from slotfilm_dist.chaos.faulty_env import MAKERS, make_faulty_env
from slotfilm_dist.chaos.faulty_links import faulty_wiring
from slotfilm_dist.chaos.outcome import UnexpectedError
from slotfilm_dist.chaos.switches import Switches
from slotfilm_dist.cluster.backend import RayBackend
from slotfilm_dist.cluster.failures import RoleLostError, RoleSilentError
from slotfilm_dist.cluster.worker import Limits
from slotfilm_dist.config import RunConfig
from slotfilm_dist.machine import usable_memory_bytes, used_memory_share
from slotfilm_dist.pipeline import Pipeline
from slotfilm_dist.presets import smoke
from slotfilm_dist.progress import Progress
from slotfilm_dist.runs import RunDirectory
from slotfilm_dist.stopping import Interrupted, StopFlag
from slotfilm_dist.variants import apply_variant

POLL_S = 0.05
ANSWERS_S = 30.0
"""Time for a process that was ended to be replaced, before the next one is."""
STEP_LIMIT_S = 10.0
"""A step of the toy environment takes less than a millisecond, but an overloaded machine may stop for seconds."""
SNAPSHOT_S = 10.0
"""Seconds between snapshots of replay, often enough to be met by a plan of minutes."""
MEMORY_BYTES = 6 << 30
"""Memory that the run, and a fault that takes some, may use beyond what is in use at the start."""
DISK_BYTES = 64 << 20
"""Size of the file system that the checkpoints are written to, where one may be mounted."""


def live_config(seed: int) -> RunConfig:
    """State only, on the toy environment: a step and an update take milliseconds, and the run has no end."""
    base = apply_variant("state_only", smoke())
    share = min(base.runtime.max_memory_share, used_memory_share() + MEMORY_BYTES / usable_memory_bytes())
    return replace(
        base,
        seed=seed,
        schedule=replace(base.schedule, total_steps=100_000_000, random_steps=200, updates_per_step=0.5),
        replay=replace(base.replay, capacity=40_000, min_steps=100, num_shards=2),
        runtime=replace(
            base.runtime,
            mode="ray",
            num_workers=2,
            block_steps=16,
            learner_threads=1,
            device="cpu",
            metrics_port=0,
            max_memory_share=share,
        ),
        evaluation=replace(base.evaluation, every_steps=0),
        checkpoint=replace(base.checkpoint, every_updates=200),
    )


class MetricsTail:
    """Reads a run's metrics file as it grows.

    Args:
        path: of the file.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._offset = path, 0
        self.lines: list[dict[str, float]] = []
        """All lines so far, with `seen_s`, the time at which each was read."""
        self.latest: dict[str, float] = {}
        """The newest value of every metric."""

    def read(self) -> None:
        """Take in what has come."""
        if not self._path.exists():
            return
        with self._path.open("rb") as file:
            file.seek(self._offset)
            fresh = file.read()
        complete = fresh[: fresh.rfind(b"\n") + 1]
        self._offset += len(complete)
        for line in complete.splitlines():
            values = {str(k): float(v) for k, v in json.loads(line).items() if isinstance(v, int | float)}
            self.lines.append(values | {"seen_s": time.monotonic()})
            self.latest |= values


class LiveRun:
    """A run under way. Faults of other processes are signals to them; those inside of them go through `switches`.

    Args:
        folder: to write everything into.
        config: see `live_config`.
        environment: `toy` or `simulator`.
    """

    def __init__(self, folder: Path, config: RunConfig, environment: str) -> None:
        self.config, self.folder = config, folder
        self.switches = Switches(folder / "switches")
        self.checkpoints = folder / "run" / "checkpoints"
        self._stop = StopFlag()
        self._error = ""
        make_env = partial(make_faulty_env, folder=folder / "switches", make_env=MAKERS[environment])
        self.backend = RayBackend(
            config,
            folder / "run",
            make_env,
            Limits(step_s=STEP_LIMIT_S) if environment == "toy" else None,
            SNAPSHOT_S,
            faulty_wiring(folder / "switches"),
        )
        self.tail = MetricsTail(folder / "run" / "metrics.jsonl")
        self._thread = threading.Thread(target=self._drive, name="pipeline", daemon=True)

    @contextmanager
    def running(self) -> Iterator["LiveRun"]:
        """Train while the body runs."""
        self.checkpoints.mkdir(parents=True)
        with small_disk(self.checkpoints) as self.disk_is_small:
            try:
                self.backend.prepare()
                self._thread.start()
                self.until(lambda m: m.get("worker_alive_count") == 2 and m["updates"] > 50, "training", 180)
                yield self
            finally:
                self._stop.signal_number = signal.SIGTERM
                if self._thread.ident is not None:
                    self._thread.join(60)
                self.backend.close()

    def until(self, holds: Callable[[Mapping[str, float]], bool], what: str, timeout_s: float = 90.0) -> float:
        """Wait until the newest metrics satisfy a condition; gives the time it took.

        Raises:
            UnexpectedError: they did not in time, or the run ended.
        """
        began = time.monotonic()
        while True:
            self.tail.read()
            with contextlib.suppress(KeyError):
                if holds(self.tail.latest):
                    return time.monotonic() - began
            if not self._thread.is_alive():
                raise UnexpectedError(f"{what}: the run ended; {self._error}")
            if time.monotonic() - began > timeout_s:
                raise UnexpectedError(f"{what} did not happen within {timeout_s:g} s")
            time.sleep(POLL_S)

    def value(self, name: str) -> float:
        """The newest value of a metric, 0 before the first."""
        self.tail.read()
        return self.tail.latest.get(name, 0.0)

    def more_steps(self, count: int, timeout_s: float = 90.0) -> float:
        """Wait for so many further environment steps; gives the time it took."""
        wanted = self.value("env_steps") + count
        return self.until(lambda m: m["env_steps"] >= wanted, f"{count} more environment steps", timeout_s)

    def more_updates(self, count: int, timeout_s: float = 90.0) -> float:
        """Wait for so many further updates; gives the time it took."""
        wanted = self.value("updates") + count
        return self.until(lambda m: m["updates"] >= wanted, f"{count} more updates", timeout_s)

    def kill(self, *roles: str) -> None:
        """End roles' processes with SIGKILL, one right after the other.

        Raises:
            UnexpectedError: some role had no process for `ANSWERS_S`.
        """
        ids = self._process_ids()  # asked for once: a killed one does not answer
        for role in roles:
            os.kill(ids[role], signal.SIGKILL)

    def _process_ids(self) -> Mapping[str, int]:
        """Of every role; one that an earlier fault ended may be about to be replaced."""
        deadline = time.monotonic() + ANSWERS_S
        while True:
            try:
                return self.backend.process_ids()
            except (RoleLostError, RoleSilentError) as error:
                if time.monotonic() > deadline:
                    raise UnexpectedError(str(error)) from error
                time.sleep(POLL_S)

    def longest_pause_s(self, since_s: float) -> float:
        """The longest time between two reports that show progress of the learner, from `since_s` on."""
        times, updates = [since_s], -1.0
        for line in self.tail.lines:
            if line["seen_s"] >= since_s and line.get("updates", -1.0) > updates:
                updates = line["updates"]
                times.append(line["seen_s"])
        return max((b - a for a, b in itertools.pairwise(times)), default=0.0)

    def _drive(self) -> None:
        try:
            with RunDirectory(self.folder / "run", self.config) as run:
                Pipeline(run, self.backend, self.folder / "artifacts", Progress(), self._stop).execute()
        except Interrupted:
            return
        except Exception as error:  # told by `until`, which somebody is in
            self._error = f"{type(error).__name__}: {error}"


@contextmanager
def small_disk(folder: Path) -> Iterator[bool]:
    """A file system of its own at a folder, which can be filled; gives False where mounting is not permitted."""
    mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", str(folder)]
    try:
        mounted = subprocess.run(mount, capture_output=True).returncode == 0
    except FileNotFoundError:
        mounted = False
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "--lazy", str(folder)], capture_output=True)
