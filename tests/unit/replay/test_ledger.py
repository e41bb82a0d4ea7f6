import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slotfilm_dist.replay import codec
from slotfilm_dist.replay.ledger import MAX_EARLY_BLOCKS, MAX_INCARNATIONS, BlockLedger, shard_of


def arrives(ledger: BlockLedger, sequence: int, worker_id: int = 0, incarnation: int = 0) -> bool:
    key = worker_id, incarnation, sequence
    is_new = not ledger.has(*key)
    if is_new:
        ledger.record(*key)
    return is_new


@settings(deadline=None)
@given(arrivals=st.lists(st.tuples(st.integers(0, 2), st.integers(0, 1), st.integers(0, 30)), max_size=200))
def test_every_block_is_new_exactly_once_in_any_order(arrivals):
    ledger, seen = BlockLedger(), set()
    for key in arrivals:
        assert ledger.has(*key) == (key in seen)
        if key not in seen:
            ledger.record(*key)
            seen.add(key)
    newest = {}
    for worker, incarnation, sequence in seen:
        newest[worker, incarnation] = max(sequence, newest.get((worker, incarnation), 0))
    assert ledger.num_missing == sum(last + 1 for last in newest.values()) - len(seen)


def test_gap_is_counted_until_it_is_filled():
    ledger = BlockLedger()
    assert [arrives(ledger, sequence) for sequence in (0, 1, 4)] == [True, True, True]
    assert ledger.num_missing == 2
    assert arrives(ledger, 3)
    assert ledger.num_missing == 1
    assert arrives(ledger, 2)
    assert ledger.num_missing == 0
    assert not any(arrives(ledger, sequence) for sequence in range(5))


def test_memory_is_bounded_and_a_given_up_gap_stays_counted():
    ledger = BlockLedger()
    for sequence in range(1, 3 * MAX_EARLY_BLOCKS):
        assert arrives(ledger, sequence)
        assert len(ledger.save()["early"]) <= MAX_EARLY_BLOCKS
    assert ledger.num_missing == 1
    assert ledger.has(0, 0, 0)


def test_long_gone_incarnations_are_forgotten_and_refused():
    ledger = BlockLedger()
    for incarnation in range(20):
        assert arrives(ledger, 0, incarnation=incarnation)
        assert arrives(ledger, 2, incarnation=incarnation)
        assert len(ledger.save()["logs"]) <= MAX_INCARNATIONS
    assert ledger.num_missing == 20
    assert not arrives(ledger, 5, incarnation=3)
    assert arrives(ledger, 1, incarnation=18)


@pytest.mark.parametrize("num_shards", [1, 2, 3, 5])
def test_blocks_of_a_worker_go_round_all_shards_and_leave_no_gap(num_shards):
    ledgers = [BlockLedger(index, num_shards) for index in range(num_shards)]
    for worker in (-1, 0, 4):
        owners = [shard_of(worker, sequence, num_shards) for sequence in range(30)]
        assert np.ptp(np.bincount(owners, minlength=num_shards)) <= 1
        for sequence, owner in enumerate(owners):
            assert arrives(ledgers[owner], sequence, worker)
            assert not arrives(ledgers[owner], sequence, worker)
    assert [ledger.num_missing for ledger in ledgers] == [0] * num_shards


def test_block_of_another_shard_is_refused():
    with pytest.raises(ValueError, match="block 3 of worker 1 belongs to shard 0 of 2, not to shard 1"):
        arrives(BlockLedger(1, 2), 3, worker_id=1)


def test_negative_numbers_are_refused():
    with pytest.raises(ValueError, match="sequence = -1"):
        arrives(BlockLedger(), -1)
    with pytest.raises(ValueError, match="incarnation = -1"):
        arrives(BlockLedger(), 0, incarnation=-1)


def test_saved_ledger_goes_on():
    ledger = BlockLedger(0, 2)
    for incarnation in range(6):
        for sequence in (0, 2, 8, 12):
            arrives(ledger, sequence, worker_id=2, incarnation=incarnation)
    other = BlockLedger(0, 2)
    other.load(codec.decode(codec.encode(ledger.save())))
    assert other.num_missing == ledger.num_missing == 6 * 3
    assert not arrives(other, 8, worker_id=2, incarnation=5)
    assert not arrives(other, 4, worker_id=2, incarnation=0)
    assert arrives(other, 4, worker_id=2, incarnation=5)


def test_ledger_of_another_shard_is_refused():
    with pytest.raises(ValueError, match=r"ledger\.num_shards = 2: replay has 1"):
        BlockLedger(0, 1).load(BlockLedger(0, 2).save())
    with pytest.raises(ValueError, match=r"ledger\.index"):
        BlockLedger(0, 2).load(BlockLedger(1, 2).save())
