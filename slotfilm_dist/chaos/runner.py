"""Carries out a plan: one live run for the faults of a live run, a folder of their own for all others."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from slotfilm_dist.chaos import driver_faults, file_faults, inner_faults, lost_processes
from slotfilm_dist.chaos.black_picture import black_picture
from slotfilm_dist.chaos.live import LiveRun, live_config
from slotfilm_dist.chaos.outcome import Observation, Outcome, UnexpectedError
from slotfilm_dist.chaos.plan import KINDS, FaultPlan, PlannedFault
from slotfilm_dist.chaos.short_memory import short_memory

LIVE: dict[str, Callable[[LiveRun, np.random.Generator], Observation]] = {
    act.__name__: act
    for act in (
        lost_processes.worker_killed,
        lost_processes.all_workers_killed,
        lost_processes.shard_killed,
        lost_processes.shard_killed_without_snapshot,
        lost_processes.all_shards_killed,
        lost_processes.learner_killed,
        inner_faults.hang_in_step,
        inner_faults.hang_in_reset,
        inner_faults.straggler,
        inner_faults.disk_full,
        inner_faults.nan_reward,
        inner_faults.broken_environment,
        inner_faults.nan_gradient,
        inner_faults.diverged,
        inner_faults.weights_lost,
        short_memory,
    )
}
ALONE: dict[str, Callable[[Path, np.random.Generator], Observation]] = {
    act.__name__: act
    for act in (
        driver_faults.preempted,
        driver_faults.driver_killed,
        driver_faults.interrupted_twice,
        driver_faults.two_drivers,
        driver_faults.port_taken,
        file_faults.flipped_bits,
        file_faults.malicious_pickle,
        file_faults.other_config,
        file_faults.wrong_setting,
        file_faults.missing_gpu,
        file_faults.missing_weights,
        black_picture,
    )
}
assert {*LIVE, *ALONE} == set(KINDS), "every kind of fault can be carried out"


def carry_out(plan: FaultPlan, folder: Path, environment: str, until_s: float = float("inf")) -> Iterator[Outcome]:
    """Bring a plan's faults about, one after the other; gives a row of the table for each.

    Args:
        plan: what happens.
        folder: empty; everything is written into it.
        environment: what the live run trains in, `toy` or `simulator`.
        until_s: no fault begins after this time of the monotonic clock.
    """
    for fault in (*plan.of("files"), *plan.of("driver")):
        if time.monotonic() < until_s:
            place = folder / fault.kind.name
            place.mkdir(parents=True)
            yield _outcome(fault, lambda f=fault, p=place: ALONE[f.kind.name](p, f.rng()))
    if plan.of("live") and time.monotonic() < until_s:
        yield from _carry_out_live(plan, folder / "live", environment, until_s)


def _carry_out_live(plan: FaultPlan, folder: Path, environment: str, until_s: float) -> Iterator[Outcome]:
    run = LiveRun(folder, live_config(plan.seed), environment)
    with run.running():
        for fault in plan.of("live"):
            if time.monotonic() < until_s:
                yield _outcome(fault, lambda f=fault: _happen(run, f))


def _happen(run: LiveRun, fault: PlannedFault) -> Observation:
    run.more_steps(fault.after_steps)
    return LIVE[fault.kind.name](run, fault.rng())


def _outcome(fault: PlannedFault, happen: Callable[[], Observation]) -> Outcome:
    kind = fault.kind
    try:
        seen = happen()
    except UnexpectedError as error:
        seen = Observation(observed=str(error), figure="none", holds=False)
    return Outcome(
        fault=kind.name, expected=kind.expected, observed=seen.observed, figure=seen.figure, holds=seen.holds
    )
