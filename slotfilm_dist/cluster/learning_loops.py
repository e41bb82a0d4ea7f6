"""The threads of a learner on a cluster: two fetch batches ahead, another updates and publishes weights."""

import dataclasses
import math
import queue
import threading
import time
from collections.abc import Callable, Iterable
from typing import Protocol, runtime_checkable

from slotfilm_dist.cluster.failures import RoleLostError, RoleSilentError
from slotfilm_dist.cluster.fair_lock import FairLock
from slotfilm_dist.cluster.hub import chunk_updates
from slotfilm_dist.cluster.messages import AgentSetup, UpdateGrant
from slotfilm_dist.learning.learner import Learner
from slotfilm_dist.learning.off_policy import TrainingDivergedError
from slotfilm_dist.learning.recovery import Recovery
from slotfilm_dist.messages import SampleBatch, TransitionBlock, WeightSnapshot
from slotfilm_dist.replay.sharded import EmptyReplayError

ADMIT_S = 0.5
"""Longest wait of one request for updates; what is due by then is granted."""
FETCHERS = 2
"""Requests for batches under way at once; each more lets the learner fall further behind the limiter's count."""
RESTORE_S = 10.0
"""Time that lost shards have to bring back what they held before workers fill replay up."""
RETRY_S = 0.25
"""Pause before replay is asked again."""
REQUEST_BYTES = 32 << 20
"""Batches of one request together stay below this, unless a single one is larger."""
GRANTS_AHEAD = 3
"""Batches are drawn for so many grants at once: a message to a shard costs as much as several batches in it."""
FRESH_S = 1.0
"""Batches that were drawn longer ago are not learned from, and while grants come more rarely none are drawn ahead."""


@runtime_checkable
class UpdateLink(Protocol):
    """What the learner asks of the hub."""

    def admit_updates(self, max_updates: int, timeout_s: float) -> UpdateGrant:
        """Wait until updates are due."""
        ...

    def refund_updates(self, num_updates: int) -> None:
        """Take back updates that did not happen."""
        ...

    def start_over(self, missing_steps: int) -> None:
        """Let workers bring so many steps before the next update; none is owed for them."""
        ...

    def publish(self, snapshot: WeightSnapshot) -> None:
        """Take the newest weights."""
        ...

    def set_up_agents(self, setup: AgentSetup) -> None:
        """Take what every policy needs besides the weights."""
        ...

    def newest_version(self) -> int:
        """Version of the newest weights, -1 before the first."""
        ...


@runtime_checkable
class SampleLink(Protocol):
    """What the learner asks of replay."""

    def sample(self, num_batches: int, batch_size: int) -> list[SampleBatch]:
        """Draw batches uniformly over the steps of all shards that answer."""
        ...

    def num_steps(self) -> int:
        """Steps stored in the shards that answer."""
        ...

    def insert_all(self, blocks: Iterable[TransitionBlock]) -> int:
        """Store blocks; gives the steps in them."""
        ...


class Publisher:
    """Gives a learner's weights to the hub under versions that only grow, also when the learner goes back.

    Args:
        learner: whose weights.
        hub: takes them.
    """

    def __init__(self, learner: Learner, hub: UpdateLink) -> None:
        self._learner, self._hub = learner, hub
        self._offset = 0

    def start_over(self) -> WeightSnapshot:
        """Publish the weights of a learner that has been built anew or has gone back to a checkpoint."""
        self._offset = max(0, self._hub.newest_version() + 1 - self._learner.updates)
        return self.publish()

    def publish(self) -> WeightSnapshot:
        """Publish the weights of now."""
        snapshot = self._learner.snapshot()
        snapshot = dataclasses.replace(snapshot, version=snapshot.version + self._offset)
        self._hub.publish(snapshot)
        return snapshot


class BatchReserve:
    """Batches that one fetcher has drawn ahead of the updates that they are for.

    Args:
        store: gives batches.
        batch_size: transitions of each.
        ahead: batches of one request.
        clock: seconds that only grow.
    """

    def __init__(
        self, store: SampleLink, batch_size: int, ahead: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._store, self._batch_size, self._ahead, self._clock = store, batch_size, ahead, clock
        self._batches: list[SampleBatch] = []
        self._drawn_at, self._beginning = -math.inf, 0

    def take(self, num_batches: int, beginning: int) -> list[SampleBatch]:
        """So many batches, none of them old or of an earlier beginning; raises `EmptyReplayError` without any."""
        now = self._clock()
        steady = now - self._drawn_at <= FRESH_S
        if not steady or beginning != self._beginning:
            self._batches, self._beginning = [], beginning
        missing = num_batches - len(self._batches)
        if missing > 0:
            self._batches += self._store.sample(max(missing, self._ahead) if steady else missing, self._batch_size)
            self._drawn_at = now
        taken, self._batches = self._batches[:num_batches], self._batches[num_batches:]
        return taken


class LearningLoops:
    """Runs its threads from `start` to `stop`.

    *Fetchers*: consume grants of updates and replay; produce chunks of batches, one ready while the next are fetched:
    one fetcher waits for shards while the other takes its batches apart. Each draws for several grants at once. Wait
    for the limiter, for replay to hold `replay.min_steps`, for a shard's answer, and for room. Replay that stays too
    small, because shards were lost with what they held, is filled up by the workers before the next update.

    *Updater*: consumes chunks; produces updates and, every `runtime.publish_every`, weights. Waits for a chunk. Updates
    that stay non-finite take it back to the last checkpoint, and what was drawn before is given back.

    All stop within a slice of their waits; updates that were granted and not made are given back. An error stops all
    and is kept in `error`.

    Args:
        learner: begun.
        hub: admits updates.
        store: gives batches.
        publisher: of the learner's weights.
        recovery: for updates that stay non-finite.
        between_updates: held during an update; whoever holds it sees the learner between two.
    """

    def __init__(
        self,
        learner: Learner,
        hub: UpdateLink,
        store: SampleLink,
        publisher: Publisher,
        recovery: Recovery,
        between_updates: FairLock,
    ) -> None:
        self._learner, self._hub, self._store = learner, hub, store
        self._publisher, self._recovery, self._state = publisher, recovery, between_updates
        self._config = learner.config
        self._stopping = threading.Event()
        self._ready: queue.Queue[tuple[int, list[SampleBatch]]] = queue.Queue(1)
        self._beginning = 0
        """Grows when the learner goes back to a checkpoint; what was drawn before is not learned from."""
        self._granted = self._made = 0
        self._counting = threading.Lock()
        self._started_over_at = -math.inf
        self._counted = learner.updates
        self.waiting_for = self.error = ""
        self.waited_s = self.batch_wait_s = self.update_s = 0.0
        self._threads = [
            threading.Thread(target=self._guard, args=(loop,), name=loop.__name__.strip("_"), daemon=True)
            for loop in (*[self._fetch_loop] * FETCHERS, self._update_loop)
        ]

    def start(self) -> None:
        """Start the threads."""
        for thread in self._threads:
            thread.start()

    def stop(self, timeout_s: float) -> None:
        """Stop after the running update and give back what was granted.

        Raises:
            RoleSilentError: a thread still runs when time is up.
        """
        self._stopping.set()
        deadline = time.monotonic() + timeout_s
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))
            if thread.is_alive():
                raise RoleSilentError("learner", f"its thread {thread.name} to end", timeout_s)
        self._learner.settle()
        self._count()
        self._hub.refund_updates(self._granted - self._made)
        self._granted = self._made
        self._publisher.publish()

    def _guard(self, loop: Callable[[], None]) -> None:
        try:
            loop()
        except TrainingDivergedError as error:
            self.error = str(error)
        except Exception as error:  # told to the driver, which ends or restarts the learner
            self.error = f"{type(error).__name__}: {error}".splitlines()[0]
        finally:
            self._stopping.set()

    def _fetch_loop(self) -> None:
        chunk = chunk_updates(self._config.schedule.updates_per_step)
        schema, size = self._learner.schema(), self._config.sac.batch_size
        most = max(1, REQUEST_BYTES // (2 * schema.row_bytes * size))
        chunk = min(chunk, most)
        reserve = BatchReserve(self._store, size, min(GRANTS_AHEAD * chunk, most))
        while not self._stopping.is_set():
            grant = self._hub.admit_updates(chunk, ADMIT_S)
            self.waiting_for = grant.waiting_for and f"the limiter: {grant.waiting_for}"
            if grant.num_updates:
                with self._counting:
                    self._granted += grant.num_updates
                self._pass_on(self._beginning, self._fetch(grant.num_updates, reserve))

    def _fetch(self, num_batches: int, reserve: BatchReserve) -> list[SampleBatch]:
        """Batches, once replay holds enough; none when the loop is told to stop, or where replay stays too small."""
        wanted, began, stored = self._config.replay.min_steps, time.monotonic(), 0
        while not self._stopping.is_set():
            try:
                stored = self._store.num_steps()
                if stored >= wanted:
                    return reserve.take(num_batches, self._beginning)
                self.waiting_for = f"replay to hold {wanted} steps; it holds {stored}"
            except (RoleLostError, RoleSilentError, EmptyReplayError) as error:
                self.waiting_for = str(error)
            if stored < wanted and time.monotonic() - began > RESTORE_S:
                self._give_back(made=0, granted=num_batches)
                self._start_over(wanted - stored, began)
                return []
            self._stopping.wait(RETRY_S)
        return []

    def _start_over(self, missing_steps: int, began: float) -> None:
        """Have replay filled up, unless another fetcher has asked for that since this one began to wait."""
        with self._counting:
            if self._started_over_at > began:
                return
            self._started_over_at = time.monotonic()
        self._hub.start_over(missing_steps)

    def _pass_on(self, beginning: int, batches: list[SampleBatch]) -> None:
        while batches and not self._stopping.is_set():
            try:
                self._ready.put((beginning, batches), timeout=RETRY_S)
                return
            except queue.Full:
                continue

    def _update_loop(self) -> None:
        learner, every = self._learner, self._config.runtime.publish_every
        next_publish = learner.updates + every
        while not self._stopping.is_set():
            began = time.monotonic()
            try:
                beginning, batches = self._ready.get(timeout=RETRY_S)
            except queue.Empty:
                self.waited_s += time.monotonic() - began
                self._settle()
                continue
            self.batch_wait_s = time.monotonic() - began
            self.waited_s += self.batch_wait_s
            for index, batch in enumerate(batches):
                if self._stopping.is_set():
                    break
                if beginning != self._beginning:
                    self._give_back(made=0, granted=len(batches) - index)
                    break
                if self._update(batch):
                    next_publish = learner.updates + every
                elif learner.updates >= next_publish:
                    self._publisher.publish()
                    next_publish = learner.updates + every

    def _update(self, batch: SampleBatch) -> bool:
        """Make an update; True if it took the learner back to a checkpoint."""
        began = time.monotonic()
        with self._state:
            try:
                self._learner.update(batch)
            except TrainingDivergedError as error:
                counted = self._counted
                self._recovery.roll_back(error)
                self._counted = self._learner.updates
                # By our own count: a GPU's updates that turned out to be skipped have left the learner's already.
                self._give_back(made=counted - self._counted, granted=1)
                self._beginning += 1
                self._publisher.start_over()
                return True
            made = self._count()
        if made < 1:  # some were skipped for a loss or gradient that was not finite: they are due again
            self._give_back(made=0, granted=1 - made)
        self.update_s = time.monotonic() - began
        return False

    def _settle(self) -> None:
        """While there is nothing to do: updates of a GPU that turn out to have been skipped are due again."""
        with self._state:
            self._learner.settle()
            made = self._count()
        if made < 0:
            self._give_back(made=0, granted=-made)

    def _count(self) -> int:
        """Updates made since the last call; fewer than none where earlier ones turn out to have been skipped."""
        made = self._learner.updates - self._counted
        self._counted += made
        with self._counting:
            self._made += made
        return made

    def _give_back(self, *, made: int, granted: int) -> None:
        """Updates that are due again: some that were made and are lost, some that were granted and not made."""
        with self._counting:
            self._made -= made
            self._granted -= made + granted
        self._hub.refund_updates(made + granted)
