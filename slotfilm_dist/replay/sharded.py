"""Several shards as one replay: blocks go to their shard, draws are uniform over all stored steps."""

import copy
import dataclasses
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Int64

from slotfilm_dist.config import check
from slotfilm_dist.messages import SampleBatch, TransitionBlock
from slotfilm_dist.replay.ledger import shard_of
from slotfilm_dist.replay.shard import ReplayShard, generator_from


class EmptyReplayError(ValueError):
    """Nothing is stored in any shard."""


def split_draws(
    rng: np.random.Generator, num_steps: Sequence[int], num_batches: int, batch_size: int
) -> Int64[np.ndarray, "batches shards"]:
    """How many steps of each batch come from each shard, so that every stored step is equally likely.

    Args:
        rng: the stream to draw from.
        num_steps: steps stored in each shard; a lost one counts 0.
        num_batches: batches wanted.
        batch_size: steps of each.

    Raises:
        EmptyReplayError: nothing is stored anywhere.
    """
    stored = np.asarray(num_steps, np.float64)
    if stored.sum() == 0:
        raise EmptyReplayError("replay is empty: insert a block before sampling")
    return rng.multinomial(batch_size, stored / stored.sum(), size=num_batches)


def join_batches(parts: Sequence[SampleBatch]) -> SampleBatch:
    """One batch of all parts' transitions, in their order; a single part that is not empty is returned as it is."""
    filled = [part for part in parts if len(part.reward)] or list(parts[:1])
    if len(filled) == 1:
        return filled[0]
    names = [f.name for f in dataclasses.fields(SampleBatch)]
    return SampleBatch(**{name: np.concatenate([getattr(part, name) for part in filled]) for name in names})


def cut(rows: SampleBatch, sizes: Int64[np.ndarray, " batches"]) -> list[SampleBatch]:
    """The transitions in batches of these sizes, in their order, without a copy."""
    ends = np.cumsum(sizes)
    assert ends[-1] == len(rows.reward), "sizes add up to the rows"
    columns = {f.name: getattr(rows, f.name) for f in dataclasses.fields(SampleBatch)}
    return [
        SampleBatch(**{name: column[end - size : end] for name, column in columns.items()})
        for end, size in zip(ends, sizes, strict=True)
    ]


class ShardedReplay:
    """Shards in one process; implements `ReplayStore` and `Saveable`.

    Which shard a block goes to depends on its worker and number alone, so a repeated block meets the shard that knows
    it. Shards may fill unevenly: each batch draws from them in proportion to what they hold. Within a batch the
    transitions are ordered by shard.
    """

    def __init__(self, shards: Sequence[ReplayShard], seed: int | np.random.SeedSequence) -> None:
        check(len(shards) > 0, "shards", len(shards), "replay needs at least one shard")
        self._shards = list(shards)
        self._rng = np.random.default_rng(seed)

    def insert(self, block: TransitionBlock) -> bool:
        """Store a block in its shard; False if it had been stored before."""
        return self._shards[shard_of(block.worker_id, block.sequence, len(self._shards))].insert(block)

    def knows(self, worker_id: int, incarnation: int, sequence: int) -> bool:
        """Whether that block counts as stored before."""
        return self._shards[shard_of(worker_id, sequence, len(self._shards))].knows(worker_id, incarnation, sequence)

    def newest_incarnation(self, worker_id: int) -> int:
        """The newest incarnation of a worker of which a block was ever stored; -1 if there is none."""
        return max(shard.newest_incarnation(worker_id) for shard in self._shards)

    def sample(self, num_batches: int, batch_size: int) -> list[SampleBatch]:
        """Draw batches with replacement, uniformly over the steps of all shards.

        Raises:
            ValueError: nothing is stored.
        """
        sizes = split_draws(self._rng, [shard.num_steps() for shard in self._shards], num_batches, batch_size)
        parts = [
            shard.draw(wanted.tolist()) for shard, wanted in zip(self._shards, sizes.T, strict=True) if wanted.any()
        ]
        return [join_batches(of_shards) for of_shards in zip(*parts, strict=True)]

    def num_steps(self) -> int:
        """Steps stored now, over all shards."""
        return sum(shard.num_steps() for shard in self._shards)

    def save(self) -> dict[str, Any]:
        """The state of every shard, copied, and of the stream that splits draws among them."""
        return copy.deepcopy(self.view())

    def view(self) -> dict[str, Any]:
        """The state of `save` without copying; valid until the next insert. For `snapshot.write_snapshot`."""
        return {
            "shards": {f"shard{index}": shard.view() for index, shard in enumerate(self._shards)},
            "rng": json.dumps(self._rng.bit_generator.state),
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Take over a saved state; raises ``ValueError`` if it does not fit."""
        names = [f"shard{index}" for index in range(len(self._shards))]
        saved = state.get("shards")
        if not isinstance(saved, Mapping):
            raise ValueError(f"shards: is {type(saved).__name__}, must hold the state of every shard")
        check(set(saved) == set(names), "shards", len(saved), f"this replay has {len(self._shards)}")
        rng = generator_from(state.get("rng"))
        for name, shard in zip(names, self._shards, strict=True):
            shard.load(saved[name])
        self._rng = rng
