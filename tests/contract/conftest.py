"""Each contract's implementations: in this process, and behind a client in processes of a Ray cluster."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slotfilm_dist.cluster.hub import Hub, build_limiter
from slotfilm_dist.cluster.hub_client import HubClient
from slotfilm_dist.cluster.replay_client import ReplayClient, ShardClient
from slotfilm_dist.cluster.session import Session
from slotfilm_dist.cluster.shard_role import FencedShard
from slotfilm_dist.config import RunConfig
from slotfilm_dist.contracts import ReplayStore
from slotfilm_dist.messages import TransitionBlock
from slotfilm_dist.presets import smoke
from slotfilm_dist.replay.schema import ReplaySchema
from slotfilm_dist.replay.shard import build_shard
from slotfilm_dist.replay.sharded import ShardedReplay

PLACES = ("in_process", "ray")
SCHEMA = ReplaySchema(visual_kind="none", visual_shape=(0,), proprio_dim=3, action_dim=2, num_objects=2)
NUM_SHARDS = 2


@pytest.fixture(scope="module")
def session() -> Iterator[Session]:
    cluster = Session(num_cpus=2)
    yield cluster
    cluster.close()


@pytest.fixture(params=PLACES)
def place(request: pytest.FixtureRequest) -> str:
    """Where the implementation lives; Ray is started only for those that need it."""
    if request.param == "ray":
        request.getfixturevalue("session")
    return request.param


@pytest.fixture
def config() -> RunConfig:
    """Learning begins at once, one update for two steps, 1,000 steps in all."""
    base = smoke()
    return replace(
        base,
        schedule=replace(base.schedule, total_steps=1_000, random_steps=1, updates_per_step=0.5),
        replay=replace(base.replay, capacity=400, min_steps=1, num_shards=NUM_SHARDS),
        runtime=replace(base.runtime, block_steps=16),
    )


@pytest.fixture
def store(place: str, config: RunConfig, tmp_path: Path) -> Iterator[ReplayStore]:
    """Two shards of 200 steps each."""
    seed = np.random.SeedSequence(5)
    if place == "in_process":
        yield ShardedReplay([build_shard(FencedShard, config, SCHEMA, index) for index in range(NUM_SHARDS)], seed)
        return
    shards = [
        ShardClient.launch(config, SCHEMA, index, tmp_path / f"shard-{index}", resume=False, resources={})
        for index in range(NUM_SHARDS)
    ]
    for shard in shards:
        shard.beat()  # until its process has started
    yield ReplayClient(shards, seed)
    for shard in shards:
        shard.kill()


@pytest.fixture
def hub(place: str, config: RunConfig, tmp_path: Path) -> Iterator[Hub | HubClient]:
    """Counts from 0; no step has been collected."""
    if place == "in_process":
        schedule = config.schedule
        limiter = build_limiter(schedule.updates_per_step, 1, config.runtime.block_steps)
        yield Hub(limiter, schedule.total_steps, config.runtime.num_workers)
        return
    client = HubClient.launch(config, f"contract-{tmp_path.name}", {})
    yield client
    client.kill()


@pytest.fixture
def make_block() -> Callable[..., TransitionBlock]:
    """Steps first, first + 1, ... whose action and reward name the step; one row more holds the last frame."""

    def make(first: int, num_steps: int, *, worker_id: int = 0, sequence: int = 0) -> TransitionBlock:
        step = np.arange(first, first + num_steps + 1, dtype=np.float32)
        is_step = np.arange(num_steps + 1) < num_steps
        return TransitionBlock(
            worker_id=worker_id,
            incarnation=0,
            sequence=sequence,
            policy_version=3,
            backbone_hash="",
            visual=np.zeros((num_steps + 1, 0), np.uint8),
            proprio=np.repeat(step[:, None], 3, axis=1),
            goal=np.zeros((num_steps + 1, 3), np.float32),
            uv=np.zeros((num_steps + 1, 2, 2), np.float32),
            visible=np.zeros((num_steps + 1, 2), bool),
            action=np.repeat(np.where(is_step, step, 0)[:, None] / 1e4, 2, axis=1).astype(np.float32),
            reward=np.where(is_step, 10 * step, 0).astype(np.float32),
            terminated=np.zeros(num_steps + 1, bool),
            truncated=np.zeros(num_steps + 1, bool),
            is_step=is_step,
        )

    return make
