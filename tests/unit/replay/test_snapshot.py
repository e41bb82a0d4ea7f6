import random
import resource
import tracemalloc
from dataclasses import fields

import numpy as np
import pytest

from slotfilm_dist.messages import SampleBatch
from slotfilm_dist.replay.shard import ReplayShard
from slotfilm_dist.replay.sharded import ShardedReplay
from slotfilm_dist.replay.snapshot import LARGE_BYTES, MANIFEST, read_snapshot, write_snapshot


@pytest.fixture
def shard(schema, make_block):
    """A shard whose larger columns get files of their own."""
    shard = ReplayShard(schema, 20_000, 3)
    for i in range(50):
        shard.insert(make_block(500 * i, 500, sequence=i))
    return shard


def names(directory) -> list[str]:
    return sorted(path.name for path in directory.iterdir())


def assert_same_draws(left, right) -> None:
    for a, b in zip(left.sample(2, 64), right.sample(2, 64), strict=True):
        for field in fields(SampleBatch):
            np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name))


def test_after_a_snapshot_the_same_draws_follow(tmp_path, schema, shard):
    write_snapshot(tmp_path, shard.view())
    assert any("columns.proprio" in name for name in names(tmp_path))
    other = ReplayShard(schema, 20_000, 0)
    other.load(read_snapshot(tmp_path))
    assert other.stats() == shard.stats()
    assert_same_draws(shard, other)


def test_sharded_replay_goes_through_a_snapshot(tmp_path, schema, make_block):
    replay, other = (
        ShardedReplay([ReplayShard(schema, 9000, i, index=i, num_shards=2) for i in range(2)], seed) for seed in (1, 2)
    )
    for i in range(40):
        replay.insert(make_block(500 * i, 500, sequence=i))
    write_snapshot(tmp_path, replay.view())
    other.load(read_snapshot(tmp_path))
    assert_same_draws(replay, other)


def test_new_snapshot_replaces_the_old_one_and_its_files(tmp_path, schema, shard, make_block):
    write_snapshot(tmp_path, shard.view())
    before = names(tmp_path)
    shard.insert(make_block(30_000, 500, sequence=50))
    write_snapshot(tmp_path, shard.view())
    assert len(names(tmp_path)) == len(before)
    other = ReplayShard(schema, 20_000, 0)
    other.load(read_snapshot(tmp_path))
    assert other.stats() == shard.stats()


@pytest.mark.parametrize("limit_bytes", [100, 1500, 20_000, 170_000, 200_000])
def test_full_disk_keeps_the_old_snapshot_and_leaves_nothing_else(tmp_path, limit_bytes):
    rng = np.random.default_rng(0)
    small = {"a": rng.random(LARGE_BYTES // 8), "b": rng.random(20), "version": 1}
    large = {"a": rng.random(20_000), "c": rng.random(30_000), "b": rng.random(2000), "version": 2}
    write_snapshot(tmp_path, small)
    before = names(tmp_path)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, hard))
    try:
        with pytest.raises(OSError, match="too large"):
            write_snapshot(tmp_path, large)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert names(tmp_path) == before
    state = read_snapshot(tmp_path)
    assert state["version"] == 1
    np.testing.assert_array_equal(state["a"], small["a"])


def test_snapshot_cut_off_before_its_manifest_does_not_count(tmp_path, shard):
    other = tmp_path / "other"
    write_snapshot(tmp_path, {"version": 1})
    write_snapshot(other, shard.view())
    write_snapshot(other, shard.view())
    for path in other.iterdir():
        if path.name != MANIFEST:
            path.rename(tmp_path / path.name)
    (tmp_path / "replay-9-ring.columns.visual.bin.partial").write_bytes(b"half")
    assert read_snapshot(tmp_path) == {"version": 1}
    write_snapshot(tmp_path, {"version": 2})
    assert read_snapshot(tmp_path) == {"version": 2}
    assert len([path for path in tmp_path.iterdir() if path.is_file()]) == 2


def test_every_flipped_bit_is_found(tmp_path):
    state = {"a": np.arange(10_000.0), "b": np.arange(50), "name": "x", "version": 3}
    write_snapshot(tmp_path, state)
    rng = random.Random(0)
    for path in sorted(tmp_path.iterdir()):
        content = path.read_bytes()
        for _ in range(170):
            position, bit = rng.randrange(len(content)), rng.randrange(8)
            damaged = bytearray(content)
            damaged[position] ^= 1 << bit
            path.write_bytes(damaged)
            with pytest.raises(ValueError, match=path.name):
                read_snapshot(tmp_path)
        path.write_bytes(content)
    np.testing.assert_array_equal(read_snapshot(tmp_path)["a"], state["a"])


def test_missing_or_short_file_is_named(tmp_path, shard):
    write_snapshot(tmp_path, shard.view())
    for path in sorted(tmp_path.iterdir()):
        content = path.read_bytes()
        path.write_bytes(content[: len(content) // 2])
        with pytest.raises(ValueError, match=path.name):
            read_snapshot(tmp_path)
        path.unlink()
        with pytest.raises(ValueError, match=path.name):
            read_snapshot(tmp_path)
        path.write_bytes(content)


def test_unreadable_snapshot_is_replaced(tmp_path):
    write_snapshot(tmp_path, {"version": 1})
    (tmp_path / MANIFEST).write_bytes(b"{")
    write_snapshot(tmp_path, {"version": 2})
    assert read_snapshot(tmp_path) == {"version": 2}


def test_directory_without_a_snapshot_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"manifest\.json is missing: .*nowhere holds no finished replay snapshot"):
        read_snapshot(tmp_path / "nowhere")


def test_keys_that_cannot_be_file_names_are_refused(tmp_path):
    with pytest.raises(ValueError, match="must be identifiers"):
        write_snapshot(tmp_path, {"a/b": 1})


def test_writing_takes_a_chunk_of_memory_not_the_whole(tmp_path):
    state = {"ring": {"visual": np.zeros((6000, 8192), np.uint8)}}
    tracemalloc.start()
    try:
        write_snapshot(tmp_path, state)
        assert tracemalloc.get_traced_memory()[1] < 20 << 20
    finally:
        tracemalloc.stop()
    assert read_snapshot(tmp_path)["ring"]["visual"].shape == (6000, 8192)
