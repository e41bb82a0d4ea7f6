import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy import stats

from slotfilm_dist.replay.ring import RowRing


def steps_of(batch) -> np.ndarray:
    return (batch.reward / 10).round().astype(int)


def assert_fields_belong_together(batch, ends=frozenset()) -> None:
    """Each transition carries its own step's values, and the frame after it as next frame."""
    step = steps_of(batch)
    last = np.isin(step, list(ends))
    np.testing.assert_array_equal(batch.proprio, np.repeat(step[:, None], 3, 1))
    np.testing.assert_array_equal(batch.goal, np.repeat(step[:, None] + 1000, 3, 1))
    np.testing.assert_allclose(batch.action, np.repeat(step[:, None] / 1e6, 2, 1), rtol=1e-6)
    np.testing.assert_array_equal(batch.visual[:, 0, 0], step % 200)
    np.testing.assert_array_equal(batch.truncated, last)
    np.testing.assert_array_equal(batch.next_proprio[:, 0], step + np.where(last, 0.5, 1))
    np.testing.assert_array_equal(batch.next_goal[:, 0], step + np.where(last, 1000.5, 1001))
    np.testing.assert_array_equal(batch.next_visual[:, 1, 1], np.floor((step + np.where(last, 0.5, 1)) % 200))
    assert not batch.terminated.any()


def test_empty_ring_refuses_to_sample(schema):
    with pytest.raises(ValueError, match="replay is empty"):
        RowRing(schema, 10).sample(np.random.default_rng(0), [4])


def test_full_ring_never_returns_overwritten_steps(schema, make_block):
    ring = RowRing(schema, capacity_steps=50, block_steps=5)
    rng = np.random.default_rng(0)
    for first in range(0, 1000, 5):
        ring.insert(make_block(first, 5))
        (batch,) = ring.sample(rng, [200])
        assert_fields_belong_together(batch)
        assert steps_of(batch).min() >= first + 5 - 50
        assert steps_of(batch).max() < first + 5
    assert ring.num_steps == 50


def test_number_of_steps_is_exact_while_filling(schema, make_block):
    ring = RowRing(schema, capacity_steps=40, block_steps=8)
    for block in range(10):
        ring.insert(make_block(8 * block, 8))
        assert ring.num_steps == min(8 * (block + 1), 40)


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    capacity=st.integers(1, 40),
    block_steps=st.integers(1, 9),
    sizes=st.lists(st.integers(1, 12), min_size=1, max_size=40),
    ends=st.sets(st.integers(0, 250), max_size=60),
)
def test_any_sequence_of_blocks_keeps_the_newest_steps_whole(schema, make_block, capacity, block_steps, sizes, ends):
    ring = RowRing(schema, capacity, block_steps)
    rng = np.random.default_rng(0)
    rows: list[int | None] = []  # the step of every row ever stored
    first = 0
    for size in sizes:
        block = make_block(first, size, ends=ends)
        ring.insert(block)
        rows += [
            int(reward / 10) if is_step else None for reward, is_step in zip(block.reward, block.is_step, strict=True)
        ]
        expected = [step for step in rows[-ring.num_rows :] if step is not None][-capacity:]
        assert ring.num_steps == len(expected)
        (batch,) = ring.sample(rng, [30 * len(expected)])
        assert_fields_belong_together(batch, ends)
        assert set(steps_of(batch)) <= set(expected)
        first += size


def test_draws_are_uniform_over_the_stored_steps(schema, make_block):
    ring = RowRing(schema, capacity_steps=60, block_steps=8)
    first = 0
    for size in [7, 1, 12, 3, 8, 8, 1, 1, 9, 14, 5, 11, 8, 2]:
        ring.insert(make_block(first, size, ends=range(4, 200, 9)))
        first += size
    (batch,) = ring.sample(np.random.default_rng(3), [60_000])
    counts = np.bincount(steps_of(batch) - (first - ring.num_steps), minlength=ring.num_steps)
    assert len(counts) == ring.num_steps
    assert stats.chisquare(counts).pvalue > 0.001


def test_several_batches_of_one_call_differ_and_have_their_sizes(schema, make_block):
    ring = RowRing(schema, capacity_steps=100)
    ring.insert(make_block(0, 90))
    batches = ring.sample(np.random.default_rng(0), [16, 0, 33, 16])
    assert [len(batch.reward) for batch in batches] == [16, 0, 33, 16]
    for batch in batches:
        assert_fields_belong_together(batch)
    assert not np.array_equal(batches[0].reward, batches[3].reward)


def test_batches_do_not_change_when_the_ring_is_overwritten(schema, make_block):
    ring = RowRing(schema, capacity_steps=20)
    ring.insert(make_block(0, 20))
    (batch,) = ring.sample(np.random.default_rng(0), [50])
    for first in range(20, 200, 20):
        ring.insert(make_block(first, 20))
    assert_fields_belong_together(batch)
    assert steps_of(batch).max() < 20


def test_blocks_of_the_stated_size_fill_the_capacity_exactly(schema, make_block):
    ring = RowRing(schema, capacity_steps=3200, block_steps=32)
    for block in range(150):
        first = 32 * block
        ring.insert(make_block(first, 32, ends=range(399, first + 32, 400)))
    assert ring.num_steps == 3200


def test_short_episodes_leave_fewer_steps_but_never_wrong_ones(schema, make_block):
    ring = RowRing(schema, capacity_steps=100, block_steps=10)
    for first in range(0, 500, 10):
        ring.insert(make_block(first, 10, ends=range(600)))
    (batch,) = ring.sample(np.random.default_rng(0), [500])
    assert_fields_belong_together(batch, range(600))
    assert 50 <= ring.num_steps < 100
    assert steps_of(batch).min() >= 500 - ring.num_steps


def test_age_and_version_of_draws_are_added_up(schema, make_block):
    ring = RowRing(schema, capacity_steps=10)
    ring.insert(make_block(0, 10))
    (batch,) = ring.sample(np.random.default_rng(0), [40])
    assert ring.drawn.num_steps == 40
    assert ring.drawn.policy_version == 40 * 7
    assert ring.drawn.age_steps == (9 - steps_of(batch)).sum()


def test_state_of_another_size_is_refused(schema, make_block):
    ring = RowRing(schema, capacity_steps=10)
    ring.insert(make_block(0, 10))
    with pytest.raises(ValueError, match=r"ring\.capacity_steps = 10: this ring has 11"):
        RowRing(schema, capacity_steps=11).load(ring.view())


def test_contradictory_state_is_refused(schema, make_block):
    ring = RowRing(schema, capacity_steps=10)
    ring.insert(make_block(0, 10))
    for wrong in (
        {"first_step": 11},
        {"next_row": 30},
        {"step_rows": np.arange(10)[::-1]},
        {"step_rows": np.arange(10) + 1},
        {"columns": {**ring.view()["columns"], "reward": np.zeros(11)}},
        {"columns": {}},
    ):
        with pytest.raises(ValueError, match=r"ring\."):
            RowRing(schema, capacity_steps=10).load({**ring.view(), **wrong})


def test_view_cannot_be_written(schema, make_block):
    ring = RowRing(schema, capacity_steps=10)
    ring.insert(make_block(0, 10))
    with pytest.raises(ValueError, match="read-only"):
        ring.view()["columns"]["reward"][0] = 1
    ring.insert(make_block(10, 10))
    assert ring.num_steps == 10
