"""What happens when a process of a live run is killed, and when there is no memory."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from slotfilm_dist.backend import TrainReport
from slotfilm_dist.cluster.backend import RayBackend
from slotfilm_dist.config import RunConfig
from slotfilm_dist.replay.dataset import open_dataset

Start = Callable[..., RayBackend]
MakeDataset = Callable[[RunConfig], Path]


class LiveRun:
    """A run that trains, with its reports read one at a time."""

    def __init__(self, backend: RayBackend, dataset: Path) -> None:
        self.backend = backend
        self.stop = False
        backend.begin_training(dataset, None, None)
        self.random_steps = open_dataset(dataset, dataset.name).num_steps
        self._reports: Iterator[TrainReport] = backend.train(lambda: self.stop)
        self.last = next(self._reports)

    def until(self, holds: Callable[[TrainReport], bool], what: str, timeout_s: float = 90.0) -> float:
        """Read reports until one satisfies the condition; gives the time it took."""
        began = time.monotonic()
        while not holds(self.last):
            assert time.monotonic() - began < timeout_s, f"{what} did not happen: {self.last}"
            self.last = next(self._reports)
        return time.monotonic() - began

    def finish(self) -> TrainReport:
        """Stop, and give the last report."""
        self.stop = True
        for report in self._reports:
            self.last = report
        return self.last


@pytest.fixture
def live(start: Start, config: RunConfig, make_dataset: MakeDataset, tmp_path: Path) -> LiveRun:
    run = LiveRun(start(config, tmp_path / "run"), make_dataset(config))
    run.until(lambda r: r.metrics["worker_alive_count"] == 2 and r.updates > 20, "training")
    return run


def assert_exact(run: LiveRun) -> None:
    """Every counted step is stored once, and the ratio is that of the config."""
    last = run.finish()
    assert last.metrics["replay_duplicate_blocks_total"] == 0
    assert last.metrics["replay_inserted_steps_total"] == last.env_steps
    assert abs(last.updates - 0.5 * (last.env_steps - run.random_steps)) <= 0.5 * 100


def test_killed_worker_is_replaced_and_nothing_is_counted_twice(live: LiveRun) -> None:
    before = live.last
    os.kill(live.backend.process_ids()["worker 0"], signal.SIGKILL)
    took_s = live.until(
        lambda r: r.metrics.get("worker_restarts_total/crash", 0) == 1 and r.metrics["worker_alive_count"] == 2,
        "a new worker",
    )
    print(f"killed worker: collecting again after {took_s:.1f} s")
    assert live.last.updates > before.updates
    steps = live.last.env_steps
    live.until(lambda r: r.env_steps > steps + 100, "more steps")
    assert_exact(live)


def test_learner_waits_while_all_workers_are_gone_and_goes_on(live: LiveRun) -> None:
    processes = live.backend.process_ids()
    for name in ("worker 0", "worker 1"):
        os.kill(processes[name], signal.SIGKILL)
    steps = live.last.env_steps
    took_s = live.until(
        lambda r: r.metrics.get("worker_restarts_total/crash", 0) == 2 and r.metrics["worker_alive_count"] == 2,
        "two new workers",
    )
    took_s += live.until(lambda r: r.env_steps > steps + 200, "more steps")
    print(f"all workers killed: collecting again after {took_s:.1f} s")
    assert_exact(live)


def test_system_without_memory_ends_workers_first_and_hub_and_driver_last(live: LiveRun) -> None:
    pids = live.backend.process_ids() | {"driver": os.getpid()}
    scores = {name: int(Path(f"/proc/{pid}/oom_score").read_text()) for name, pid in pids.items()}
    worker, shard = (min(score for n, score in scores.items() if n.startswith(kind)) for kind in ("worker", "shard"))
    assert worker > max(scores["shard 0"], scores["shard 1"]), scores
    assert shard > scores["learner"] > max(scores["hub"], scores["driver"]), scores


def test_run_goes_on_with_one_worker_on_a_machine_short_of_memory(
    start: Start, config: RunConfig, make_dataset: MakeDataset, tmp_path: Path
) -> None:
    config = replace(config, runtime=replace(config.runtime, max_memory_share=0.001))  # any machine uses more
    run = LiveRun(start(config, tmp_path / "run"), make_dataset(config))
    run.until(lambda r: r.metrics.get("worker_restarts_total/memory", 0) == 1, "a worker that stands still")
    steps, updates = run.last.env_steps, run.last.updates
    run.until(lambda r: r.env_steps > steps + 200 and r.updates > updates + 50, "steps and updates")
    assert run.last.metrics["worker_alive_count"] == 1
    assert_exact(run)


def test_sampling_goes_on_without_a_killed_shard(live: LiveRun) -> None:
    # Enough that the other shard alone holds `replay.min_steps`, below which no update is made.
    live.until(lambda r: r.metrics["replay_stored_steps"] > 600, "steps to learn from")
    before = live.last
    os.kill(live.backend.process_ids()["shard 1"], signal.SIGKILL)
    killed_at = time.monotonic()
    live.until(lambda r: r.updates > before.updates + 20, "updates without the shard", 20)
    print(f"killed shard: 20 updates after {time.monotonic() - killed_at:.1f} s")
    live.until(lambda r: r.metrics["replay_restarts_total/crash"] == 1, "a new shard")
    live.until(lambda r: r.metrics["replay_shards_alive_count"] == 2, "an answer of the new shard")
    print(f"killed shard: answers again after {time.monotonic() - killed_at:.1f} s")
    stored, steps = live.last.metrics["replay_stored_steps"], live.last.env_steps
    live.until(lambda r: r.env_steps > steps + 100 and r.metrics["replay_stored_steps"] > stored, "more steps")
    assert live.last.metrics.get("worker_restarts_total/crash", 0) == 0


def test_killed_learner_goes_on_from_its_checkpoint(live: LiveRun, tmp_path: Path) -> None:
    live.backend.save(tmp_path / "run" / "checkpoints", {}, with_replay=False)
    saved, version = live.last.updates, live.last.metrics["weights_version"]
    live.until(lambda r: r.updates > saved + 20, "more updates")
    os.kill(live.backend.process_ids()["learner"], signal.SIGKILL)
    took_s = live.until(lambda r: r.metrics["learner_restarts_total/crash"] == 1, "a new learner")
    updates = live.last.updates
    assert updates >= saved
    took_s += live.until(lambda r: r.updates > updates + 20, "updates of the new learner")
    print(f"killed learner: updating again after {took_s:.1f} s")
    assert live.last.metrics["weights_version"] > version
    assert_exact(live)


def test_number_of_workers_changes_while_the_learner_goes_on(live: LiveRun) -> None:
    live.backend.want_workers(3)
    live.until(lambda r: r.metrics["worker_alive_count"] == 3, "a third worker")
    live.backend.want_workers(1)
    live.until(lambda r: r.metrics["worker_alive_count"] == 1, "one worker")
    updates = live.last.updates
    live.until(lambda r: r.updates > updates + 20, "more updates")
    assert_exact(live)
