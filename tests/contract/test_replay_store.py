"""What every `ReplayStore` does, wherever it lives."""

from collections.abc import Callable

import numpy as np
import pytest

from slotfilm_dist.contracts import ReplayStore
from slotfilm_dist.messages import TransitionBlock

MakeBlock = Callable[..., TransitionBlock]


def fill(store: ReplayStore, make_block: MakeBlock, num_blocks: int, first_sequence: int = 0) -> None:
    for sequence in range(first_sequence, first_sequence + num_blocks):
        assert store.insert(make_block(16 * sequence, 16, sequence=sequence))


def test_repeated_block_is_stored_once(store: ReplayStore, make_block: MakeBlock) -> None:
    assert store.insert(make_block(0, 16))
    assert not store.insert(make_block(0, 16))
    assert store.insert(make_block(0, 16, worker_id=1))
    assert store.num_steps() in (16, 32)  # a client may know a shard's size only from its last answer
    store.sample(1, 8)
    assert store.num_steps() == 32


def test_fields_of_a_step_stay_together(store: ReplayStore, make_block: MakeBlock) -> None:
    fill(store, make_block, 6)
    for batch in store.sample(4, 64):
        step = batch.reward / 10
        assert len(batch.reward) == 64
        np.testing.assert_allclose(batch.action[:, 0] * 1e4, step, atol=1e-2)
        np.testing.assert_array_equal(batch.proprio[:, 0], step)
        np.testing.assert_array_equal(batch.next_proprio[:, 0], step + 1)
        assert not batch.terminated.any()


def test_steps_of_all_shards_are_drawn_alike_whatever_their_sizes(store: ReplayStore, make_block: MakeBlock) -> None:
    fill(store, make_block, 3)
    assert store.insert(make_block(1_000, 4, sequence=3))
    store.sample(1, 8)  # a client learns all sizes with its first draws
    counts = np.zeros(1_004)
    for batch in store.sample(40, 128):
        np.add.at(counts, (batch.reward / 10).astype(int), 1)
    drawn = counts[counts > 0]
    assert len(drawn) == 3 * 16 + 4
    assert 0.5 < drawn.min() / drawn.mean() < drawn.max() / drawn.mean() < 1.6


def test_oldest_steps_make_room(store: ReplayStore, make_block: MakeBlock) -> None:
    fill(store, make_block, 40)
    steps = np.concatenate([batch.reward / 10 for batch in store.sample(20, 128)])
    assert steps.min() >= 16 * 40 - 400 - 2 * 16
    assert steps.max() < 16 * 40
    assert 400 - 2 * 16 <= store.num_steps() <= 400 + 2 * 16


def test_nothing_can_be_drawn_from_nothing(store: ReplayStore) -> None:
    with pytest.raises(ValueError, match="replay is empty"):
        store.sample(1, 8)


def test_block_of_another_shape_is_refused_and_nothing_is_stored(store: ReplayStore, make_block: MakeBlock) -> None:
    wrong = make_block(0, 16)
    object.__setattr__(wrong, "proprio", np.zeros((17, 5), np.float32))
    with pytest.raises(ValueError, match="proprio"):
        store.insert(wrong)
    assert store.num_steps() == 0
