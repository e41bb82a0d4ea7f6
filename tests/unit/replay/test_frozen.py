"""A snapshot of one instant, read piece by piece while blocks come in."""

import threading

import numpy as np
import pytest

from slotfilm_dist.replay.shard import ReplayShard
from slotfilm_dist.replay.snapshot import read_snapshot, write_snapshot

BLOCK = 7


def assert_same(left: object, right: object) -> None:
    if isinstance(left, dict):
        assert isinstance(right, dict)
        assert left.keys() == right.keys()
        for key in left:
            assert_same(left[key], right[key])
    elif isinstance(left, np.ndarray):
        np.testing.assert_array_equal(left, right)
    else:
        assert left == right


# Rows per ring: 56. Empty, part full, full to the row, and after every kind of wrap.
@pytest.mark.parametrize("num_before", [0, 1, 3, 6, 7, 8, 13, 20, 29])
@pytest.mark.parametrize("piece", [1, 5, 100])
def test_frozen_state_stays_as_it_was_whatever_comes_in(schema, make_block, num_before, piece):
    shard, lock = ReplayShard(schema, 45, 3, block_steps=BLOCK), threading.Lock()
    for i in range(num_before):
        shard.insert(make_block(BLOCK * i, BLOCK, sequence=i, ends=(BLOCK * i + 2,) if i % 3 == 0 else ()))
    expected = shard.save()
    with lock:
        state = shard.freeze(lock)
    sequence = num_before
    got = {name: [] for name in state["ring"]["columns"]}
    for name, column in state["ring"]["columns"].items():
        for start in range(0, column.shape[0], piece):
            got[name].append(column.rows(start, start + piece))
            with lock:
                shard.insert(make_block(BLOCK * sequence, BLOCK, sequence=sequence))
            sequence += 1
    rows = {
        name: np.concatenate(parts) if parts else state["ring"]["columns"][name].rows(0, 0)
        for name, parts in got.items()
    }
    assert_same(state | {"ring": state["ring"] | {"columns": rows}}, expected)
    shard.thaw()


def test_snapshot_written_while_others_insert_and_draw_is_of_the_instant_it_began(tmp_path, schema, make_block):
    shard, lock, other = ReplayShard(schema, 20_000, 3), threading.Lock(), ReplayShard(schema, 20_000, 0)
    for i in range(50):
        shard.insert(make_block(500 * i, 500, sequence=i))
    expected, ended, inserted = shard.save(), threading.Event(), 0

    def work() -> None:
        nonlocal inserted
        while not ended.is_set():
            with lock:
                shard.insert(make_block(500 * (50 + inserted % 1000), 500, sequence=50 + inserted))
                shard.sample(1, 8)
            inserted += 1

    with lock:
        state = shard.freeze(lock)
    thread = threading.Thread(target=work)
    thread.start()
    try:
        write_snapshot(tmp_path, state)
    finally:
        ended.set()
        thread.join()
    shard.thaw()
    assert inserted > 0
    other.load(read_snapshot(tmp_path))
    assert_same(other.save(), expected)


def test_nothing_is_kept_once_thawed(schema, make_block):
    shard, lock = ReplayShard(schema, 45, 3, block_steps=BLOCK), threading.Lock()
    for i in range(10):
        shard.insert(make_block(BLOCK * i, BLOCK, sequence=i))
    for _ in range(2):
        state = shard.freeze(lock)
        shard.thaw()
    column = state["ring"]["columns"]["reward"]
    shard.insert(make_block(900, BLOCK, sequence=10))
    assert 9000.0 in column.rows(0, 100)
