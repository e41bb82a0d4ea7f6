from dataclasses import fields, replace

import numpy as np
import pytest

from slotfilm_dist.contracts import ReplayStore, Saveable
from slotfilm_dist.messages import SampleBatch
from slotfilm_dist.replay.shard import ReplayShard


def assert_same(left: list[SampleBatch], right: list[SampleBatch]) -> None:
    for a, b in zip(left, right, strict=True):
        for field in fields(SampleBatch):
            np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name))


def test_repeated_block_is_dropped_and_counted(schema, make_block):
    shard: ReplayStore = ReplayShard(schema, 100, 0)
    block = make_block(0, 10)
    assert shard.insert(block)
    assert not shard.insert(block)
    assert shard.num_steps() == 10
    stats = shard.stats()
    assert (stats.inserted_blocks, stats.inserted_steps, stats.duplicate_blocks) == (1, 10, 1)


def test_late_block_is_stored_once(schema, make_block):
    shard = ReplayShard(schema, 100, 0)
    assert shard.insert(make_block(0, 10, sequence=0))
    assert shard.insert(make_block(20, 10, sequence=2))
    assert shard.stats().missing_blocks == 1
    assert shard.insert(make_block(10, 10, sequence=1))
    assert not shard.insert(make_block(10, 10, sequence=1))
    assert shard.stats().missing_blocks == 0
    assert shard.num_steps() == 30


def test_restarted_worker_counts_from_zero_again(schema, make_block):
    shard = ReplayShard(schema, 100, 0)
    assert shard.insert(make_block(0, 10, incarnation=0))
    assert shard.insert(make_block(10, 10, incarnation=1))
    assert not shard.insert(make_block(0, 10, incarnation=0))
    assert shard.num_steps() == 20


def test_refused_block_leaves_no_trace_and_may_come_again(schema, make_block):
    shard = ReplayShard(schema, 100, 0)
    bad = make_block(0, 10)
    bad.reward[3] = np.nan
    with pytest.raises(ValueError, match="reward: not finite"):
        shard.insert(bad)
    assert shard.num_steps() == 0
    assert shard.insert(make_block(0, 10))


def test_sample_gives_the_asked_number_of_batches(schema, make_block):
    shard = ReplayShard(schema, 100, 0)
    shard.insert(make_block(0, 50))
    batches = shard.sample(3, 16)
    assert [batch.visual.shape for batch in batches] == [(16, 2, 2)] * 3
    assert batches[0].visual.dtype == np.float16
    assert shard.stats().drawn.num_steps == 48


def test_same_seed_draws_the_same_and_another_does_not(schema, make_block):
    shards = [ReplayShard(schema, 100, seed) for seed in (1, 1, 2)]
    for shard in shards:
        shard.insert(make_block(0, 50))
    first, second, third = (shard.sample(1, 32) for shard in shards)
    assert_same(first, second)
    assert not np.array_equal(first[0].reward, third[0].reward)


@pytest.mark.parametrize("num_blocks", [1, 9, 30])
def test_after_load_the_same_draws_follow(schema, make_block, num_blocks):
    shard: Saveable = ReplayShard(schema, 64, 5)
    for i in range(num_blocks):
        shard.insert(make_block(8 * i, 8, sequence=i, ends=[8 * i + 3]))
    shard.sample(2, 7)
    state = shard.save()
    other = ReplayShard(schema, 64, 99)
    other.load(state)
    for i in range(num_blocks, num_blocks + 12):
        block = make_block(8 * i, 8, sequence=i)
        assert shard.insert(block)
        assert other.insert(block)
        assert_same(shard.sample(2, 33), other.sample(2, 33))
    assert not other.insert(make_block(0, 8, sequence=0))
    assert replace(other.stats(), duplicate_blocks=0) == shard.stats()


def test_saved_state_does_not_change_with_the_shard(schema, make_block):
    shard = ReplayShard(schema, 16, 5)
    shard.insert(make_block(0, 16))
    state = shard.save()
    expected = shard.sample(1, 64)
    for i in range(1, 5):
        shard.insert(make_block(16 * i, 16, sequence=i))
    shard.load(state)
    assert_same(shard.sample(1, 64), expected)


def test_state_of_another_schema_is_refused_by_field(schema, make_block):
    shard = ReplayShard(schema, 16, 5)
    with pytest.raises(ValueError, match=r"schema\.backbone_hash = 'b': this replay has 'c'"):
        ReplayShard(replace(schema, backbone_hash="c"), 16, 0).load(shard.save())


def test_incomplete_or_broken_state_is_refused_and_changes_nothing(schema, make_block):
    shard, twin = ReplayShard(schema, 16, 5), ReplayShard(schema, 16, 5)
    for each in (shard, twin):
        each.insert(make_block(0, 16))
    other = ReplayShard(schema, 16, 6)
    other.insert(make_block(100, 16))
    state = other.save()
    for broken in (
        {key: value for key, value in state.items() if key != "duplicate_blocks"},
        state | {"rng": "{}"},
        state | {"ring": {**state["ring"], "next_step": -1}},
    ):
        with pytest.raises(ValueError, match=r"lacks|rng|ring\."):
            shard.load(broken)
    assert_same(shard.sample(1, 64), twin.sample(1, 64))
