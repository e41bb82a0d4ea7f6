"""Which blocks have arrived: the memory that makes inserts idempotent."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from slotfilm_dist.config import check

MAX_EARLY_BLOCKS = 1024
"""Blocks remembered beyond a gap; when there are more, the gap is given up."""

MAX_INCARNATIONS = 4
"""Incarnations of a worker whose blocks are still told apart."""


def shard_of(worker_id: int, sequence: int, num_shards: int) -> int:
    """The shard that a block belongs to: a worker's blocks go round all shards in turn."""
    return (worker_id + sequence) % num_shards


@dataclass(kw_only=True, slots=True)
class _Log:
    """One incarnation's blocks, numbered 0, 1, 2, ... within the shard."""

    mark: int = 0
    """Every block below it has arrived or been given up."""
    early: set[int] = field(default_factory=set)
    """Blocks above the mark that have arrived."""

    def has(self, number: int) -> bool:
        return number < self.mark or number in self.early

    def add(self, number: int) -> int:
        """Note an arrival; returns how many missing blocks were given up for it."""
        self.early.add(number)
        given_up = 0
        if len(self.early) > MAX_EARLY_BLOCKS:
            oldest = min(self.early)
            given_up, self.mark = oldest - self.mark, oldest
        while self.mark in self.early:
            self.early.remove(self.mark)
            self.mark += 1
        return given_up

    def num_missing(self) -> int:
        return max(self.early) + 1 - self.mark - len(self.early) if self.early else 0


class BlockLedger:
    """Tells new blocks from repeated ones and counts those that never came, in bounded memory.

    Blocks may come late or out of order and are still taken once. One that comes after its gap was given up, or from a
    long gone incarnation, can no longer be told from a repetition and counts as one.

    Args:
        index: of the shard that keeps this ledger.
        num_shards: over which `shard_of` spreads a worker's blocks.
    """

    def __init__(self, index: int = 0, num_shards: int = 1) -> None:
        check(num_shards > 0, "num_shards", num_shards, "must be greater than 0")
        check(0 <= index < num_shards, "index", index, f"must lie in [0, {num_shards})")
        self.index = index
        self.num_shards = num_shards
        self._logs: dict[int, dict[int, _Log]] = {}
        self._newest_forgotten: dict[int, int] = {}
        self._num_given_up = 0

    @property
    def num_missing(self) -> int:
        """Blocks that later ones of the same worker have overtaken and that are still missing."""
        return self._num_given_up + sum(log.num_missing() for logs in self._logs.values() for log in logs.values())

    def has(self, worker_id: int, incarnation: int, sequence: int) -> bool:
        """Whether the block was recorded before.

        Raises:
            ValueError: the block belongs to another shard, or a number that cannot be negative is.
        """
        check(sequence >= 0, "sequence", sequence, "counts from 0")
        check(incarnation >= 0, "incarnation", incarnation, "counts from 0")
        owner = shard_of(worker_id, sequence, self.num_shards)
        if owner != self.index:
            raise ValueError(
                f"block {sequence} of worker {worker_id} belongs to shard {owner} of {self.num_shards}, "
                f"not to shard {self.index}; choose the shard with shard_of"
            )
        if incarnation <= self._newest_forgotten.get(worker_id, -1):
            return True
        log = self._logs.get(worker_id, {}).get(incarnation)
        return log is not None and log.has(sequence // self.num_shards)

    def newest_incarnation(self, worker_id: int) -> int:
        """The newest incarnation of a worker that is known, -1 if none is."""
        return max((*self._logs.get(worker_id, ()), self._newest_forgotten.get(worker_id, -1)))

    def record(self, worker_id: int, incarnation: int, sequence: int) -> None:
        """Note that a block, which `has` denied, is stored now."""
        logs = self._logs.setdefault(worker_id, {})
        log = logs.setdefault(incarnation, _Log())
        self._num_given_up += log.add(sequence // self.num_shards)
        while len(logs) > MAX_INCARNATIONS:
            oldest = min(logs)
            self._num_given_up += logs.pop(oldest).num_missing()
            self._newest_forgotten[worker_id] = oldest

    def save(self) -> dict[str, Any]:
        """The state: one row a log (worker, incarnation, mark), one an early block (worker, incarnation, number)."""
        logs = [(w, i, log) for w, logs in self._logs.items() for i, log in logs.items()]
        early = [(w, i, number) for w, i, log in logs for number in sorted(log.early)]
        return {
            "index": self.index,
            "num_shards": self.num_shards,
            "num_given_up": self._num_given_up,
            "logs": np.array([(w, i, log.mark) for w, i, log in logs], np.int64).reshape(-1, 3),
            "early": np.array(early, np.int64).reshape(-1, 3),
            "forgotten": np.array(list(self._newest_forgotten.items()), np.int64).reshape(-1, 2),
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Take over a saved state; raises ``ValueError`` if it is another shard's."""
        check(state["index"] == self.index, "ledger.index", state["index"], f"this is shard {self.index}")
        check(
            state["num_shards"] == self.num_shards,
            "ledger.num_shards",
            state["num_shards"],
            f"replay has {self.num_shards} shards now; resume with the number it was saved with",
        )
        for name, width in (("logs", 3), ("early", 3), ("forgotten", 2)):
            rows = state[name]
            ok = isinstance(rows, np.ndarray) and rows.dtype == np.int64 and rows.ndim == 2 and rows.shape[1] == width
            check(ok, f"ledger.{name}", type(rows).__name__, f"must be rows of {width} whole numbers")
        check(type(state["num_given_up"]) is int, "ledger.num_given_up", state["num_given_up"], "must be a number")
        self._logs = {}
        for worker, incarnation, mark in state["logs"].tolist():
            self._logs.setdefault(worker, {})[incarnation] = _Log(mark=mark)
        for worker, incarnation, number in state["early"].tolist():
            self._logs[worker][incarnation].early.add(number)
        self._newest_forgotten = dict(state["forgotten"].tolist())
        self._num_given_up = state["num_given_up"]
