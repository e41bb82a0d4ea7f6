"""The one place where steps and updates are counted, and where the newest weights lie."""

import random
import threading
import time
from collections.abc import Iterable
from typing import Any

from slotfilm_dist.cluster.messages import AgentSetup, BlockKey, BlockNotice, HubStatus, StepGrant, UpdateGrant
from slotfilm_dist.messages import TrainingEpisode, WeightSnapshot
from slotfilm_dist.replay.limiter import RateLimiter

SLACK_STEPS = 64
"""Steps that the workers may be ahead of the learner, at least; see `build_limiter`."""
CHUNK_STEPS = 8
"""Updates for so many steps are granted at once."""
MAX_CHUNK_UPDATES = 16
WAITING_ROOM = 48
"""Workers that wait in the hub at once, each on a thread; fewer than there are, so that no call queues for one."""
ASKS_PER_S = 200.0
"""Workers beyond those are told to ask again later, together about so often."""
LEAST_RETRY_S = 0.1
"""Shortest mean time until they ask again."""


def chunk_updates(updates_per_step: float) -> int:
    """Updates that the learner asks for at once."""
    return max(1, min(MAX_CHUNK_UPDATES, int(CHUNK_STEPS * updates_per_step)))


def build_limiter(updates_per_step: float, min_steps: int, block_steps: int) -> RateLimiter:
    """A limiter whose ratio is off by at most 1 % of 10,000 steps for blocks of up to 55 steps.

    The workers' lead (64 steps) and the four chunks of updates that the learner has been granted and not yet made (32
    steps: two being fetched, one ready, one in use) stay below 100 steps. Larger blocks need a larger lead.
    """
    needed = block_steps + -(-chunk_updates(updates_per_step) // updates_per_step) + 1
    return RateLimiter(updates_per_step, min_steps, slack_updates=0, slack_steps=max(SLACK_STEPS, int(needed)))


class Hub:
    """Admits steps and updates, keeps the newest weights, and knows how many workers are wanted. Thread-safe.

    A worker's steps count from the grant on, and for good once the worker has said that they are stored. What a lost
    worker had been granted and not stored is taken back (`settle`), so the ratio stays exact whoever dies.

    So that hundreds of workers may wait, only some of them wait here. The others are answered at once and ask again
    after a while: at a random time, and the later the more workers there are. The learner never lacks steps for it,
    because whoever is told so has all those that wait here before it.

    Args:
        limiter: of the run.
        total_steps: no more are admitted once so many are.
        num_workers: wanted at first.
        auto_workers: the run changes that number by itself.
        waiting_room: workers that wait here at once.
    """

    def __init__(
        self,
        limiter: RateLimiter,
        total_steps: int,
        num_workers: int,
        *,
        auto_workers: bool = False,
        waiting_room: int = WAITING_ROOM,
    ) -> None:
        self._places = threading.Semaphore(waiting_room)
        self._limiter = limiter
        self._total_steps = total_steps
        self._lock = threading.Lock()
        self._newer = threading.Condition(self._lock)
        self._pending: dict[BlockKey, BlockNotice] = {}
        self._gone: dict[int, int] = {}
        self._steps_by_worker: dict[int, int] = {}
        self._acting: dict[int, tuple[int, float]] = {}
        self._episodes: list[TrainingEpisode] = []
        self._published: dict[int, float] = {-1: time.time()}
        self._snapshot: WeightSnapshot | None = None
        self._setup: AgentSetup | None = None
        self._num_blocks = self._num_refunded_steps = self._num_published = 0
        self._wanted_workers, self._auto_workers = num_workers, auto_workers
        self._alive_workers = 0

    def admit_steps(self, notice: BlockNotice, stored: Iterable[BlockKey], timeout_s: float) -> StepGrant:
        """Wait until a block's steps fit; asked again for the same block, they are not counted again.

        Where too many wait already, the answer comes at once and says when to ask again.

        Args:
            notice: the block that is to be stored.
            stored: earlier blocks of the same worker that are in replay by now.
            timeout_s: longest wait.
        """
        self.confirm(stored)
        with self._lock:
            version = notice.policy_version
            self._acting[notice.key.worker_id] = (version, self._published.get(version, time.time()))
            known = notice.key in self._pending
        waited_s, waiting_for, granted, retry_s = 0.0, "", known, 0.0
        if not known and not self.finished:
            waits = self._places.acquire(blocking=False)
            try:
                admission = self._limiter.await_insert(notice.num_steps, timeout_s if waits else 0.0)
            finally:
                if waits:
                    self._places.release()
            retry_s = 0.0 if waits or admission.granted else self._retry_s()
            waited_s, waiting_for, granted = admission.waited_s, admission.waiting_for, admission.granted
            if granted:
                granted = self._note_granted(notice)
        return StepGrant(
            granted=granted,
            waited_s=waited_s,
            waiting_for=waiting_for,
            finished=not granted and self.finished,
            retry_s=retry_s,
        )

    def _retry_s(self) -> float:
        """A time that spreads the questions of all workers that act."""
        mean_s = max(LEAST_RETRY_S, len(self._acting) / ASKS_PER_S)
        return mean_s * random.uniform(0.5, 1.5)

    def _note_granted(self, notice: BlockNotice) -> bool:
        """Remember a grant; a worker that was lost, or too late, while it waited gets none."""
        with self._lock:
            alive = notice.key.incarnation > self._gone.get(notice.key.worker_id, -1)
            # Others may have brought the run's last steps while this worker waited.
            if alive and self._limiter.env_steps - notice.num_steps < self._total_steps:
                self._pending[notice.key] = notice
                return True
        self._limiter.refund_insert(notice.num_steps)
        return False

    def confirm(self, stored: Iterable[BlockKey]) -> None:
        """Note that granted blocks are in replay."""
        with self._lock:
            for key in stored:
                notice = self._pending.pop(key, None)
                if notice is None:
                    continue
                self._num_blocks += 1
                worker = key.worker_id
                self._steps_by_worker[worker] = self._steps_by_worker.get(worker, 0) + notice.num_steps
                where = {"policy_version": notice.policy_version, "env_steps": self._limiter.env_steps}
                self._episodes += [TrainingEpisode(summary=episode, **where) for episode in notice.episodes]

    def pending(self, worker_id: int, incarnation: int) -> list[BlockKey]:
        """Blocks of a worker that were granted and not confirmed."""
        with self._lock:
            return [k for k in self._pending if (k.worker_id, k.incarnation) == (worker_id, incarnation)]

    def settle(self, worker_id: int, incarnation: int, stored: Iterable[BlockKey]) -> int:
        """A worker is gone: confirm what it had stored, take back the rest; gives the steps taken back."""
        self.confirm(stored)
        with self._lock:
            self._gone[worker_id] = max(incarnation, self._gone.get(worker_id, -1))
            lost = [k for k in self._pending if k.worker_id == worker_id and k.incarnation <= incarnation]
            num_steps = sum(self._pending.pop(k).num_steps for k in lost)
            self._num_refunded_steps += num_steps
            self._acting.pop(worker_id, None)
        if num_steps:
            self._limiter.refund_insert(num_steps)
        return num_steps

    def admit_updates(self, max_updates: int, timeout_s: float) -> UpdateGrant:
        """Wait until `max_updates` are due, or grant what is due when time runs out."""
        admission = self._limiter.await_update(max_updates, timeout_s)
        if admission.granted:
            return UpdateGrant(num_updates=max_updates, waited_s=admission.waited_s, waiting_for="")
        due = min(max_updates, self._limiter.updates_owed())
        granted = due > 0 and self._limiter.try_update(due)
        return UpdateGrant(
            num_updates=due if granted else 0,
            waited_s=admission.waited_s,
            waiting_for="" if granted else admission.waiting_for,
        )

    def refund_updates(self, num_updates: int) -> None:
        """Take back granted updates that did not happen."""
        if num_updates:
            self._limiter.refund_update(num_updates)

    def count_random_steps(self, num_steps: int) -> None:
        """Note the random policy's steps and let learning begin after them."""
        self._limiter.try_insert(num_steps)
        self._limiter.start_learning(num_steps)

    def start_over(self, missing_steps: int) -> None:
        """After a loss of stored steps: no updates until so many new ones have come, and none are owed for them."""
        self._limiter.start_learning(self._limiter.env_steps + missing_steps)

    def load(self, limiter: dict[str, Any]) -> None:
        """Continue a run's counters."""
        self._limiter.load(limiter)

    def save(self, updates: int) -> dict[str, Any]:
        """The limiter's counters as they are once everything under way is dropped.

        Args:
            updates: that the learner has made; those granted beyond are due again.
        """
        with self._lock:
            under_way = sum(notice.num_steps for notice in self._pending.values())
        state = self._limiter.save()
        return state | {"env_steps": state["env_steps"] - under_way, "updates": updates}

    def publish(self, snapshot: WeightSnapshot) -> None:
        """Take the newest weights."""
        with self._lock:
            if self._snapshot is not None and snapshot.version < self._snapshot.version:
                return  # overtaken on the way
            self._snapshot = snapshot
            self._num_published += 1
            self._published[snapshot.version] = snapshot.published_at_s
            for version in sorted(self._published)[:-1000]:
                del self._published[version]
            self._newer.notify_all()

    def await_newer(self, newer_than: int, timeout_s: float) -> WeightSnapshot | None:
        """The newest weights, as soon as there are some newer than a version; None when time runs out."""
        with self._newer:
            self._newer.wait_for(lambda: self._snapshot is not None and self._snapshot.version > newer_than, timeout_s)
        return self.latest(newer_than)

    def latest(self, newer_than: int) -> WeightSnapshot | None:
        """The newest weights, or None while there are none newer than the given version."""
        with self._lock:
            newest = self._snapshot
        return newest if newest is not None and newest.version > newer_than else None

    def newest_version(self) -> int:
        """Version of the newest weights, -1 before the first."""
        with self._lock:
            return self._snapshot.version if self._snapshot else -1

    def set_up_agents(self, setup: AgentSetup) -> None:
        """Take what every policy needs besides the weights."""
        self._setup = setup

    def agent_setup(self) -> AgentSetup:
        """What every policy needs besides the weights; the learner gives it before any policy asks."""
        assert self._setup is not None, "the learner sets agents up before they act"
        return self._setup

    def want_workers(self, num_workers: int) -> None:
        """Ask for a number of workers, kept from now on; the supervisor starts or stops them."""
        if num_workers < 1:
            raise ValueError(f"workers = {num_workers}: must be 1 or more")
        with self._lock:
            self._wanted_workers, self._auto_workers = num_workers, False

    def want_auto_workers(self) -> None:
        """Let the run decide from now on how many workers it needs."""
        with self._lock:
            self._auto_workers = True

    def adapt_workers(self, num_workers: int) -> None:
        """The run's own decision; somebody who has asked for a number meanwhile keeps it."""
        with self._lock:
            if self._auto_workers:
                self._wanted_workers = num_workers

    def note_alive(self, num_workers: int) -> None:
        """The supervisor says how many workers run."""
        with self._lock:
            self._alive_workers = num_workers

    def take_episodes(self) -> list[TrainingEpisode]:
        """Episodes that ended in stored blocks since the last call."""
        with self._lock:
            episodes, self._episodes = self._episodes, []
        return episodes

    @property
    def finished(self) -> bool:
        """All steps of the run have been admitted."""
        return self._limiter.env_steps >= self._total_steps

    def status(self) -> HubStatus:
        """The counters."""
        limiter = self._limiter
        with self._lock:
            under_way = sum(notice.num_steps for notice in self._pending.values())
            newest = self._snapshot.version if self._snapshot else -1
            now = time.time()
            ages = [(max(0, newest - v), now - at) for v, at in self._acting.values() if v >= 0]
            return HubStatus(
                env_steps=limiter.env_steps - under_way,
                admitted_steps=limiter.env_steps,
                updates=limiter.updates,
                updates_owed=limiter.updates_owed(),
                ratio=limiter.ratio,
                waiting_workers=limiter.waiting_inserts,
                waiting_learner=limiter.waiting_updates > 0,
                waited_workers_s=limiter.waited_insert_s,
                num_blocks=self._num_blocks,
                num_refunded_steps=self._num_refunded_steps,
                weights_version=newest,
                num_published=self._num_published,
                weights_age_updates=sum(u for u, _ in ages) / len(ages) if ages else 0.0,
                weights_age_s=sum(s for _, s in ages) / len(ages) if ages else 0.0,
                steps_by_worker=dict(self._steps_by_worker),
                wanted_workers=self._wanted_workers,
                auto_workers=self._auto_workers,
                alive_workers=self._alive_workers,
                finished=limiter.env_steps - under_way >= self._total_steps,
            )

    def close(self) -> None:
        """Send everyone who waits home."""
        self._limiter.close()
