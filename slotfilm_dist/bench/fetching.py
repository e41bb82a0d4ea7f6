"""How many batches the way from the shards brings a learner that takes no time."""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

from slotfilm_dist.bench.filled_shards import client_of, shards_on_ray
from slotfilm_dist.bench.results import BenchOptions, BenchResult, for_information
from slotfilm_dist.bench.rounds import interleave
from slotfilm_dist.cluster.hub import chunk_updates
from slotfilm_dist.cluster.learning_loops import FETCHERS, GRANTS_AHEAD, BatchReserve
from slotfilm_dist.config import RunConfig
from slotfilm_dist.messages import SampleBatch

STORED = 20_000
NUM_SHARDS = 2


def fetched_batches(config: RunConfig, options: BenchOptions) -> BenchResult:
    """Batches a second when a request to the shards serves several grants, and when each grant has its own."""
    size, grant = config.sac.batch_size, chunk_updates(config.schedule.updates_per_step)
    seconds = 0.3 if options.quick else 4.0
    config = replace(config, replay=replace(config.replay, num_shards=NUM_SHARDS))
    with shards_on_ray(config, STORED) as shards:
        store = client_of(shards, 0)

        def ahead() -> Callable[[], list[SampleBatch]]:
            reserve = BatchReserve(store, size, GRANTS_AHEAD * grant)
            return lambda: reserve.take(grant, 0)

        def one_by_one() -> Callable[[], list[SampleBatch]]:
            return lambda: store.sample(grant, size)

        rounds = interleave(
            {"ahead": lambda: _rate(ahead, seconds), "one by one": lambda: _rate(one_by_one, seconds)}, options.rounds
        )
    how = (
        f"batches of {size} on tokens a second, {NUM_SHARDS} shards' processes, {FETCHERS} threads, no learner, a "
        f"request for {GRANTS_AHEAD} grants of {grant} updates against one each: "
    )
    ratio = rounds.ratio("ahead", "one by one").median
    return for_information(
        "runtime/batches drawn for several grants",
        ratio,
        "times",
        how + rounds.describe("ahead", "one by one", "batches/s"),
    )


def _rate(make_fetcher: Callable[[], Callable[[], list[SampleBatch]]], seconds: float) -> float:
    began = time.perf_counter()

    def work() -> int:
        take, count = make_fetcher(), 0
        while time.perf_counter() - began < seconds:
            count += len(take())
        return count

    with ThreadPoolExecutor(FETCHERS) as pool:
        counts = list(pool.map(lambda _: work(), range(FETCHERS)))
    return sum(counts) / (time.perf_counter() - began)
