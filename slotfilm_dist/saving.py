"""When a run writes checkpoints, and what happens when one cannot be written."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from slotfilm_dist.backend import RunFailedError, TrainReport

MAX_FAILED = 5
"""Checkpoints in a row that may fail; after so many a run that cannot keep what it learns stops."""
RETRY_S = 10.0
"""Pause before a checkpoint that failed is tried again."""
LONGEST_S = 1800.0
"""Longest time between checkpoints while updates are made, however few they are."""
PAUSES_GROW = 4.0
"""Factor from one such pause to the next: the last try comes a quarter of an hour after the first."""


@runtime_checkable
class CheckpointWriter(Protocol):
    """A backend as far as checkpoints go."""

    def save(self, folder: Path, values: Mapping[str, Any], *, with_replay: bool, best: bool = False) -> int:
        """Write a checkpoint; gives its size in bytes."""
        ...


class Saver:
    """Writes a run's checkpoints on time. The last readable one stays while a newer one cannot be written.

    Args:
        backend: writes them.
        folder: where they go.
        every_updates: updates from one to the next.
        updates: that the run has made so far.
    """

    def __init__(self, backend: CheckpointWriter, folder: Path, every_updates: int, updates: int) -> None:
        self._backend, self._folder, self._every = backend, folder, every_updates
        self._next, self._retry_at = updates + every_updates, 0.0
        self._saved_at, self._saved_updates = time.monotonic(), updates
        self._failed_in_a_row = 0
        self.num_written = self.num_failed = 0

    def due(self, updates: int) -> bool:
        """Whether one should be written after so many updates."""
        now = time.monotonic()
        late = updates > self._saved_updates and now - self._saved_at >= LONGEST_S
        return (updates >= self._next or late) and now >= self._retry_at

    def age(self, report: TrainReport) -> dict[str, float]:
        """How old the last one is, as metrics."""
        return {
            "checkpoint_age_s": time.monotonic() - self._saved_at,
            "checkpoint_age_updates": max(0, report.updates - self._saved_updates),
        }

    def save(
        self, report: TrainReport, values: Mapping[str, float], *, with_replay: bool, best: bool = False
    ) -> tuple[dict[str, float], str]:
        """Write a checkpoint; gives metrics and, where it could not be written, why.

        Raises:
            RunFailedError: `MAX_FAILED` of them in a row could not be written.
        """
        began = time.monotonic()
        try:
            size = self._backend.save(self._folder, values, with_replay=with_replay, best=best)
        except OSError as error:
            return {"checkpoint_failed_total": self._count_failure(error)}, str(error)
        self._failed_in_a_row = 0
        self.num_written += 1
        if not best:
            self._next = report.updates + self._every
            self._saved_at, self._saved_updates = time.monotonic(), report.updates
        metrics = {
            "checkpoint_bytes": float(size),
            "checkpoint_write_s": time.monotonic() - began,
            "checkpoint_written_total": float(self.num_written),
        }
        return metrics, ""

    def _count_failure(self, error: OSError) -> float:
        self.num_failed += 1
        self._failed_in_a_row += 1
        self._retry_at = time.monotonic() + RETRY_S * PAUSES_GROW ** (self._failed_in_a_row - 1)
        if self._failed_in_a_row >= MAX_FAILED:
            raise RunFailedError(
                f"{MAX_FAILED} checkpoints in a row could not be written to {self._folder}, last: {error}; "
                "make room there, then go on with --resume"
            ) from error
        return float(self.num_failed)
