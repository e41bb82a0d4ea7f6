"""Sampling from replay: shards on Ray against TorchRL's buffer on Ray, and in process against cpprb."""

from dataclasses import replace

from slotfilm_dist.bench.agent import bench_config
from slotfilm_dist.bench.contender import Contender, ContenderError, missing
from slotfilm_dist.bench.filled_shards import LockedStore, client_of, rows_per_s, shards_in_process, shards_on_ray
from slotfilm_dist.bench.results import BenchOptions, BenchResult, at_least
from slotfilm_dist.bench.rounds import Rounds, interleave
from slotfilm_dist.config import RunConfig

GOAL_TORCHRL, GOAL_CPPRB = 3.0, 0.7
NUM_ROWS = 20_000
CHUNK = 8
"""Batches that the learner asks for in one request."""
CLIENTS = (1, 4)
WHAT = f"rows sampled a second in batches of 128 from {NUM_ROWS} token steps (5.4 KB a frame, two frames a row), "


def run(options: BenchOptions) -> list[BenchResult]:
    """Both comparisons, with 1 and 4 clients."""
    config = bench_config()
    config = replace(config, replay=replace(config.replay, num_shards=2, min_steps=1000))
    rows: list[BenchResult] = []
    for compare in (_against_cpprb, _against_torchrl):
        rows += compare(config, options)
    return rows


def _against_torchrl(config: RunConfig, options: BenchOptions) -> list[BenchResult]:
    def name(clients: int) -> str:
        return f"replay/shards against TorchRL's Ray buffer, {_counted(clients)}"

    size, requests = config.sac.batch_size, options.scaled(20)
    arguments = {"num_rows": NUM_ROWS, "batch_size": size}
    try:
        with (
            Contender("peers.torchrl_replay", arguments, peer=True) as peer,
            shards_on_ray(config, NUM_ROWS) as shards,
        ):
            results = []
            for count in CLIENTS:
                stores = [client_of(shards, seed) for seed in range(count)]
                rounds = interleave(
                    {
                        "ours": lambda s=stores: rows_per_s(s, requests, CHUNK, size),
                        "TorchRL": lambda n=count: peer.ask(num_clients=n, num_batches=2 * requests),
                    },
                    options.rounds,
                )
                how = f"{WHAT}2 shards in processes of a private Ray cluster, {CHUNK} batches a request as the learner "
                how += "asks, against RayReplayBuffer (LazyTensorStorage, its clients, one batch a request): "
                results.append(_row(name(count), rounds, "TorchRL", GOAL_TORCHRL, how))
            return results
    except ContenderError as error:
        return [missing(name(count), GOAL_TORCHRL, "times", error) for count in CLIENTS]


def _against_cpprb(config: RunConfig, options: BenchOptions) -> list[BenchResult]:
    def name(clients: int) -> str:
        return f"replay/shard in process against cpprb, {_counted(clients)}"

    size, requests = config.sac.batch_size, options.scaled(20)
    store = LockedStore(shards_in_process(config, NUM_ROWS))
    try:
        with Contender("peers.cpprb_replay", {"num_rows": NUM_ROWS, "batch_size": size}, peer=True) as peer:
            results = []
            for count in CLIENTS:
                rounds = interleave(
                    {
                        "ours": lambda n=count: rows_per_s([store] * n, requests, CHUNK, size),
                        "cpprb": lambda n=count: peer.ask(num_clients=n, num_batches=CHUNK * requests),
                    },
                    options.rounds,
                )
                how = f"{WHAT}one shard in process against cpprb's ReplayBuffer (next_of for frames); clients are "
                how += "threads: "
                results.append(_row(name(count), rounds, "cpprb", GOAL_CPPRB, how))
            return results
    except ContenderError as error:
        return [missing(name(count), GOAL_CPPRB, "times", error) for count in CLIENTS]


def _row(name: str, rounds: Rounds, peer: str, goal: float, how: str) -> BenchResult:
    return at_least(
        name, rounds.ratio("ours", peer).median, goal, "times", how + rounds.describe("ours", peer, "rows/s")
    )


def _counted(clients: int) -> str:
    return f"{clients} client" + "s" * (clients > 1)
