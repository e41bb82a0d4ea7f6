"""Cost as the work grows: stored steps, shards and workers; where the next wall is."""

import threading
import time
from dataclasses import replace

import numpy as np

from slotfilm_dist.bench.agent import bench_config
from slotfilm_dist.bench.contender import Contender, ContenderError, missing
from slotfilm_dist.bench.filled_shards import rows_per_s, shards_in_process
from slotfilm_dist.bench.results import BenchOptions, BenchResult, at_most, for_information
from slotfilm_dist.bench.rounds import interleave
from slotfilm_dist.cluster.hub_client import HubClient
from slotfilm_dist.cluster.messages import BlockKey, BlockNotice
from slotfilm_dist.cluster.session import Session
from slotfilm_dist.config import RunConfig

STEPS = (10_000, 100_000, 1_000_000)
SHARDS = (1, 4, 16, 64)
WORKERS = (1, 8, 32, 128)
GOAL_GB = 5.9
"""1 M token steps at 5.4 KB a frame, state, action and the spare rows of blocks and episodes."""


def run(options: BenchOptions) -> list[BenchResult]:
    """Stored steps, then shards, then workers at the hub."""
    return [*_stored(options), *_shards(options), *_workers(options)]


def _stored(options: BenchOptions) -> list[BenchResult]:
    """Sampling and peak memory with ever more steps in one shard, each in a process of its own."""
    rows: list[BenchResult] = []
    for steps in STEPS[: 2 if options.quick else None]:
        try:
            with Contender("filled_ring", {"num_steps": steps}) as child:
                rates = [child.ask("measure", num_requests=options.scaled(20)) for _ in range(options.rounds)]
                gigabytes = child.ask("peak_memory_gb")
        except ContenderError as error:
            rows.append(missing(f"scale/memory of {steps} stored token steps", None, "GB", error))
            continue
        how = f"one shard in process holding {steps} token steps, {min(rates):.3g} to {max(rates):.3g} rows/s"
        rows.append(
            for_information(f"scale/sampling from {steps} stored steps", float(np.median(rates)), "rows/s", how)
        )
        name = f"scale/peak memory of {steps} stored token steps"
        text = "growth of the process's largest resident size while it was filled and sampled from"
        largest = steps == STEPS[-1]
        rows.append(
            at_most(name, gigabytes, GOAL_GB, "GB", text) if largest else for_information(name, gigabytes, "GB", text)
        )
    return rows


def _shards(options: BenchOptions) -> list[BenchResult]:
    """Sampling over ever more shards of one process: what splitting and joining batches costs."""
    config = bench_config()
    stores = {str(count): shards_in_process(config, 6_400, count) for count in SHARDS}
    size = config.sac.batch_size
    rounds = interleave(
        {name: lambda store=store: rows_per_s([store], options.scaled(20), 8, size) for name, store in stores.items()},
        options.rounds,
    )
    return [
        for_information(
            f"scale/{name} shards against 1",
            rounds.ratio(name, "1").median,
            "times",
            f"rows/s, 8 batches of {size} a request, all shards in one process: {rounds.describe(name, '1', 'rows/s')}",
        )
        for name in stores
        if name != "1"
    ]


def _workers(options: BenchOptions) -> list[BenchResult]:
    """Blocks a second that the hub admits from ever more workers, and how long each waits for its answer."""
    base = bench_config()
    config = replace(
        base,
        schedule=replace(base.schedule, total_steps=1_000_000_000, random_steps=1),
        replay=replace(base.replay, min_steps=1_000_000),
    )
    session = Session()
    rows: list[BenchResult] = []
    try:
        hub = HubClient.launch(config, "slotfilm-bench-scale", {})
        hub.count_random_steps(1)
        for index, count in enumerate(WORKERS):
            rate, waits = _admissions(hub, config, index, count, options.scaled(400))
            low, median, high = (1000 * float(np.quantile(waits, q)) for q in (0.05, 0.5, 0.99))
            how = (
                f"{count} workers (threads of one process, each sends its next block's notice as soon as the last one "
                f"is admitted), one hub; a notice takes {median:.1f} ms (5 % below {low:.1f}, 1 % above {high:.1f})"
            )
            rows.append(for_information(f"scale/blocks admitted from {count} workers", rate, "blocks/s", how))
    finally:
        session.close()
    return rows


def _admissions(hub: HubClient, config: RunConfig, group: int, count: int, total: int) -> tuple[float, list[float]]:
    """Blocks admitted a second, and the seconds that each admission took."""
    waits: list[float] = []

    def work(worker: int) -> None:
        for sequence in range(max(1, total // count)):
            key = BlockKey(worker_id=1000 * group + worker, incarnation=0, sequence=sequence)
            began = time.perf_counter()
            hub.admit_steps(
                BlockNotice(key=key, num_steps=config.runtime.block_steps, policy_version=0, episodes=()), [], 60.0
            )
            waits.append(time.perf_counter() - began)
            hub.confirm([key])

    threads = [threading.Thread(target=work, args=(worker,)) for worker in range(count)]
    began = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return len(waits) / (time.perf_counter() - began), waits
