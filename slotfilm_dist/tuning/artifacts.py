"""Makes data and encoders that trials share, each once, however many grids want it at the same time."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from slotfilm_dist.backend import Backend
from slotfilm_dist.learning.learner import dataset_hash, pretrain_hash
from slotfilm_dist.pipeline import Pipeline
from slotfilm_dist.progress import Progress
from slotfilm_dist.runs import RunDirectory
from slotfilm_dist.stopping import StopFlag

LOOK_S = 0.5
"""Pause between two looks at a lock that another process holds."""


class SharingPipeline(Pipeline):
    """A `Pipeline` that waits while another process makes the artifact that it wants, and then finds it made.

    Args:
        run: the entered run directory.
        backend: where the roles live.
        artifacts: folder of data and encoders that runs share.
        progress: tells the user.
        stop: asked between pieces of work, and while waiting.
    """

    def __init__(
        self, run: RunDirectory, backend: Backend, artifacts: Path, progress: Progress, stop: StopFlag
    ) -> None:
        super().__init__(run, backend, artifacts, progress, stop)
        artifacts.mkdir(parents=True, exist_ok=True)

    def make_artifacts(self, *, encoder: bool) -> None:
        """Make the random policy's data and, where asked for, the pre-trained encoder, unless they are there.

        Raises:
            Interrupted: a stop was asked for; what was made so far is kept and gone on with.
        """
        try:
            dataset = self._collect()
            if encoder:
                self._pretrain(dataset)
        finally:
            self._sink.close()

    def _collect(self) -> Path:
        with self._alone(f"random-{dataset_hash(self._config)}"):
            return super()._collect()

    def _pretrain(self, dataset: Path) -> Path | None:
        with self._alone(f"encoder-{pretrain_hash(self._config)}"):
            return super()._pretrain(dataset)

    @contextmanager
    def _alone(self, name: str) -> Iterator[None]:
        """Keep other processes from making the artifact of this name; one that died has let go of it."""
        lock = FileLock(self._artifacts / f".{name}.lock")
        told = False
        while True:
            self._stop.check()
            try:
                lock.acquire(timeout=0)
                break
            except Timeout:
                if not told:
                    self._progress.say(f"    wait  another run is making {name}")
                told = True
                time.sleep(LOOK_S)
        try:
            yield
        finally:
            lock.release()
