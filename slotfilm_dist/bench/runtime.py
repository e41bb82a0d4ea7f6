"""What the processes and messages of a run on Ray cost: learner, workers, weights, calls."""

import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from slotfilm_dist.backend import TrainReport
from slotfilm_dist.bench.agent import bench_config, learner_for
from slotfilm_dist.bench.fetching import fetched_batches
from slotfilm_dist.bench.filled_shards import client_of, shards_in_process, shards_on_ray
from slotfilm_dist.bench.results import BenchOptions, BenchResult, at_least, for_information
from slotfilm_dist.bench.rounds import Rounds, Spread, interleave
from slotfilm_dist.bench.timing import calls_per_s
from slotfilm_dist.bench.toy_data import write_toy_data
from slotfilm_dist.bench.transitions import ACTION_DIM
from slotfilm_dist.cluster.backend import RayBackend
from slotfilm_dist.cluster.hub_client import HubClient
from slotfilm_dist.cluster.learner_role import LearnerRole
from slotfilm_dist.cluster.messages import AgentSetup, UpdateGrant
from slotfilm_dist.cluster.session import Session
from slotfilm_dist.cluster.worker import EnvFactory
from slotfilm_dist.config import RunConfig
from slotfilm_dist.envs.toy import SLOW_STEP_S, make_slow_toy_env, make_toy_env
from slotfilm_dist.machine import usable_cores
from slotfilm_dist.messages import WeightSnapshot
from slotfilm_dist.policy import AgentPolicy
from slotfilm_dist.variants import apply_variant

GOAL_FED, GOAL_SCALING = 0.9, 1.8
STORED = 20_000


class UnlimitedHub:
    """Grants every update at once and drops the weights: what is left is the time of replay and learner."""

    def admit_updates(self, max_updates: int, timeout_s: float) -> UpdateGrant:
        """All that is asked for."""
        return UpdateGrant(num_updates=max_updates, waited_s=0.0, waiting_for="")

    def refund_updates(self, num_updates: int) -> None:
        """Nothing is counted."""

    def start_over(self, missing_steps: int) -> None:
        """Nothing is counted."""

    def publish(self, snapshot: WeightSnapshot) -> None:
        """Nobody acts."""

    def set_up_agents(self, setup: AgentSetup) -> None:
        """Nobody acts."""

    def newest_version(self) -> int:
        """Nothing was published."""
        return -1


def run(options: BenchOptions) -> list[BenchResult]:
    """Each on a private Ray cluster of its own."""
    torch.set_num_threads(1)
    base = bench_config()
    config = replace(
        base,
        env=replace(base.env, max_steps=100),
        schedule=replace(base.schedule, total_steps=10_000_000, random_steps=240, updates_per_step=1.0),
        replay=replace(base.replay, num_shards=1, min_steps=200, capacity=50_000),
        runtime=replace(base.runtime, num_workers=1, learner_threads=1, device="cpu", metrics_port=0),
    )
    with tempfile.TemporaryDirectory() as folder:
        data = write_toy_data(config, Path(folder))
        return [
            _fed_learner(config, data, options),
            fetched_batches(config, options),
            *_worker_scaling(config, data, Path(folder), options),
            *_messages(config, options),
        ]


def _fed_learner(config: RunConfig, data: Path, options: BenchOptions) -> BenchResult:
    """Updates a second with batches from a shard's process, against a shard in the learner's own process."""
    size, seconds = config.sac.batch_size, 0.5 if options.quick else 4.0
    alone, store = learner_for(config), shards_in_process(config, STORED)
    with shards_on_ray(config, STORED) as shards:
        role = LearnerRole(config, ACTION_DIM, torch.device("cpu"), UnlimitedHub())
        role.begin(data, None, None)
        role.connect(client_of(shards, 0))

        def fed() -> float:
            role.start()
            try:
                time.sleep(0.3)
                before, began = role.learner.updates, time.perf_counter()
                time.sleep(seconds)
                return (role.learner.updates - before) / (time.perf_counter() - began)
            finally:
                role.stop(10.0)

        def in_process() -> float:
            count = options.scaled(200)
            return calls_per_s(lambda: alone.update(store.sample(1, size)[0]), count)

        rounds = interleave({"Ray-fed": fed, "in process": in_process}, options.rounds)
    how = (
        f"updates/s at batch {size} on tokens, learner with one thread; one shard's process, fetcher and updater "
        "threads as in a run and no limiter, against sampling and updating in turn in one process: "
    )
    described = rounds.describe("Ray-fed", "in process", "updates/s")
    ratio = rounds.ratio("Ray-fed", "in process").median
    return at_least("runtime/Ray-fed learner against in-process", ratio, GOAL_FED, "times", how + described)


def _worker_scaling(config: RunConfig, data: Path, folder: Path, options: BenchOptions) -> list[BenchResult]:
    """Env steps a second of two workers over one's: where a step waits for its environment, and where it computes."""
    how = (
        "env steps/s on Ray with the toy environment, workers added and removed during one run, a learner that has "
        "next to nothing to do; "
    )
    blind = apply_variant("state_only", config)
    waits = _two_against_one(blind, write_toy_data(blind, folder), folder / "waiting", make_slow_toy_env, options)
    computes = _two_against_one(config, data, folder / "computing", make_toy_env, options)
    waiting = f"each step waits {1000 * SLOW_STEP_S:.0f} ms and computes 1 to 2, state_only; cores are not short: "
    computing = (
        "backbone and policy on a 128 x 128 picture in every step, one thread a worker, on the "
        f"{usable_cores():.0f} cores of learner, hub and shard: "
    )
    return [
        at_least(
            "runtime/2 workers against 1",
            waits.ratio("2 workers", "1 worker").median,
            GOAL_SCALING,
            "times",
            how + waiting + waits.describe("2 workers", "1 worker", "steps/s"),
        ),
        for_information(
            "runtime/2 workers against 1, computing",
            computes.ratio("2 workers", "1 worker").median,
            "times",
            how + computing + computes.describe("2 workers", "1 worker", "steps/s"),
        ),
    ]


def _two_against_one(config: RunConfig, data: Path, run: Path, make_env: EnvFactory, options: BenchOptions) -> Rounds:
    # Small blocks: steps are counted when a block is stored.
    config = replace(
        config,
        schedule=replace(config.schedule, updates_per_step=0.001),
        runtime=replace(config.runtime, block_steps=8),
    )
    run.mkdir()
    seconds = 1 if options.quick else 8
    backend = RayBackend(config, run, make_env)
    try:
        backend.prepare()
        backend.begin_training(data, None, None)
        reports = backend.train(lambda: False)
        rounds = interleave(
            {
                "2 workers": lambda: _collecting(backend, reports, 2, seconds),
                "1 worker": lambda: _collecting(backend, reports, 1, seconds),
            },
            min(3, options.rounds),
        )
        reports.close()  # type: ignore[attr-defined]  # it is a generator
    finally:
        backend.close()
    return rounds


def _collecting(backend: RayBackend, reports: Iterator[TrainReport], num_workers: int, seconds: int) -> float:
    """Env steps a second once so many workers run."""
    backend.want_workers(num_workers)
    for report in reports:
        if report.metrics["worker_alive_count"] == num_workers:
            break
    next(reports)
    first, began = next(reports).env_steps, time.perf_counter()
    last = first
    for _ in range(seconds):
        last = next(reports).env_steps
    return (last - first) / (time.perf_counter() - began)


def _messages(config: RunConfig, options: BenchOptions) -> list[BenchResult]:
    """Calls of the hub, and the way of weights to a policy."""
    session = Session()
    try:
        hub = HubClient.launch(config, "slotfilm-bench", {})
        hub.status()
        learner = learner_for(config)
        policy = AgentPolicy(learner.encoder, learner.rl.actor, np.random.SeedSequence(0))
        waits = [_publish_and_apply(hub, learner.snapshot(), policy, version) for version in range(1, 31)]
        calls = [calls_per_s(hub.status, options.scaled(300)) for _ in range(options.rounds)]
    finally:
        session.close()
    wait, rate = (Spread(median=float(np.median(x)), low=min(x), high=max(x)) for x in (waits, calls))
    return [
        for_information(
            "runtime/weights publish to applied",
            1000 * wait.median,
            "ms",
            f"from the learner's publication to a policy that acts with the weights, over the hub's process, {wait} s; "
            f"workers ask once a block, so up to a block's {config.runtime.block_steps} steps come on top",
        ),
        for_information(
            "runtime/hub calls", rate.median, "messages/s", f"one client, one call after another, {rate} messages/s"
        ),
    ]


def _publish_and_apply(hub: HubClient, snapshot: WeightSnapshot, policy: AgentPolicy, version: int) -> float:
    """Seconds from publication to the policy's next action."""
    hub.publish(replace(snapshot, version=version, published_at_s=time.time()))
    while (received := hub.latest(version - 1)) is None:
        continue
    policy.load(received.version, received.arrays)
    return time.time() - received.published_at_s
