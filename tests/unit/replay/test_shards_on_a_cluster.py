"""Shards whose workers may be lost, and the watch over shards that may be lost themselves."""

from collections.abc import Callable

import pytest

from slotfilm_dist.backend import RunFailedError
from slotfilm_dist.cluster.messages import BlockKey, ShardBeat
from slotfilm_dist.cluster.shard_role import FencedShard
from slotfilm_dist.cluster.shard_watch import SHARD_GONE_S, ShardWatch
from slotfilm_dist.messages import TransitionBlock
from slotfilm_dist.replay.schema import ReplaySchema

MakeBlock = Callable[..., TransitionBlock]


def test_fenced_worker_is_told_what_is_stored_and_its_late_blocks_are_refused(
    schema: ReplaySchema, make_block: MakeBlock
) -> None:
    shard = FencedShard(schema, 100, 0, block_steps=4)
    assert shard.insert(make_block(0, 4, incarnation=1, sequence=0))
    asked = [BlockKey(worker_id=0, incarnation=1, sequence=number) for number in (0, 1)]
    assert shard.fence(0, 1, asked) == asked[:1]
    assert not shard.insert(make_block(4, 4, incarnation=1, sequence=1))
    assert not shard.insert(make_block(4, 4, incarnation=0, sequence=1))
    assert shard.num_steps() == 4
    assert shard.insert(make_block(4, 4, incarnation=2, sequence=0))
    assert shard.insert(make_block(4, 4, worker_id=1, incarnation=1, sequence=0))


def test_fence_never_opens_again(schema: ReplaySchema, make_block: MakeBlock) -> None:
    shard = FencedShard(schema, 100, 0, block_steps=4)
    shard.fence(0, 3, [])
    shard.fence(0, 1, [])
    assert not shard.insert(make_block(0, 4, incarnation=3, sequence=0))


class Shard:
    """Answers what it is told to."""

    index = 0
    beat: ShardBeat | None = None

    def poll(self) -> ShardBeat | None:
        return self.beat

    def look(self) -> ShardBeat | None:
        return self.beat


def test_restarts_of_a_shard_are_counted_and_one_that_stays_away_ends_the_run(schema: ReplaySchema) -> None:
    now, shard = [0.0], Shard()
    watch = ShardWatch([shard], clock=lambda: now[0])
    stats = FencedShard(schema, 100, 0).stats()
    for starts in ("a", "a", "b"):
        shard.beat = ShardBeat(stats=stats, starts=starts, restored_steps=0)
        watch.tick()
    assert watch.num_restarts == 1
    shard.beat = None
    watch.tick()
    now[0] += SHARD_GONE_S
    watch.tick()
    shard.beat = ShardBeat(stats=stats, starts="c", restored_steps=0)
    watch.tick()
    assert watch.num_restarts == 2
    shard.beat = None
    watch.tick()
    now[0] += SHARD_GONE_S + 1
    with pytest.raises(RunFailedError, match="replay shard 0 has not answered for 15 minutes"):
        watch.tick()
