"""A replay shard among others: counts out the blocks of lost workers, writes snapshots beside its work."""

import os
import threading
import uuid
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from slotfilm_dist.cluster.messages import BlockKey, ShardBeat
from slotfilm_dist.messages import SampleBatch, TransitionBlock
from slotfilm_dist.replay.shard import ReplayShard
from slotfilm_dist.replay.snapshot import MANIFEST, read_snapshot, write_snapshot


class FencedShard(ReplayShard):
    """A `ReplayShard` that can be told that a worker is gone: its late blocks are refused from then on."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._gone: dict[int, int] = {}

    def insert(self, block: TransitionBlock) -> bool:
        """Store a block; False if it had been stored before, or if its worker's incarnation is gone."""
        return block.incarnation > self._gone.get(block.worker_id, -1) and super().insert(block)

    def fence(self, worker_id: int, incarnation: int, asked: Iterable[BlockKey]) -> list[BlockKey]:
        """Refuse what comes late from a lost worker; gives those of the blocks asked for that are stored."""
        self._gone[worker_id] = max(incarnation, self._gone.get(worker_id, -1))
        return [k for k in asked if self.knows(k.worker_id, k.incarnation, k.sequence)]


class ShardRole:
    """A `FencedShard` behind a lock, with snapshots. Thread-safe.

    Consumes blocks and requests for batches; waits for nothing; ends with its process. A snapshot is of one instant,
    but the lock is held only for 8 MB of it at a time, so sampling and inserting go on meanwhile; see `FrozenRows`.

    Args:
        shard: empty.
        folder: of its snapshots; a snapshot found there is taken over.
    """

    def __init__(self, shard: FencedShard, folder: Path) -> None:
        self._shard = shard
        self._folder = folder
        self._lock = threading.Lock()
        self._writing = threading.Lock()
        self._starts = uuid.uuid4().hex
        self._snapshot_error = ""
        self._restored_steps = 0

    def restore(self, *, strict: bool) -> int:
        """Take over the last snapshot; gives the steps that it held, 0 if there is none.

        Args:
            strict: refuse a snapshot that cannot be read; else begin empty and say so in `beat`.

        Raises:
            ValueError: it is damaged or of another shape.
            OSError: the disk does not give it.
        """
        if not (self._folder / MANIFEST).exists():
            return 0
        try:
            state = read_snapshot(self._folder)
            with self._lock:
                self._shard.load(state)
        except (ValueError, OSError) as error:
            self._snapshot_error = str(error)
            if strict:
                raise
        self._restored_steps = self._shard.num_steps()
        return self._restored_steps

    def insert(self, block: TransitionBlock) -> bool:
        """Store a block; False if it had been stored before, or if its worker's incarnation has been given up."""
        with self._lock:
            return self._shard.insert(block)

    def draw(self, num_rows: int) -> tuple[SampleBatch, int]:
        """That many transitions, and the number of steps stored now.

        Raises:
            ValueError: nothing is stored.
        """
        with self._lock:
            return self._shard.draw([num_rows])[0], self._shard.num_steps()

    def num_steps(self) -> int:
        """Steps stored now."""
        with self._lock:
            return self._shard.num_steps()

    def fence(self, worker_id: int, incarnation: int, asked: Iterable[BlockKey]) -> list[BlockKey]:
        """Refuse what comes late from a lost worker; gives those of the blocks asked for that are stored."""
        with self._lock:
            return self._shard.fence(worker_id, incarnation, asked)

    def snapshot(self) -> int:
        """Write a snapshot; gives the steps in it. One at a time."""
        with self._writing:
            with self._lock:
                state, num_steps = self._shard.freeze(self._lock), self._shard.num_steps()
            try:
                write_snapshot(self._folder, state)
            except OSError as error:
                self._snapshot_error = str(error)
                raise
            finally:
                with self._lock:
                    self._shard.thaw()
            self._snapshot_error = ""
            return num_steps

    def process_id(self) -> int:
        """Of the process that it lives in."""
        return os.getpid()

    def beat(self) -> ShardBeat:
        """How it does."""
        with self._lock:
            return ShardBeat(
                stats=self._shard.stats(),
                starts=self._starts,
                restored_steps=self._restored_steps,
                snapshot_error=self._snapshot_error,
            )
