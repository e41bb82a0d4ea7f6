"""The replay shards as the other roles see them: each of its own, or all as one store."""

import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slotfilm_dist.cluster.actors import ShardActor
from slotfilm_dist.cluster.clients import ANSWER_S, ActorLink, is_ready
from slotfilm_dist.cluster.failures import RoleLostError, RoleSilentError
from slotfilm_dist.cluster.messages import BlockKey, ShardBeat
from slotfilm_dist.config import RunConfig
from slotfilm_dist.messages import SampleBatch, TransitionBlock
from slotfilm_dist.replay.ledger import shard_of
from slotfilm_dist.replay.schema import ReplaySchema
from slotfilm_dist.replay.sharded import cut, join_batches, split_draws

DRAW_S = 2.0
"""Longest wait for a shard's batches before the other shards are asked instead."""
LOOK_S = 10.0
"""Longest wait for a shard's beat where somebody waits for it."""
INSERT_S = 5.0
"""Longest wait for a shard to store a block before it is sent again."""
REFRESH_S = 0.5
"""Pause between questions to a shard that did not answer."""
SHARD_RESTARTS = 100
"""How often a shard's process is replaced in one run."""
INSERTS_AHEAD = 8
"""Blocks under way while replay is filled."""


class ShardClient:
    """One shard as other roles see it."""

    def __init__(self, link: ActorLink, index: int) -> None:
        self._link, self.index = link, index
        self._question: Any = None
        self._asked_at = 0.0
        self._last: ShardBeat | None = None

    @classmethod
    def launch(
        cls,
        config: RunConfig,
        schema: ReplaySchema,
        index: int,
        folder: Path,
        *,
        resume: bool,
        resources: Mapping[str, float],
    ) -> "ShardClient":
        """Start a shard where there are these Ray resources; Ray replaces its process when it dies."""
        link = ActorLink.launch(
            *(ShardActor, f"shard {index}", config, schema, index, folder),
            keywords={"resume": resume},
            num_cpus=0,
            resources=dict(resources),
            max_restarts=SHARD_RESTARTS,
            max_task_retries=0,
        )
        return cls(link, index)

    def insert(self, block: TransitionBlock) -> bool:
        """Store a block; False if it had been stored before."""
        return self.await_insert(self.begin_insert(block))

    def begin_insert(self, block: TransitionBlock) -> Any:
        """Send a block; `await_insert` takes the result."""
        return self._link.begin("insert", block)

    def await_insert(self, request: Any) -> bool:
        """The result of `begin_insert`."""
        return self._link.answer(request, "a block to be stored", INSERT_S)

    def begin_draw(self, num_rows: int) -> Any:
        """Ask for transitions; `await_draw` takes them."""
        return self._link.begin("draw", num_rows)

    def await_draw(self, request: Any) -> tuple[SampleBatch, int]:
        """The result of `begin_draw`: transitions, and steps stored."""
        return self._link.answer(request, "batches", DRAW_S)

    def begin_count(self) -> Any:
        """Ask for the number of stored steps."""
        return self._link.begin("call", "num_steps")

    def count(self, request: Any) -> int | None:
        """The result of `begin_count`, or None while there is none; raises `RoleLostError` if it will not come."""
        return self._link.answer(request, "its size", DRAW_S) if is_ready(request, 0) else None

    def num_steps(self, timeout_s: float = ANSWER_S) -> int:
        """Steps stored now."""
        return self._link.answer(self.begin_count(), "its size", timeout_s)

    def fence(self, worker_id: int, incarnation: int, asked: Iterable[BlockKey]) -> list[BlockKey]:
        """Refuse what comes late from a lost worker."""
        request = self._link.begin("call", "fence", worker_id, incarnation, list(asked))
        return self._link.answer(request, "to fence a lost worker off", INSERT_S)

    def beat(self, timeout_s: float = ANSWER_S) -> ShardBeat:
        """How it does; waits until its process has started."""
        return self._link.answer(self._link.begin("call", "beat"), "how it does", timeout_s)

    def look(self) -> ShardBeat | None:
        """A beat of now, None if it does not answer."""
        try:
            self._last = self.beat(LOOK_S)
        except (RoleLostError, RoleSilentError):
            self._last = None
        return self._last

    def poll(self) -> ShardBeat | None:
        """The last beat, None while it does not answer; never waits."""
        if self._question is None:
            self._question, self._asked_at = self._link.begin("call", "beat"), time.monotonic()
        if is_ready(self._question):
            question, self._question = self._question, None
            try:
                self._last = self._link.answer(question, "how it does", ANSWER_S)
            except RoleLostError:
                self._last = None
        elif time.monotonic() - self._asked_at > DRAW_S:
            self._last = None
        return self._last

    def process_id(self) -> int:
        """Of its process now."""
        return self._link.answer(self._link.begin("call", "process_id"), "its process id", ANSWER_S)

    def begin_snapshot(self) -> Any:
        """Start writing a snapshot; `await_snapshot` waits for it."""
        return self._link.begin("snapshot")

    def await_snapshot(self, request: Any, timeout_s: float) -> int:
        """The steps in the snapshot."""
        return self._link.answer(request, "its snapshot to be written", timeout_s)

    def kill(self) -> None:
        """End the process for good."""
        self._link.kill()


class ReplayClient:
    """All shards as one `ReplayStore`. Several threads may sample at once; every role has its own.

    A shard that is lost or silent counts as empty until it answers again, so the others are drawn from in proportion to
    what they hold.

    Args:
        shards: in their order.
        seed: of the stream that splits draws among them.
    """

    def __init__(self, shards: Sequence[ShardClient], seed: np.random.SeedSequence) -> None:
        self._shards, self._seed = list(shards), seed
        self._rng = np.random.default_rng(seed)
        self._choosing = threading.Lock()
        """Held while it is settled which shards to draw from; not while they are waited for."""
        self._sizes = [0] * len(shards)
        self._counts: dict[int, Any] = {}
        self._asked_at = [0.0] * len(shards)

    def __reduce__(self) -> tuple[Any, ...]:
        """To another process it goes as new."""
        return ReplayClient, (self._shards, self._seed)

    def insert(self, block: TransitionBlock) -> bool:
        """Store a block in its shard; False if it had been stored before."""
        return self._shard_of(block).insert(block)

    def index_of(self, block: TransitionBlock) -> int:
        """The shard that takes a block."""
        return shard_of(block.worker_id, block.sequence, len(self._shards))

    def insert_all(self, blocks: Iterable[TransitionBlock]) -> int:
        """Store blocks, a few at a time; gives the steps in them."""
        under_way: list[tuple[ShardClient, Any]] = []
        num_steps = 0
        for block in blocks:
            shard = self._shard_of(block)
            under_way.append((shard, shard.begin_insert(block)))
            num_steps += block.num_steps
            if len(under_way) >= INSERTS_AHEAD:
                oldest, request = under_way.pop(0)
                oldest.await_insert(request)
        for shard, request in under_way:
            shard.await_insert(request)
        return num_steps

    def sample(self, num_batches: int, batch_size: int) -> list[SampleBatch]:
        """Draw batches uniformly over the steps of all shards that answer.

        Raises:
            EmptyReplayError: nothing is stored in the shards that answer.
        """
        while True:
            with self._choosing:
                self._refresh(wait=sum(self._sizes) == 0)
                sizes = split_draws(self._rng, self._sizes, num_batches, batch_size)
                # One message for all batches: what comes of a shard is cut up here.
                asked = [
                    (shard, wanted, shard.begin_draw(int(wanted.sum())))
                    for shard, wanted in zip(self._shards, sizes.T, strict=True)
                    if wanted.any()
                ]
            parts = [
                cut(rows, wanted)
                for shard, wanted, request in asked
                if (rows := self._drawn(shard, request)) is not None
            ]
            if len(parts) == len(asked):
                return [join_batches(of_shards) for of_shards in zip(*parts, strict=True)]

    def num_steps(self) -> int:
        """Steps stored in the shards that answer, as of half a second ago."""
        with self._choosing:
            self._refresh(wait=sum(self._sizes) == 0, ask_all=True)
            return sum(self._sizes)

    def _drawn(self, shard: ShardClient, request: Any) -> SampleBatch | None:
        try:
            rows, self._sizes[shard.index] = shard.await_draw(request)
        except (RoleLostError, RoleSilentError, ValueError):
            self._sizes[shard.index] = 0
            return None
        return rows

    def _refresh(self, *, wait: bool, ask_all: bool = False) -> None:
        """Ask shards that count as empty, or all, how much they hold."""
        deadline = time.monotonic() + (DRAW_S if wait else 0.0)
        self._ask(everyone=ask_all)
        while self._counts:
            for index, request in list(self._counts.items()):
                try:
                    count = self._shards[index].count(request)
                except (RoleLostError, RoleSilentError):
                    count = 0
                if count is not None:
                    del self._counts[index]
                    self._sizes[index] = count
            if not self._counts or time.monotonic() >= deadline:
                return
            time.sleep(0.005)

    def _ask(self, *, everyone: bool) -> None:
        now = time.monotonic()
        for shard in self._shards:
            i = shard.index
            if (everyone or self._sizes[i] == 0) and i not in self._counts and now - self._asked_at[i] >= REFRESH_S:
                self._asked_at[i] = now
                self._counts[i] = shard.begin_count()

    def _shard_of(self, block: TransitionBlock) -> ShardClient:
        return self._shards[self.index_of(block)]
