"""Another program takes the machine's memory while a run goes on."""

import contextlib
import multiprocessing
import time
from collections.abc import Iterator

import numpy as np

from slotfilm_dist.chaos.live import LiveRun
from slotfilm_dist.chaos.outcome import Observation
from slotfilm_dist.cluster.memory_guard import FIRST_HOLD_S
from slotfilm_dist.machine import used_memory_share

PIECE_BYTES = 64 << 20
BEYOND = 0.005
"""Share of the memory that the program takes beyond what the run leaves others."""
STOPPED_S = 10.0
"""Time from too little memory until a worker is stopped."""
OTHERS = ("learner_restarts_total/crash", "replay_restarts_total/crash", "worker_restarts_total/crash")


def short_memory(run: LiveRun, rng: np.random.Generator) -> Observation:
    """Until the machine has less than a run leaves free; it ends once a worker stands still."""
    limit = run.config.runtime.max_memory_share
    stopped, lost = run.value("worker_restarts_total/memory"), sum(map(run.value, OTHERS))
    with _memory_taken_to(limit + BEYOND):
        run.until(lambda _: used_memory_share() > limit, "too little memory")
        took_s = run.until(lambda m: m.get("worker_restarts_total/memory", 0) > stopped, "a stopped worker")
        run.until(lambda m: m["worker_alive_count"] == 1, "one worker less")
        run.more_updates(100)
        most = used_memory_share()
    began = time.monotonic()
    run.until(lambda m: m["worker_alive_count"] == 2, "the worker again", FIRST_HOLD_S + 60)
    back_s, lost = time.monotonic() - began, sum(map(run.value, OTHERS)) - lost
    return Observation(
        observed="a worker stood still, the other one and the learner went on; it came back",
        figure=f"stopped after {took_s:.1f} s (at most {STOPPED_S:g}), at {most:.1%} of the machine's memory (limit "
        f"{limit:.1%}); back {back_s:.0f} s after there was room; other processes lost {lost:g}",
        holds=took_s <= STOPPED_S and lost == 0,
    )


@contextlib.contextmanager
def _memory_taken_to(share: float) -> Iterator[None]:
    process = multiprocessing.get_context("spawn").Process(target=_take_memory, args=(share,), daemon=True)
    process.start()
    try:
        yield
    finally:
        process.kill()
        process.join()


def _take_memory(share: float) -> None:
    taken: list[bytes] = []
    while True:
        if used_memory_share() < share:
            taken.append(b"\1" * PIECE_BYTES)
        else:
            time.sleep(0.1)
