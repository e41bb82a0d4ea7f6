"""Checkpoints on time, and what a full disk does to them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from slotfilm_dist.backend import RunFailedError, TrainReport
from slotfilm_dist.saving import LONGEST_S, MAX_FAILED, Saver


class FullDisk:
    """Writes nothing; the disk is full for the first `num_full` times."""

    def __init__(self, num_full: int) -> None:
        self._num_full = num_full
        self.num_calls = 0

    def save(self, folder: Path, values: Mapping[str, Any], *, with_replay: bool, best: bool = False) -> int:
        self.num_calls += 1
        if self.num_calls <= self._num_full:
            raise OSError(28, "No space left on device")
        return 1000


def report(updates: int) -> TrainReport:
    return TrainReport(env_steps=updates, updates=updates, metrics={})


def saver(disk: FullDisk) -> Saver:
    return Saver(disk, Path("run"), 100, 0)


def test_checkpoint_is_due_every_so_many_updates() -> None:
    made = saver(FullDisk(0))
    assert not made.due(99)
    assert made.due(120)
    metrics, problem = made.save(report(120), {}, with_replay=False)
    assert (metrics["checkpoint_bytes"], metrics["checkpoint_written_total"], problem) == (1000, 1, "")
    assert not made.due(219)
    assert made.due(220)
    assert made.age(report(150))["checkpoint_age_updates"] == 30


def test_checkpoint_is_due_after_a_while_however_few_the_updates_were(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [1000.0]
    monkeypatch.setattr("slotfilm_dist.saving.time.monotonic", lambda: now[0])
    made = saver(FullDisk(0))
    now[0] += LONGEST_S
    assert not made.due(0), "nothing is new"
    assert made.due(1)
    made.save(report(1), {}, with_replay=False)
    assert not made.due(2)


def test_failed_checkpoint_is_told_counted_and_not_tried_again_at_once() -> None:
    made = saver(FullDisk(1))
    metrics, problem = made.save(report(120), {}, with_replay=False)
    assert metrics == {"checkpoint_failed_total": 1}
    assert "No space left" in problem
    assert not made.due(500)
    _, problem = made.save(report(130), {}, with_replay=False)
    assert problem == ""


def test_pauses_grow_so_that_there_is_time_to_make_room(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [1000.0]
    monkeypatch.setattr("slotfilm_dist.saving.time.monotonic", lambda: now[0])
    made, first = saver(FullDisk(100)), 1000.0
    for _ in range(MAX_FAILED - 1):
        made.save(report(120), {}, with_replay=False)
        while not made.due(120):
            now[0] += 1.0
    assert now[0] - first > 10 * 60


def test_run_that_cannot_keep_what_it_learns_stops() -> None:
    made = saver(FullDisk(100))
    for _ in range(MAX_FAILED - 1):
        made.save(report(120), {}, with_replay=False)
    with pytest.raises(RunFailedError, match=r"5 checkpoints in a row .* No space left on device; make room"):
        made.save(report(120), {}, with_replay=False)


def test_best_checkpoint_does_not_put_the_next_one_off() -> None:
    made = saver(FullDisk(0))
    made.save(report(120), {}, with_replay=False, best=True)
    assert made.due(120)
