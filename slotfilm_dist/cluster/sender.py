"""Takes a worker's blocks to replay while the worker goes on stepping."""

import contextlib
import queue
import threading
import time
from collections.abc import Iterable
from typing import Protocol, runtime_checkable

from slotfilm_dist.cluster.failures import RoleLostError, RoleSilentError
from slotfilm_dist.cluster.messages import BlockKey, BlockNotice, StepGrant
from slotfilm_dist.messages import TransitionBlock

ADMIT_S = 1.0
"""Longest wait of one request to the limiter."""
RETRY_S = 0.2
"""Pause before a shard that did not take a block is asked again."""
MAX_PARKED = 32
"""Blocks kept for a shard that does not answer, while those for the others go on; 6 MB of tokens."""


@runtime_checkable
class HubLink(Protocol):
    """What a worker asks of the hub."""

    def admit_steps(self, notice: BlockNotice, stored: Iterable[BlockKey], timeout_s: float) -> StepGrant:
        """Wait until a block's steps fit."""
        ...

    def confirm(self, stored: Iterable[BlockKey]) -> None:
        """Note that blocks are in replay."""
        ...


@runtime_checkable
class StoreLink(Protocol):
    """What a worker asks of replay."""

    def insert(self, block: TransitionBlock) -> bool:
        """Store a block once; may be called by two threads."""
        ...

    def index_of(self, block: TransitionBlock) -> int:
        """The shard that takes it."""
        ...


class BlockSender:
    """Asks the limiter for each block, then stores it, in a thread of its own.

    Consumes blocks, one waiting and one under way; produces stored blocks. Waits for the limiter, then for the block's
    shard. Blocks for a shard that does not answer are parked, up to `MAX_PARKED`,
    and a second thread offers them until it answers, so that the other shards go on being filled; the same block is
    stored once. Ends when closed, when the run has all its steps, or when the hub is gone.

    Args:
        hub: admits.
        store: takes the blocks.
    """

    def __init__(self, hub: HubLink, store: StoreLink) -> None:
        self._hub, self._store = hub, store
        self._queue: queue.Queue[TransitionBlock | None] = queue.Queue(1)
        self._parked: queue.Queue[TransitionBlock] = queue.Queue(MAX_PARKED)
        self._silent_shard = -1
        self._closing = threading.Event()
        self._stored_lock = threading.Lock()
        self._stored: list[BlockKey] = []
        self._waiting_for = "room for a block"
        self._error: Exception | None = None
        self.finished = False
        self._parking = threading.Thread(target=self._offer_parked, name="parked-blocks", daemon=True)
        self._parking.start()
        self._thread = threading.Thread(target=self._run, name="block-sender", daemon=True)
        self._thread.start()

    def offer(self, block: TransitionBlock, timeout_s: float) -> bool:
        """Take a block, or say False while two are under way.

        Raises:
            RoleLostError: the hub is gone.
            ValueError: replay refused a block.
        """
        if self._error is not None:
            raise self._error
        try:
            self._queue.put(block, timeout=timeout_s)
        except queue.Full:
            return False
        return True

    def waiting_for(self) -> str:
        """What it waits for now."""
        return self._waiting_for

    def close(self) -> None:
        """Finish the block that was admitted, drop the others, confirm, and end."""
        self._closing.set()
        self._thread.join()
        self._parking.join()
        with contextlib.suppress(RoleLostError, RoleSilentError):
            self._hub.confirm(self._take_stored())

    def _run(self) -> None:
        try:
            while not (self._closing.is_set() or self.finished):
                try:
                    block = self._queue.get(timeout=RETRY_S)
                except queue.Empty:
                    continue
                if block is not None and self._admit(block):
                    self._deliver(block)
            self._hub.confirm(self._take_stored())
        except Exception as error:  # raised again in the thread that offers blocks
            self._error = error

    def _admit(self, block: TransitionBlock) -> bool:
        notice = BlockNotice(
            key=_key(block), num_steps=block.num_steps, policy_version=block.policy_version, episodes=block.episodes
        )
        while not self._closing.is_set():
            grant = self._hub.admit_steps(notice, self._take_stored(), ADMIT_S)
            if grant.finished:
                self.finished = True
                return False
            if grant.granted:
                return True
            self._waiting_for = f"the limiter: {grant.waiting_for}"
            if grant.retry_s:
                self._closing.wait(grant.retry_s)
        return False

    def _deliver(self, block: TransitionBlock) -> None:
        """Store an admitted block, or park it while its shard does not answer."""
        self._waiting_for = "replay to store a block"
        if self._store.index_of(block) == self._silent_shard or not self._insert(block):
            self._silent_shard = self._store.index_of(block)
            while not self._closing.is_set():
                try:
                    self._parked.put(block, timeout=RETRY_S)
                    break
                except queue.Full:
                    continue
        self._waiting_for = "room for a block"

    def _offer_parked(self) -> None:
        """Store parked blocks in their order, as soon as their shard answers."""
        while not (self._closing.is_set() and self._parked.empty()):
            try:
                block = self._parked.get(timeout=RETRY_S)
            except queue.Empty:
                continue
            while not self._insert(block):
                if self._closing.is_set():
                    return  # the hub takes back what was admitted and never stored
                time.sleep(RETRY_S)
            if self._parked.empty():
                self._silent_shard = -1

    def _insert(self, block: TransitionBlock) -> bool:
        """Whether the shard answered; a refused block is an error of the thread that offers blocks."""
        try:
            self._store.insert(block)
        except (RoleLostError, RoleSilentError) as error:
            self._waiting_for = str(error)
            return False
        except Exception as error:
            self._error = error
            raise
        with self._stored_lock:
            self._stored.append(_key(block))
        return True

    def _take_stored(self) -> list[BlockKey]:
        with self._stored_lock:
            stored, self._stored = self._stored, []
        return stored


def _key(block: TransitionBlock) -> BlockKey:
    return BlockKey(worker_id=block.worker_id, incarnation=block.incarnation, sequence=block.sequence)
