"""A long run with a kill every half minute: does anything grow, and does the ratio of updates to steps hold?"""

import math
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import psutil

from slotfilm_dist.chaos.live import LiveRun, live_config
from slotfilm_dist.chaos.outcome import Observation, Outcome, UnexpectedError
from slotfilm_dist.cluster.hub_client import HubClient
from slotfilm_dist.cluster.session import namespace_of

KILL_EVERY_S = 30.0
LOOK_EVERY_S = 2.0
WARM_S = 60.0
"""Growth is measured from then on: imports and first allocations are over."""
RSS_SLOPE = 1.0
"""Largest growth of a process in MB a minute."""
WINDOW_STEPS = 10_000
"""Environment steps over which the ratio is measured."""
RATIO_ERROR = 0.01
"""Largest relative error of the ratio in any window."""


def soak(folder: Path, minutes: float, seed: int, environment: str) -> Outcome:
    """Train for so many minutes and kill a worker or a shard every half minute.

    Memory is followed in the processes that are never killed: learner, hub and this driver.
    """
    run, rng = LiveRun(folder / "soak", live_config(seed), environment), np.random.default_rng(seed)
    with run.running():
        try:
            seen = _follow(run, rng, minutes)
        except UnexpectedError as error:
            seen = Observation(observed=str(error), figure="none", holds=False)
    return Outcome(
        fault=f"soak, {minutes:g} min, a kill every {KILL_EVERY_S:g} s",
        expected="learning goes on; no process grows by more than 1 MB/min; open files stay; ratio within 1 %",
        observed=seen.observed,
        figure=seen.figure,
        holds=seen.holds,
    )


def _follow(run: LiveRun, rng: np.random.Generator, minutes: float) -> Observation:
    began = time.monotonic()
    ids = run.backend.process_ids()
    followed = {name: psutil.Process(ids[name]) for name in ("learner", "hub")} | {"driver": psutil.Process()}
    looks: dict[str, list[tuple[float, float, int]]] = {name: [] for name in followed}
    hub = HubClient.find(namespace_of(run.folder / "run"))
    counted = [_counters(hub)]
    kills, next_kill, updates = 0, KILL_EVERY_S, run.value("updates")
    roles = [name for name in ids if name not in ("learner", "hub")]
    while (elapsed := time.monotonic() - began) < 60 * minutes:
        for name, process in followed.items():
            looks[name].append((elapsed / 60, process.memory_info().rss / 2**20, process.num_fds()))
        counted.append(_counters(hub))
        if elapsed >= next_kill:
            run.kill(str(rng.choice(roles)))
            kills, next_kill = kills + 1, next_kill + KILL_EVERY_S
        run.until(lambda m, end=elapsed: time.monotonic() - began > end + LOOK_EVERY_S, "time to look again")
    run.more_updates(20)
    error = worst_ratio_error(counted, run.config.schedule.updates_per_step)
    slopes = {name: _slope(rows) for name, rows in looks.items()}
    files = {name: (rows[len(rows) // 2][2], rows[-1][2]) for name, rows in looks.items()}
    grown = ", ".join(f"{name} {slope:+.2f}" for name, slope in slopes.items())
    return Observation(
        observed=f"{kills} kills, {run.value('updates') - updates:g} updates",
        figure=f"MB/min after the first minute: {grown} (at most {RSS_SLOPE:g}); open files at half and at the end: "
        + ", ".join(f"{name} {half} -> {end}" for name, (half, end) in files.items())
        + f"; updates per step in windows of {WINDOW_STEPS} steps: off by {100 * error:.2f} % at most",
        holds=all(slope <= RSS_SLOPE for slope in slopes.values())
        and error <= RATIO_ERROR  # which NaN is not: what was not measured does not hold
        and all(end <= half + 8 for half, end in files.values()),
    )


def _slope(rows: list[tuple[float, float, int]]) -> float:
    """MB a minute, by least squares, without the time to warm up where there is enough beside it."""
    late = [row for row in rows if row[0] >= WARM_S / 60]
    used = late if len(late) > 5 else rows
    return float(np.polyfit([row[0] for row in used], [row[1] for row in used], 1)[0])


def _counters(hub: HubClient) -> tuple[int, int]:
    """Environment steps admitted and updates granted, of one moment."""
    status = hub.status()
    return status.admitted_steps, status.updates


def worst_ratio_error(counted: Sequence[tuple[int, int]], ratio: float) -> float:
    """Largest relative error of updates per step over `WINDOW_STEPS` or a little more; NaN for too short a run.

    Args:
        counted: environment steps and updates, again and again.
        ratio: what there should be.
    """
    errors, first = [], 0
    for steps, updates in counted:
        while first + 1 < len(counted) and steps - counted[first + 1][0] >= WINDOW_STEPS:
            first += 1
        made, wanted = updates - counted[first][1], ratio * (steps - counted[first][0])
        if steps - counted[first][0] >= WINDOW_STEPS:
            errors.append(abs(made / wanted - 1))
    return max(errors, default=math.nan)
