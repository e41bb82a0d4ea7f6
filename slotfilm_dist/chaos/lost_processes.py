"""Faults of whole processes of a live run: workers, shards and the learner killed."""

import shutil
import time

import numpy as np

from slotfilm_dist.chaos.live import LiveRun
from slotfilm_dist.chaos.outcome import Observation

WORKER_BACK_S = 10.0
ALL_WORKERS_BACK_S = 20.0
SAMPLING_PAUSE_S = 2.0
REPORT_S = 1.0
"""The run reports once a second, so a pause is known no better than that."""
LEARNER_BACK_S = 30.0


def worker_killed(run: LiveRun, rng: np.random.Generator) -> Observation:
    """One worker, in the middle of a chunk."""
    began, crashes = time.monotonic(), run.value("worker_restarts_total/crash")
    run.kill(f"worker {rng.integers(run.config.runtime.num_workers)}")
    took_s = run.until(
        lambda m: m["worker_restarts_total/crash"] == crashes + 1 and m["worker_alive_count"] == 2, "a new worker"
    )
    run.more_steps(200)
    pause_s, twice = run.longest_pause_s(began), run.value("replay_duplicate_blocks_total")
    return Observation(
        observed="restarted, collecting again; the learner went on",
        figure=f"collecting again after {took_s:.1f} s (at most {WORKER_BACK_S:g}); blocks stored twice {twice:g}; "
        f"longest pause of the learner {pause_s:.1f} s (reports come once a second)",
        holds=took_s <= WORKER_BACK_S and twice == 0 and pause_s <= 1.0 + 2 * REPORT_S,
    )


def all_workers_killed(run: LiveRun, rng: np.random.Generator) -> Observation:
    """Every worker within a second."""
    crashes, schedule = run.value("worker_restarts_total/crash"), run.config.schedule
    count, began = run.config.runtime.num_workers, time.monotonic()
    for worker in rng.permutation(count):
        run.kill(f"worker {worker}")
    run.until(
        lambda m: m["worker_restarts_total/crash"] == crashes + count and m["worker_alive_count"] == count,
        "new workers",
    )
    starved = run.value("updates") - schedule.updates_per_step * (run.value("env_steps") - schedule.random_steps)
    run.more_steps(200)
    took_s = time.monotonic() - began
    return Observation(
        observed="the learner waited at the limiter and went on with the new workers",
        figure=f"200 new steps {took_s:.1f} s after the kill (at most {ALL_WORKERS_BACK_S:g}); updates beyond what the "
        f"steps allow {max(0.0, starved):g}",
        holds=took_s <= ALL_WORKERS_BACK_S and starved <= 0,
    )


def shard_killed(run: LiveRun, rng: np.random.Generator) -> Observation:
    """One shard that has a snapshot."""
    index = int(rng.integers(run.config.replay.num_shards))
    manifest = run.checkpoints / "replay" / f"shard-{index:02d}" / "manifest.json"
    run.until(lambda _: manifest.exists(), "a snapshot", 60)
    return _shard_killed(run, index, "its snapshot was loaded")


def shard_killed_without_snapshot(run: LiveRun, rng: np.random.Generator) -> Observation:
    """One shard that has none: what it held is lost."""
    index = int(rng.integers(run.config.replay.num_shards))
    run.until(lambda m: m["replay_stored_steps"] > 1000, "steps in the other shard")
    shutil.rmtree(run.checkpoints / "replay" / f"shard-{index:02d}", ignore_errors=True)
    return _shard_killed(run, index, "it began empty")


def _shard_killed(run: LiveRun, index: int, how: str) -> Observation:
    stored, restarts = run.value("replay_stored_steps"), run.value("replay_restarts_total/crash")
    workers_lost = run.value("worker_restarts_total/crash")
    began = time.monotonic()
    run.kill(f"shard {index}")
    run.more_updates(20, 30)
    run.until(lambda m: m["replay_restarts_total/crash"] == restarts + 1, "a new shard")
    run.until(lambda m: m["replay_shards_alive_count"] == 2, "an answer of the new shard")
    back_s, left = time.monotonic() - began, run.value("replay_stored_steps")
    run.more_steps(200)
    pause_s = run.longest_pause_s(began)
    return Observation(
        observed=f"sampling went on with the other shard; {how}",
        figure=f"longest pause of the learner {pause_s:.1f} s (at most {SAMPLING_PAUSE_S:g} + a report); shard back "
        f"after {back_s:.1f} s; {max(0.0, stored - left):g} of {stored:g} stored steps lost; no worker lost",
        holds=pause_s <= SAMPLING_PAUSE_S + REPORT_S and run.value("worker_restarts_total/crash") == workers_lost,
    )


def all_shards_killed(run: LiveRun, rng: np.random.Generator) -> Observation:
    """Every shard, and every snapshot gone."""
    count, needed = run.config.replay.num_shards, run.config.replay.min_steps
    restarts = run.value("replay_restarts_total/crash")
    began = time.monotonic()
    for index in range(count):
        shutil.rmtree(run.checkpoints / "replay" / f"shard-{index:02d}", ignore_errors=True)
    run.kill(*(f"shard {index}" for index in rng.permutation(count)))
    run.until(lambda m: m["replay_restarts_total/crash"] == restarts + count, "new shards", 120)
    run.until(lambda m: m["replay_shards_alive_count"] == count, "their answers", 120)
    run.more_updates(20, 120)
    took_s = time.monotonic() - began
    lean = [m for m in run.tail.lines if m["seen_s"] > began and "replay_stored_steps" in m]
    short = [m for m in lean if m["replay_stored_steps"] < needed and m["replay_shards_alive_count"] == count]
    made = max((m["updates"] for m in short), default=0.0) - min((m["updates"] for m in short), default=0.0)
    return Observation(
        observed="paused until enough new steps were stored, then went on",
        figure=f"updates on fewer than {needed} steps {made:g}, in {len(short)} reports; updating again after "
        f"{took_s:.1f} s",
        holds=made == 0,
    )


def learner_killed(run: LiveRun, rng: np.random.Generator) -> Observation:
    """The learner, in the middle of an update."""
    run.until(lambda _: any(run.checkpoints.glob("updates-*")), "a checkpoint")
    run.more_updates(int(rng.integers(20, 80)))
    lost, version = run.value("learner_restarts_total/crash"), run.value("weights_version")
    updates, began = run.value("updates"), time.monotonic()
    run.kill("learner")
    run.until(lambda m: m["learner_restarts_total/crash"] == lost + 1, "a new learner")
    gone = updates - run.value("updates")
    run.more_updates(20)
    took_s, every = time.monotonic() - began, run.config.checkpoint.every_updates
    run.until(lambda m: m["weights_version"] > version, "weights of a higher version")
    return Observation(
        observed="replaced, went on from its last checkpoint; versions went on upward",
        figure=f"updating again after {took_s:.1f} s (at most {LEARNER_BACK_S:g}); {max(0.0, gone):g} updates lost "
        f"(at most {every} and those of one report)",
        holds=took_s <= LEARNER_BACK_S and gone <= 2 * every,
    )
