"""Faults inside the processes of a live run: hangs, bad numbers, a full disk, lost weights."""

import math
import os
import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from slotfilm_dist.chaos.live import STEP_LIMIT_S, LiveRun
from slotfilm_dist.chaos.outcome import Observation
from slotfilm_dist.learning.checkpoint import CheckpointStore
from slotfilm_dist.learning.learner import learning_hash

FOREVER_S = 3600.0
DETECTED_S = 5.0
"""Time beyond the limit of a step within which a hang is noticed."""
MEASURE_S = 10.0


def hang_in_step(run: LiveRun, rng: np.random.Generator) -> Observation:
    """A step that never returns."""
    run.switches.arm("hang_step", FOREVER_S)
    return _hang(run)


def hang_in_reset(run: LiveRun, rng: np.random.Generator) -> Observation:
    """A reset that never returns; a NaN reward brings it about."""
    run.switches.arm("hang_reset", FOREVER_S)
    run.switches.arm("nan_reward")
    return _hang(run)


def _hang(run: LiveRun) -> Observation:
    hangs = run.value("worker_restarts_total/hang")
    took_s = run.until(lambda m: m.get("worker_restarts_total/hang", 0) > hangs, "a killed worker", 60)
    back_s = run.until(lambda m: m["worker_alive_count"] == 2, "a new worker")
    run.more_steps(200)
    return Observation(
        observed="killed by the watchdog, counted as a hang, replaced",
        figure=f"detected after {took_s:.1f} s (at most {STEP_LIMIT_S:g} + {DETECTED_S:g}); back {back_s:.1f} s later",
        holds=took_s <= STEP_LIMIT_S + DETECTED_S,
    )


def straggler(run: LiveRun, rng: np.random.Generator) -> Observation:
    """One worker ten times slower."""
    before = _rate(run)
    run.switches.arm("slow", 10.0)
    run.until(lambda _: run.switches.taken("slow"), "a slow worker")
    after = _rate(run)
    run.switches.disarm("slow")
    loss, share = 1 - after / before, 1 / run.config.runtime.num_workers
    return Observation(
        observed="the other worker was not held up",
        figure=f"{before:.0f} -> {after:.0f} steps/s: {max(0.0, loss):.0%} lost (at most its share {share:.0%} + 5 %)",
        holds=loss <= share + 0.05,
    )


def _rate(run: LiveRun) -> float:
    steps, began = run.value("env_steps"), time.monotonic()
    run.until(lambda m: time.monotonic() - began > MEASURE_S, "time to measure")
    return (run.value("env_steps") - steps) / (time.monotonic() - began)


def nan_reward(run: LiveRun, rng: np.random.Generator) -> Observation:
    """Single rewards and states that are not finite."""
    rejected, cut = run.value("worker_nonfinite_total"), run.value("worker_cut_episodes_total")
    broken = run.value("learner_nonfinite_total")
    run.switches.arm("nan_reward", count=2)
    run.switches.arm("nan_state", count=2)
    run.until(lambda m: m["worker_nonfinite_total"] >= rejected + 4, "four rejected steps")
    run.more_steps(400)
    broken = run.value("learner_nonfinite_total") - broken
    cut = run.value("worker_cut_episodes_total") - cut
    return Observation(
        observed="the steps were left out, their episodes cut short, the workers went on",
        figure=f"{run.value('worker_nonfinite_total') - rejected:g} of 4 counted; {cut:g} episodes cut; non-finite "
        f"updates {broken:g}",
        holds=run.value("worker_nonfinite_total") == rejected + 4 and cut == 4 and broken == 0,
    )


def broken_environment(run: LiveRun, rng: np.random.Generator) -> Observation:
    """An environment that gives nothing but NaN."""
    before, broken = run.value("worker_restarts_total/nonfinite"), run.value("learner_nonfinite_total")
    run.switches.arm("nan_reward", count=40)
    took_s = run.until(lambda m: m.get("worker_restarts_total/nonfinite", 0) > before, "a worker given up")
    run.switches.disarm("nan_reward")
    run.until(lambda m: m["worker_alive_count"] == 2, "a new worker")
    run.more_steps(200)
    broken = run.value("learner_nonfinite_total") - broken
    return Observation(
        observed="its worker was given up and replaced, with that reason",
        figure=f"replaced after {took_s:.1f} s; non-finite updates {broken:g}",
        holds=broken == 0,
    )


def nan_gradient(run: LiveRun, rng: np.random.Generator) -> Observation:
    """Losses that are NaN, fewer in a row than end in a return to a checkpoint."""
    skipped, rolled = run.value("learner_nonfinite_total"), run.value("learner_rollbacks_total")
    run.switches.arm("first_reward", math.nan, count=4)
    run.until(lambda m: m["learner_nonfinite_total"] >= skipped + 4, "four skipped updates")
    run.more_updates(50)
    skipped = run.value("learner_nonfinite_total") - skipped
    return Observation(
        observed="the updates were skipped and counted; learning went on",
        figure=f"{skipped:g} skipped; losses finite after: {math.isfinite(run.value('learner_critic_loss'))}; returns "
        f"to a checkpoint {run.value('learner_rollbacks_total') - rolled:g}",
        holds=run.value("learner_rollbacks_total") == rolled and run.value("learner_critic_loss") > 0,
    )


def diverged(run: LiveRun, rng: np.random.Generator) -> Observation:
    """Ten losses in a row that are not finite."""
    run.until(lambda _: any(run.checkpoints.glob("updates-*")), "a checkpoint")
    rolled, version = run.value("learner_rollbacks_total"), run.value("weights_version")
    run.switches.arm("reward", math.nan, count=4)
    run.until(lambda m: m["learner_rollbacks_total"] > rolled, "a return to a checkpoint")
    run.switches.disarm("reward")
    run.more_updates(50)
    run.until(lambda m: m["weights_version"] > version, "weights of a higher version")
    return Observation(
        observed="went back to the last checkpoint with half the rates, and on from there",
        figure=f"returns {run.value('learner_rollbacks_total') - rolled:g}; versions went on upward",
        holds=run.value("learner_critic_loss") > 0,
    )


def weights_lost(run: LiveRun, rng: np.random.Generator) -> Observation:
    """Weights that do not arrive for a while."""
    run.switches.arm("lose_weights")
    run.until(lambda _: run.switches.taken("lose_weights"), "a lost snapshot")
    run.until(lambda _: True, "a report")
    began, first = time.monotonic(), run.value("weights_age_s")
    until = began + MEASURE_S
    run.until(lambda m: time.monotonic() > until, "time to measure")
    run.until(lambda m: m["weights_age_s"] > first, "an age that grows")
    seen = max(line["seen_s"] for line in run.tail.lines if "weights_age_s" in line)
    grown, passed = run.value("weights_age_s") - first, seen - began
    run.switches.disarm("lose_weights")
    run.until(lambda m: m["weights_age_s"] < MEASURE_S / 2, "fresh weights")
    return Observation(
        observed="the workers went on with the old version, whose age was reported; fresh weights were taken over",
        figure=f"in {passed:.1f} s the age grew by {grown:.1f} s (within 1 s and a report)",
        holds=abs(grown - passed) <= 2.0,
    )


def disk_full(run: LiveRun, rng: np.random.Generator) -> Observation:
    """No room for checkpoints."""
    run.until(lambda _: any(run.checkpoints.glob("updates-*")), "a checkpoint")
    failed = run.value("checkpoint_failed_total")
    with _no_room(run):
        run.until(lambda m: m.get("checkpoint_failed_total", 0) > failed, "a checkpoint that fails", 120)
        left = [path.name for path in run.checkpoints.glob("*.partial")]  # now: the next try begins in some seconds
        run.more_updates(50)
        store = CheckpointStore(run.checkpoints, run.config.checkpoint.keep)
        readable = store.read_last(learning_hash(run.config)) is not None
    written = run.value("checkpoint_written_total")
    run.until(lambda m: m["checkpoint_written_total"] > written, "a checkpoint that succeeds", 120)
    how = "full file system, ENOSPC" if run.disk_is_small else "limit on file sizes, EFBIG"
    return Observation(
        observed="the checkpoint failed with an alert, the one before stayed, training went on, the next one succeeded",
        figure=f"{how}; {run.value('checkpoint_failed_total') - failed:g} failed; readable checkpoint {readable}; "
        f"temporary files left {len(left)}",
        holds=readable and not left,
    )


@contextmanager
def _no_room(run: LiveRun) -> Iterator[None]:
    """Fill the checkpoints' own file system, or limit the size of the learner's files where there is none."""
    if run.disk_is_small:
        ballast = run.checkpoints / "ballast"
        _fill(ballast)
        try:
            yield
        finally:
            ballast.unlink()
        return
    learner = run.backend.process_ids()["learner"]
    before = resource.prlimit(learner, resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
    try:
        yield
    finally:
        resource.prlimit(learner, resource.RLIMIT_FSIZE, before)


def _fill(path: Path) -> None:
    with path.open("wb", buffering=0) as file:
        for size in (1 << 20, 1 << 12):
            try:
                while True:
                    os.write(file.fileno(), bytes(size))
            except OSError:
                continue
