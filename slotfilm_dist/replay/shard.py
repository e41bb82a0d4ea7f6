"""One replay shard: a ring of rows that takes every block once and draws from it with its own random stream."""

import copy
import json
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from slotfilm_dist.config import RunConfig, check
from slotfilm_dist.config_files import changed_fields, from_dict, to_dict
from slotfilm_dist.messages import SampleBatch, TransitionBlock
from slotfilm_dist.replay.ledger import BlockLedger
from slotfilm_dist.replay.ring import RowRing, SampleTotals, whole_number
from slotfilm_dist.replay.schema import ReplaySchema
from slotfilm_dist.seeds import Role, role_seed


@dataclass(frozen=True, kw_only=True, slots=True)
class ShardStats:
    """What a shard reports. Totals only grow; they survive a save and a load."""

    num_steps: int
    """Steps stored now."""
    capacity_steps: int
    """Steps that fit."""
    ring_bytes: int
    """Memory of the full ring."""
    inserted_steps: int
    """Steps ever stored."""
    inserted_blocks: int
    """Blocks ever stored."""
    duplicate_blocks: int
    """Blocks dropped because they had been stored before."""
    missing_blocks: int
    """Blocks that later ones have overtaken and that are missing now."""
    drawn: SampleTotals
    """Sums over the steps ever drawn."""


class ReplayShard:
    """Stores blocks and samples steps; implements `ReplayStore` and `Saveable`. For one thread at a time.

    Args:
        schema: what every block must look like.
        capacity_steps: steps kept; the oldest go first.
        seed: of the sampling stream.
        index: of this shard among `num_shards`.
        num_shards: shards that share the workers' blocks, see `ledger.shard_of`.
        block_steps: steps an environment takes per block; sets how many spare rows are allocated.
        n_step: rewards that a drawn step adds up.
        gamma: discount within such a sum.
    """

    def __init__(
        self,
        schema: ReplaySchema,
        capacity_steps: int,
        seed: int | np.random.SeedSequence,
        *,
        index: int = 0,
        num_shards: int = 1,
        block_steps: int = 32,
        n_step: int = 1,
        gamma: float = 1.0,
    ) -> None:
        self.schema = schema
        self._ring = RowRing(schema, capacity_steps, block_steps, n_step=n_step, gamma=gamma)
        self._ledger = BlockLedger(index, num_shards)
        self._rng = np.random.default_rng(seed)
        self._inserted_steps = 0
        self._inserted_blocks = 0
        self._duplicate_blocks = 0

    def insert(self, block: TransitionBlock) -> bool:
        """Store a block; False if it had been stored before.

        Raises:
            ValueError: the block does not fit the schema, holds values that are not finite, or is another shard's.
        """
        key = block.worker_id, block.incarnation, block.sequence
        if self._ledger.has(*key):
            self._duplicate_blocks += 1
            return False
        self.schema.validate(block)
        self._ring.insert(block)
        self._ledger.record(*key)
        self._inserted_steps += block.num_steps
        self._inserted_blocks += 1
        return True

    def knows(self, worker_id: int, incarnation: int, sequence: int) -> bool:
        """Whether that block counts as stored before; raises ``ValueError`` if it is another shard's."""
        return self._ledger.has(worker_id, incarnation, sequence)

    def newest_incarnation(self, worker_id: int) -> int:
        """The newest incarnation of a worker of which a block was ever stored here; -1 if there is none."""
        return self._ledger.newest_incarnation(worker_id)

    def sample(self, num_batches: int, batch_size: int) -> list[SampleBatch]:
        """Draw batches with replacement, uniformly over all stored steps.

        Raises:
            ValueError: nothing is stored.
        """
        return self.draw([batch_size] * num_batches)

    def draw(self, sizes: Sequence[int]) -> list[SampleBatch]:
        """As `sample`, with a size of its own for each batch; a size may be 0."""
        return self._ring.sample(self._rng, sizes)

    def num_steps(self) -> int:
        """Steps stored now."""
        return self._ring.num_steps

    def stats(self) -> ShardStats:
        """What to report."""
        return ShardStats(
            num_steps=self._ring.num_steps,
            capacity_steps=self._ring.capacity_steps,
            ring_bytes=self._ring.ring_bytes,
            inserted_steps=self._inserted_steps,
            inserted_blocks=self._inserted_blocks,
            duplicate_blocks=self._duplicate_blocks,
            missing_blocks=self._ledger.num_missing,
            drawn=copy.copy(self._ring.drawn),
        )

    def save(self) -> dict[str, Any]:
        """The whole state, copied: as large as the filled part of the ring."""
        return copy.deepcopy(self.view())

    def view(self) -> dict[str, Any]:
        """The state of `save` without copying; valid until the next insert. For `snapshot.write_snapshot`."""
        return {
            "schema": to_dict(self.schema),
            "ring": self._ring.view(),
            "ledger": self._ledger.save(),
            "rng": json.dumps(self._rng.bit_generator.state),
            "inserted_steps": self._inserted_steps,
            "inserted_blocks": self._inserted_blocks,
            "duplicate_blocks": self._duplicate_blocks,
        }

    def freeze(self, lock: threading.Lock) -> dict[str, Any]:
        """The state of now, for `snapshot.write_snapshot`, whatever is inserted or drawn before `thaw`.

        Args:
            lock: held here, by each insert and by `thaw`, but not while the state is read.
        """
        return self.view() | {"ring": self._ring.freeze(lock)}

    def thaw(self) -> None:
        """Nobody reads the frozen state any more."""
        self._ring.thaw()

    def load(self, state: Mapping[str, Any]) -> None:
        """Take over a saved state: the same draws follow as would have.

        Raises:
            ValueError: the state is of another schema, size or shard, or incomplete; this shard is unchanged then.
        """
        try:
            self._load(state)
        except KeyError as error:
            raise ValueError(
                f"the saved shard lacks {error}; it is not a shard's state or of another version"
            ) from None
        except (TypeError, AttributeError, IndexError, OverflowError) as error:
            raise ValueError(f"the saved shard is damaged: {error}") from None

    def _load(self, state: Mapping[str, Any]) -> None:
        differing = changed_fields(self.schema, from_dict(ReplaySchema, state["schema"], "schema."))
        if differing:
            name, (mine, saved) = next(iter(differing.items()))
            check(False, f"schema.{name}", saved, f"this replay has {mine!r}; its data cannot be taken over")
        rng = generator_from(state["rng"])
        ledger = BlockLedger(self._ledger.index, self._ledger.num_shards)
        ledger.load(state["ledger"])
        totals = tuple(whole_number(state, name) for name in ("inserted_steps", "inserted_blocks", "duplicate_blocks"))
        self._ring.load(state["ring"])
        self._ledger = ledger
        self._rng = rng
        self._inserted_steps, self._inserted_blocks, self._duplicate_blocks = totals


ShardT = TypeVar("ShardT", bound=ReplayShard)


def build_shard(kind: type[ShardT], config: RunConfig, schema: ReplaySchema, index: int) -> ShardT:
    """Shard `index` of a run, empty."""
    count = config.replay.num_shards
    return kind(
        schema,
        -(-config.replay.capacity // count),
        role_seed(config.seed, Role.REPLAY, index + 1),
        index=index,
        num_shards=count,
        block_steps=config.runtime.block_steps,
        n_step=config.n_step,
        gamma=config.sac.gamma,
    )


def generator_from(state: Any) -> np.random.Generator:
    """A random stream that goes on from its saved state, JSON; raises ``ValueError`` if it is none."""
    rng = np.random.default_rng(0)
    try:
        rng.bit_generator.state = json.loads(state)
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ValueError(f"rng: not the state of a random stream: {error}") from None
    return rng
