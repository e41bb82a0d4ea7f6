"""Ends what a private cluster has left, however its driver ends: a small process that outlives the driver.

    DRIVER                                   WATCHDOG (process and session of its own)
    holds the write end of a pipe ---------> waits at the read end; end of file: the driver is done, or gone
    gone without a word (SIGKILL)            ends every process of the cluster, deletes its folder, ends

Ray's own processes mostly end with their driver, but its two agents first try for a minute to tell their dead head so.
This file is run as a script and imports nothing that is large.
"""

import contextlib
import os
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Collection
from pathlib import Path

import psutil

MARK = "SLOTFILM_CLUSTER"
"""Environment variable that names the private cluster's folder to everything that is started in it."""
LOOK_S = 1.0
"""Pause between looks at whether the driver is still its parent: one that has forked does not hold the pipe alone."""
END_S = 8.0
"""Longest time that processes are looked for and killed."""
AGAIN_S = 0.1
"""Pause before the next look for processes that were just being started."""


class Watchdog:
    """The driver's end of it. `close` is for an ordinary shutdown; a driver that is killed needs to do nothing.

    Ctrl-C does not reach the process, for it is in a session of its own.

    Args:
        folder: of the private cluster, deleted at the end.
    """

    def __init__(self, folder: Path) -> None:
        self._process = subprocess.Popen(
            # Without its own directory on the path, and without what would be printed into a terminal that is gone.
            [sys.executable, "-P", __file__, str(folder), str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            cwd="/",
            start_new_session=True,
        )

    def close(self) -> None:
        """Let it end what is left of the cluster, which should be nothing, delete the folder, and end."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(END_S + LOOK_S)


def members(folder: Path, spared: Collection[int] = ()) -> list[psutil.Process]:
    """The processes of a private cluster, of this user.

    A process belongs to it if it has a file of the folder open for writing, as all have whose output Ray puts there, or
    was started with `MARK` naming the folder and with the folder in its command line. Ray's agents overwrite both with
    their title. Neither another cluster's processes are meant, nor somebody who reads the cluster's logs, nor what else
    the driver has started.

    Args:
        folder: of the private cluster.
        spared: process ids that are not looked at.
    """
    return [
        process
        for process in psutil.process_iter()
        if process.pid not in (os.getpid(), *spared) and _belongs(process, folder)
    ]


def end_members(folder: Path, spared: Collection[int] = (), timeout_s: float = END_S) -> int:
    """Kill the processes of a private cluster until there are none; gives how many there were."""
    deadline = time.monotonic() + timeout_s
    ended: set[psutil.Process] = set()
    empty_looks = 0
    # A look may itself take seconds on a machine out of breath, so what it finds is killed whatever the time.
    while empty_looks < 2:
        found = members(folder, spared)
        for process in found:
            with contextlib.suppress(psutil.Error):
                process.kill()
        ended.update(found)
        empty_looks = 0 if found else empty_looks + 1
        if time.monotonic() > deadline:
            break
        time.sleep(AGAIN_S)
    return len(ended)


def _belongs(process: psutil.Process, folder: Path) -> bool:
    inside = f"{folder}{os.sep}"
    try:
        if process.uids().real != os.getuid():
            return False
        marked = process.environ().get(MARK) == str(folder) and any(inside in word for word in process.cmdline())
        return marked or any(path.startswith(inside) for path in _written_paths(process))
    except (psutil.Error, OSError):  # just ended, or not to be looked into
        return False


def _written_paths(process: psutil.Process) -> list[str]:
    """Files that a process writes, deleted ones too: the next driver may have deleted the folder of a killed one.

    Empty where there is no /proc.
    """
    paths: list[str] = []
    for descriptor in Path(f"/proc/{process.pid}/fd").glob("*"):
        with contextlib.suppress(OSError):  # closed meanwhile
            path = os.readlink(descriptor)
            if path.startswith(os.sep) and _is_writable(process.pid, descriptor.name):
                paths.append(path)
    return paths


def _is_writable(pid: int, descriptor: str) -> bool:
    facts = Path(f"/proc/{pid}/fdinfo/{descriptor}").read_text().splitlines()
    flags = next(int(fact.split()[1], 8) for fact in facts if fact.startswith("flags:"))
    return flags & (os.O_WRONLY | os.O_RDWR) != 0


def _watch(folder: Path, driver: int) -> None:
    while os.getppid() == driver:
        ready, _, _ = select.select([sys.stdin.buffer], [], [], LOOK_S)
        if ready and not os.read(sys.stdin.fileno(), 1):
            break
    end_members(folder, spared=(driver,))
    shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    _watch(Path(sys.argv[1]), driver=int(sys.argv[2]))
