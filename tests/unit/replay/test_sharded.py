from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from slotfilm_dist.replay.shard import ReplayShard
from slotfilm_dist.replay.sharded import ShardedReplay, join_batches, split_draws


@pytest.fixture
def replay(schema):
    return _replay(schema)


def _replay(schema, capacity: int = 200) -> ShardedReplay:
    return ShardedReplay([ReplayShard(schema, capacity, i, index=i, num_shards=3) for i in range(3)], seed=9)


def test_repeated_block_meets_the_shard_that_knows_it(replay, make_block):
    blocks = [make_block(10 * s, 10, worker_id=w, sequence=s) for w in (0, 1) for s in range(7)]
    assert all(replay.insert(block) for block in blocks)
    assert not any(replay.insert(block) for block in blocks)
    assert replay.num_steps() == 140


def test_draws_are_uniform_over_uneven_shards(replay, make_block):
    first = 0
    for sequence in range(9):
        size = (2, 20, 5)[sequence % 3]
        replay.insert(make_block(first, size, sequence=sequence))
        first += size
    rewards = np.concatenate([batch.reward for batch in replay.sample(300, 100)])
    counts = np.bincount((rewards / 10).round().astype(int), minlength=first)
    assert len(counts) == first
    assert stats.chisquare(counts).pvalue > 0.001


def test_number_drawn_from_each_shard_varies_as_in_independent_draws():
    shares = split_draws(np.random.default_rng(0), [10, 30], num_batches=4000, batch_size=64)
    np.testing.assert_array_equal(shares.sum(axis=1), 64)
    assert shares[:, 0].mean() == pytest.approx(16, rel=0.02)
    assert shares[:, 0].var() == pytest.approx(64 * 0.25 * 0.75, rel=0.1)


def test_lost_and_empty_shards_give_nothing(replay, make_block):
    replay.insert(make_block(0, 10, sequence=1))
    (batch,) = replay.sample(1, 30)
    assert len(batch.reward) == 30
    assert split_draws(np.random.default_rng(0), [0, 5, 0], 2, 8).tolist() == [[0, 8, 0], [0, 8, 0]]


def test_empty_replay_refuses_to_sample(replay):
    with pytest.raises(ValueError, match="replay is empty"):
        replay.sample(1, 8)


def test_fields_stay_together_across_shards(replay, make_block):
    for sequence in range(30):
        replay.insert(make_block(10 * sequence, 10, sequence=sequence))
    for batch in replay.sample(4, 50):
        step = batch.reward / 10
        np.testing.assert_array_equal(batch.proprio[:, 0], step)
        np.testing.assert_array_equal(batch.next_proprio[:, 0], step + 1)
        np.testing.assert_allclose(batch.action[:, 1], step / 1e6, rtol=1e-6)
        np.testing.assert_array_equal(batch.visual[:, 1, 1], step % 200)


def test_joined_batch_holds_the_parts_in_order(schema, make_block):
    shard = ReplayShard(schema, 50, 0)
    shard.insert(make_block(0, 50))
    parts = shard.draw([3, 0, 5])
    joined = join_batches(parts)
    np.testing.assert_array_equal(joined.reward, np.concatenate([part.reward for part in parts]))
    np.testing.assert_array_equal(joined.next_visual[3:], parts[2].next_visual)
    assert join_batches([parts[1], parts[0]]) is parts[0]
    assert len(join_batches([parts[1]]).reward) == 0


def test_after_load_the_same_draws_follow(schema, make_block):
    replay, other = _replay(schema), _replay(schema)
    for sequence in range(40):
        replay.insert(make_block(10 * sequence, 10, sequence=sequence))
    replay.sample(3, 5)
    other.load(replay.save())
    for left, right in zip(replay.sample(3, 32), other.sample(3, 32), strict=True):
        np.testing.assert_array_equal(left.reward, right.reward)
        np.testing.assert_array_equal(left.next_visual, right.next_visual)


def test_state_of_another_number_of_shards_is_refused(schema, replay):
    with pytest.raises(ValueError, match="shards = 3: this replay has 1"):
        ShardedReplay([ReplayShard(schema, 10, 0)], seed=0).load(replay.save())


def test_sharded_replay_of_another_schema_refuses_the_block(replay, make_block):
    with pytest.raises(ValueError, match="backbone_hash"):
        replay.insert(replace(make_block(0, 10), backbone_hash="z"))
