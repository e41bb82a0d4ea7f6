"""Replay filled with made-up token steps: in process, and as shards on a private Ray cluster."""

import contextlib
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from slotfilm_dist.bench.transitions import ACTION_DIM, BACKBONE, TOKEN_SHAPE, token_block
from slotfilm_dist.cluster.replay_client import ReplayClient, ShardClient
from slotfilm_dist.cluster.session import Session
from slotfilm_dist.config import RunConfig
from slotfilm_dist.contracts import ReplayStore
from slotfilm_dist.messages import SampleBatch, TransitionBlock
from slotfilm_dist.replay.schema import ReplaySchema
from slotfilm_dist.replay.shard import ReplayShard
from slotfilm_dist.replay.sharded import ShardedReplay

BLOCK_STEPS = 100
WORKERS = 8
"""Workers whose blocks these are; how blocks spread over shards depends on it."""


class LockedStore:
    """A store that several threads share; one at a time is inside, as in a shard's process."""

    def __init__(self, store: ShardedReplay) -> None:
        self._store, self._lock = store, threading.Lock()

    def insert(self, block: TransitionBlock) -> bool:
        """Store a block."""
        with self._lock:
            return self._store.insert(block)

    def sample(self, num_batches: int, batch_size: int) -> list[SampleBatch]:
        """Draw batches."""
        with self._lock:
            return self._store.sample(num_batches, batch_size)

    def num_steps(self) -> int:
        """Steps stored now."""
        with self._lock:
            return self._store.num_steps()


def token_schema(config: RunConfig) -> ReplaySchema:
    """Rows of the proposed agent."""
    return ReplaySchema(
        visual_kind="tokens",
        visual_shape=TOKEN_SHAPE,
        proprio_dim=config.obs.state_dim,
        action_dim=ACTION_DIM,
        num_objects=config.obs.num_objects,
        backbone_hash=BACKBONE,
    )


def blocks(config: RunConfig, num_steps: int) -> Iterator[TransitionBlock]:
    """Blocks of that many steps in all; all have the same content."""
    made = token_block(np.random.default_rng(0), 0, 0, BLOCK_STEPS, config.obs.state_dim)
    for index in range(num_steps // BLOCK_STEPS):
        yield replace(made, worker_id=index % WORKERS, sequence=index // WORKERS)


def shards_in_process(config: RunConfig, num_steps: int, num_shards: int = 1) -> ShardedReplay:
    """Filled shards of this process."""
    shards = [
        ReplayShard(
            token_schema(config),
            -(-num_steps // num_shards),
            seed=index,
            index=index,
            num_shards=num_shards,
            block_steps=BLOCK_STEPS,
        )
        for index in range(num_shards)
    ]
    store = ShardedReplay(shards, 0)
    for block in blocks(config, num_steps):
        store.insert(block)
    return store


@contextlib.contextmanager
def shards_on_ray(config: RunConfig, num_steps: int) -> Iterator[list[ShardClient]]:
    """Filled shards, `replay.num_shards` processes of a private cluster."""
    count = config.replay.num_shards
    config = replace(config, replay=replace(config.replay, capacity=num_steps + BLOCK_STEPS * count))
    session = Session()
    shards: list[ShardClient] = []
    try:
        with tempfile.TemporaryDirectory() as folder:
            shards += [
                ShardClient.launch(
                    config, token_schema(config), index, Path(folder) / str(index), resume=False, resources={}
                )
                for index in range(count)
            ]
            client_of(shards, 0).insert_all(blocks(config, num_steps))
            yield shards
    finally:
        for shard in shards:
            shard.kill()
        session.close()


def client_of(shards: Sequence[ShardClient], seed: int) -> ReplayClient:
    """One role's own view of all shards."""
    return ReplayClient(shards, np.random.SeedSequence(seed))


def rows_per_s(stores: Sequence[ReplayStore], num_requests: int, batches_per_request: int, batch_size: int) -> float:
    """Rows a second that clients sample, each in a thread of its own with a store of its own."""

    def work(store: ReplayStore) -> None:
        for _ in range(num_requests):
            store.sample(batches_per_request, batch_size)

    began = time.perf_counter()
    with ThreadPoolExecutor(len(stores)) as pool:
        list(pool.map(work, stores))
    return len(stores) * num_requests * batches_per_request * batch_size / (time.perf_counter() - began)
