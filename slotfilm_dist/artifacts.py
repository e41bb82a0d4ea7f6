"""Keeps runs on any path, alone or in a grid, from making the same shared data or encoder at the same time."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from slotfilm_dist.progress import Progress
from slotfilm_dist.stopping import StopFlag

LOOK_S = 0.5
"""Pause between two looks at a lock that another process holds."""


@contextmanager
def sole_maker(artifact: Path, progress: Progress, stop: StopFlag) -> Iterator[None]:
    """Be the only process that makes this artifact; one that died has let go of it.

    Whoever had to wait may find it made: look again inside.

    Args:
        artifact: its path; the lock lies beside it.
        progress: told once that another process has it.
        stop: asked while waiting.

    Raises:
        Interrupted: a stop was asked for while waiting.
    """
    artifact.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(artifact.with_name(f".{artifact.name}.lock"))
    told = False
    while True:
        stop.check()
        try:
            lock.acquire(timeout=0)
            break
        except Timeout:
            if not told:
                progress.say(f"    wait  another run is making {artifact.name}")
            told = True
            time.sleep(LOOK_S)
    try:
        yield
    finally:
        lock.release()
