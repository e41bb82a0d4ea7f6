"""Faults of the driver: signals, two of them on one run, a taken port. Each trains in a process of its own."""

import contextlib
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil

from slotfilm_dist.chaos.live import MetricsTail, live_config
from slotfilm_dist.chaos.outcome import Observation, UnexpectedError
from slotfilm_dist.cluster.session import FOLDER_PREFIX, OWNER_FILE
from slotfilm_dist.config import RunConfig
from slotfilm_dist.config_files import save_config
from slotfilm_dist.learning.checkpoint import CheckpointStore
from slotfilm_dist.learning.learner import learning_hash

START_S = 180.0
"""Longest time from nothing to training."""
SHUTDOWN_S = 15.0
COMMIT_S = 10.0
ORPHANS_S = 10.0
PREEMPTED, INTERRUPTED, REFUSED = 143, 130, 2


class DriverProcess:
    """A driver in a process of its own, with everything that it starts.

    Args:
        folder: of the run; its config is written there.
        config: of the run.
    """

    def __init__(self, folder: Path, config: RunConfig) -> None:
        self.folder, self.config = folder, config
        folder.mkdir(parents=True, exist_ok=True)
        save_config(config, folder / "config.json")
        self.tail = MetricsTail(folder / "metrics.jsonl")
        self._log = (folder / "driver.log").open("wb")
        self._popen = subprocess.Popen(
            [sys.executable, "-m", "slotfilm_dist.chaos.driver", str(folder)],
            stdout=self._log,
            stderr=subprocess.STDOUT,
        )
        self.process = psutil.Process(self._popen.pid)

    def until_updates(self, count: int) -> "DriverProcess":
        """Wait until so many updates have been made; raises `UnexpectedError` if they are not."""
        began = time.monotonic()
        while self.tail.latest.get("updates", 0) < count:
            self.tail.read()
            if self._popen.poll() is not None or time.monotonic() - began > START_S:
                raise UnexpectedError(f"{count} updates were not made; {self.said()}")
            time.sleep(0.1)
        return self

    def family(self) -> list[psutil.Process]:
        """The driver and everything that it has started."""
        return [self.process, *self.process.children(recursive=True)]

    def code(self, timeout_s: float = 60.0) -> int:
        """The exit code, once it has ended; it is killed if it does not in time."""
        try:
            return self._popen.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            return self._popen.wait()

    def said(self) -> str:
        """The last line that it has written."""
        lines = (self.folder / "driver.log").read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else ""

    def last_updates(self) -> int:
        """Updates behind the newest readable checkpoint, 0 without one."""
        store = CheckpointStore(self.folder / "checkpoints", self.config.checkpoint.keep)
        found = store.read_last(learning_hash(self.config))
        return int(found[0].values["updates"]) if found else 0

    def close(self) -> None:
        """End it and what it has left behind; its cluster's watchdog comes first, for it also deletes files."""
        family: list[psutil.Process] = []
        with contextlib.suppress(psutil.NoSuchProcess):
            family = self.family()
        self._popen.kill()
        self._popen.wait()
        _, orphans = psutil.wait_procs(family, ORPHANS_S)
        for process in orphans:
            with contextlib.suppress(psutil.NoSuchProcess):
                process.kill()
        self._log.close()


@contextmanager
def training(folder: Path, config: RunConfig) -> Iterator[DriverProcess]:
    """A driver that has made 50 updates, ended with the body."""
    driver = DriverProcess(folder, config)
    try:
        yield driver.until_updates(50)
    finally:
        driver.close()


def preempted(folder: Path, rng: np.random.Generator) -> Observation:
    """SIGTERM, as before a spot machine is taken away."""
    config = live_config(int(rng.integers(1000)))
    with training(folder / "preempted", config) as driver:
        family = driver.family()
        ports = _ports(family)
        began = time.monotonic()
        driver.process.send_signal(signal.SIGTERM)
        committed_s = _until(lambda: driver.last_updates() > 0, 60)
        code = driver.code()
        ended_s = time.monotonic() - began
        _, alive = psutil.wait_procs(family, 2)
        leaked_ports = [port for port in ports if _listening(port)]
        leaked = f"{len(alive)} processes, {len(leaked_ports)} ports, {len(_folders_of(driver))} folders"
    return Observation(
        observed=f"a last checkpoint, then an ordered shutdown; exit code {code}",
        figure=f"checkpoint after {committed_s:.1f} s (at most {COMMIT_S:g}); ended after {ended_s:.1f} s (at most "
        f"{SHUTDOWN_S:g}); left behind: {leaked}",
        holds=code == PREEMPTED
        and committed_s <= COMMIT_S
        and ended_s <= SHUTDOWN_S
        and leaked == "0 processes, 0 ports, 0 folders",
    )


def driver_killed(folder: Path, rng: np.random.Generator) -> Observation:
    """SIGKILL to the driver, then a resume."""
    config = live_config(int(rng.integers(1000)))
    path = folder / "killed"
    with training(path, config) as driver:
        driver.until_updates(config.checkpoint.every_updates + 50)
        family, saved = driver.family(), driver.last_updates()
        driver.process.kill()
        driver.code()
        began = time.monotonic()
        _, orphans = psutil.wait_procs(family, ORPHANS_S)
        ended_s, folders = time.monotonic() - began, len(_folders_of(driver))
        for process in orphans:
            process.kill()
    again = DriverProcess(path, config)
    try:
        again.tail.read()
        again.tail.latest.clear()
        num_before = len(again.tail.lines)
        again.until_updates(saved + 20)
        since = again.tail.lines[num_before:]
        first = min(line["learner_updates_total"] for line in since if "learner_updates_total" in line)
    finally:
        again.close()
    return Observation(
        observed="its processes ended with it; the resumed run went on from the last checkpoint",
        figure=f"orphans after {ended_s:.1f} s: {len(orphans)}, folders: {folders}; checkpoint at "
        f"{saved} updates, first report after the resume at {first:g}",
        holds=not orphans and not folders and first >= saved > 0,
    )


def interrupted_twice(folder: Path, rng: np.random.Generator) -> Observation:
    """Two Ctrl-C in a row."""
    with training(folder / "twice", live_config(int(rng.integers(1000)))) as driver:
        family, began = driver.family(), time.monotonic()
        for _ in range(2):
            driver.process.send_signal(signal.SIGINT)
            time.sleep(0.2)
        code = driver.code()
        ended_s = time.monotonic() - began
        _, orphans = psutil.wait_procs(family, ORPHANS_S)
    return Observation(
        observed=f"ended at once, with all its processes; exit code {code}",
        figure=f"ended after {ended_s:.1f} s; orphans {len(orphans)}",
        holds=code == INTERRUPTED and not orphans,
    )


def two_drivers(folder: Path, rng: np.random.Generator) -> Observation:
    """A second driver on the run of a first one, and a lock that a dead one has left."""
    config = live_config(int(rng.integers(1000)))
    with training(folder / "shared", config) as first:
        began = time.monotonic()
        second = subprocess.run(
            [sys.executable, "-m", "slotfilm_dist.chaos.driver", str(first.folder)], capture_output=True, text=True
        )
        took_s = time.monotonic() - began
        named = f"in use by process {first.process.pid} on {socket.gethostname()}" in second.stderr
        before = first.tail.latest["updates"]
        first.until_updates(int(before) + 20)
    with training(folder / "shared", config):
        taken_over = True
    return Observation(
        observed="the second was refused with the first one's process and host; a dead driver's lock was taken over",
        figure=f"exit code {second.returncode}, after {took_s:.1f} s; the first went on",
        holds=second.returncode == REFUSED and named and taken_over,
    )


def port_taken(folder: Path, rng: np.random.Generator) -> Observation:
    """Somebody else on the port of the metrics."""
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        base = live_config(int(rng.integers(1000)))
        config = replace(base, runtime=replace(base.runtime, metrics_port=other.getsockname()[1]))
        with training(folder / "port", config) as driver:
            driver.until_updates(100)
            lost = driver.tail.latest.get("sink_failures_total", 0)
    return Observation(
        observed="training went on, metrics were written",
        figure=f"writes of metrics that failed {lost:g}",
        holds=lost == 0,
    )


def _folders_of(driver: DriverProcess) -> list[Path]:
    """Folders of private clusters that a driver has started and that are there now."""
    owners = Path(tempfile.gettempdir()).glob(f"{FOLDER_PREFIX}*/{OWNER_FILE}")
    return [owner.parent for owner in owners if owner.read_text().startswith(f"{driver.process.pid} ")]


def _until(holds: Callable[[], bool], timeout_s: float) -> float:
    began = time.monotonic()
    while not holds():
        if time.monotonic() - began > timeout_s:
            return float("inf")
        time.sleep(0.05)
    return time.monotonic() - began


def _ports(family: Sequence[psutil.Process]) -> set[int]:
    """Ports that a family of processes listens at."""
    members = {process.pid for process in family}
    found = psutil.net_connections("tcp")
    return {c.laddr.port for c in found if c.pid in members and c.laddr and c.status == psutil.CONN_LISTEN}


def _listening(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0
