"""Keeps the roles of a run alive. All loops of a run on a cluster, and who waits for whom:

    WORKER x N (process each)                       HUB (process)                LEARNER (process)
    loop: step env, act  ---block--> sender         counts steps, updates        updater: update, update, ...
          ^ one block ready, one under way |        keeps newest weights           |  ^ chunk of batches
          |                                |--may I insert?--> limiter <--may I update?-- fetcher
    follower: <-- newer weights, by a long poll -- newest weights  <----weights----'  | draws
                                           |                                           v
                                           '--------------block--------------> SHARD x M (process each)
    DRIVER (this process)
    pipeline: reports once a second, checkpoints, evaluates (PLAYERS, processes of their own)
    caretaker thread: `Supervisor.tick` and `ShardWatch.tick` four times a second
    INFERENCE (process, where it is central): sees for all workers, answers with tokens and actions; follows weights

    loop       consumes         produces          waits for                       stops
    worker     actions          blocks            room in its sender              between two steps
    follower   weights          an acting policy  a newer version                 within a second
    batcher    observations     tokens, actions   a request; on a CPU others too  with its process
    sender     blocks           stored blocks     the limiter; a shard's answer   after its block
    2 fetchers grants, replay   chunks            the limiter; replay's size      within half a second
    updater    chunks           updates, weights  a chunk                         after its update
    caretaker  beats            restarts          nothing                         within a quarter second

Every wait has a timeout, is repeated in slices, and its reason is part of the role's beat. A worker that made no
progress within the limit that its own beat names, or whose process is gone, is killed and replaced: next incarnation,
new seeds. What it had been granted and not stored is taken back from the count of steps.
"""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from slotfilm_dist.backend import RunFailedError
from slotfilm_dist.cluster.failures import RoleLostError
from slotfilm_dist.cluster.memory_guard import MemoryGuard
from slotfilm_dist.cluster.messages import WorkerBeat
from slotfilm_dist.machine import used_memory_share

MAX_FAILURES = 5
"""Failures of one worker in a row, without a block in between, before the run is given up."""
FAILURE_WINDOW_S = 600.0
"""Failures longer ago do not count."""
START_LIMIT_S = 120.0
"""Longest time until a new process answers; building its simulator has a limit of its own."""
STOP_S = 5.0
"""Time that a worker gets to finish its step and its block under way before it is killed."""

_logger = logging.getLogger(__name__)


@runtime_checkable
class WorkerHandle(Protocol):
    """A worker's process as the supervisor needs it."""

    worker_id: int

    @property
    def silent_s(self) -> float:
        """Time since it last answered."""
        ...

    def poll(self) -> WorkerBeat | None:
        """Its last beat; never waits; raises `RoleLostError` if the process is gone."""
        ...

    def begin_stop(self, timeout_s: float) -> object:
        """Ask it to stop."""
        ...

    def stopped(self, request: object, timeout_s: float) -> bool:
        """Whether it has stopped in time."""
        ...

    def kill(self) -> None:
        """End the process at once."""
        ...


@dataclass(kw_only=True, slots=True)
class _Member:
    """A worker that should be running."""

    handle: WorkerHandle
    incarnation: int
    employed_at: float
    failures: list[float] = field(default_factory=list)
    beat: WorkerBeat | None = None
    concluded: bool = False
    """What it was granted has been settled after it had come to its end."""


class Supervisor:
    """Starts, watches, replaces and stops workers. Owns no data; waits for nothing but the end of workers it stops.

    Args:
        launch: starts the process of a worker.
        employ: sets a worker to work with an incarnation.
        settle: takes back what a worker that is gone (id, incarnation) was granted and did not store; gives the steps.
        first_incarnation: of this start of the run; higher than any before.
        max_memory_share: of a machine's memory in use, from which its workers are stopped.
        clock: seconds that only grow.
        memory_share: of this machine in use, for a worker that has never said how full its own is.
    """

    def __init__(
        self,
        launch: Callable[[int], WorkerHandle],
        employ: Callable[[WorkerHandle, int], None],
        settle: Callable[[int, int], int],
        first_incarnation: int = 0,
        max_memory_share: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
        memory_share: Callable[[], float] = used_memory_share,
    ) -> None:
        self._guard, self._memory_share = MemoryGuard(max_memory_share, clock), memory_share
        self._launch, self._employ, self._settle, self._clock = launch, employ, settle, clock
        self._next_incarnation = first_incarnation
        self._members: dict[int, _Member] = {}
        self._lock = threading.RLock()
        self._stopped = False
        self.restarts: Counter[str] = Counter()
        self._rejected_before = self._cut_before = 0
        self._failures_of_held: dict[int, list[float]] = {}
        self.num_held = 0
        """Workers that should run and stand still."""
        self.num_surplus = 0
        """Those of them with higher numbers than all that run: what one could do without."""

    @property
    def num_alive(self) -> int:
        """Workers whose loop runs."""
        with self._lock:
            members = self._members.values()
            return sum(m.beat is not None and m.beat.running and m.beat.incarnation == m.incarnation for m in members)

    @property
    def num_rejected(self) -> int:
        """Steps that workers have left out, over all incarnations."""
        return self._rejected_before + sum(beat.num_rejected for beat in self.beats())

    @property
    def num_cut_episodes(self) -> int:
        """Episodes cut short by such a step, over all incarnations."""
        return self._cut_before + sum(beat.num_cut_episodes for beat in self.beats())

    @property
    def handles(self) -> list[WorkerHandle]:
        """The workers that should be running."""
        with self._lock:
            return [member.handle for member in self._members.values()]

    def beats(self) -> list[WorkerBeat]:
        """The last beat of every worker that has given one."""
        with self._lock:
            return [member.beat for member in self._members.values() if member.beat is not None]

    def scale(self, num_workers: int) -> None:
        """Start or stop workers until so many should run; none any more after `stop`.

        One whose machine is short of memory stands still for a while, unless it is the only one.
        """
        with self._lock:
            if self._stopped:
                return
            shares = self._memory_shares()
            for worker_id in range(num_workers):
                if worker_id not in self._members and self._guard.may_run(worker_id, shares):
                    self._start(worker_id, self._failures_of_held.pop(worker_id, []))
            self._dismiss([worker_id for worker_id in self._members if worker_id >= num_workers])
            if num_workers and not self._members:
                self._start(0, self._failures_of_held.pop(0, []))
            self.num_held = num_workers - len(self._members)
            self.num_surplus = num_workers - 1 - max(self._members, default=num_workers - 1)

    def employ_again(self) -> None:
        """Stop all loops and set the workers to work anew, as `employ` now means it; their environments stay."""
        with self._lock:
            members = list(self._members.values())
            requests = [member.handle.begin_stop(STOP_S) for member in members]
            for member, request in zip(members, requests, strict=True):
                if member.handle.stopped(request, STOP_S):
                    self._settle(member.handle.worker_id, member.incarnation)
                    self._set_to_work(member)
                else:
                    self._replace(member, "hang", "its loop did not end")

    def tick(self) -> None:
        """Look at every worker once; replace those that are lost, hung or failed, settle those that are done, stop
        one whose machine is short of memory.

        Raises:
            RunFailedError: a worker failed too often.
        """
        with self._lock:
            for member in list(self._members.values()):
                fault = self._fault(member)
                if fault is not None:
                    self._replace(member, *fault)
                elif member.beat is not None and member.beat.ended and not member.concluded:
                    self._conclude(member)
            self._save_memory()

    def stop(self) -> None:
        """Stop all workers for good; those that do not end in time are killed."""
        with self._lock:
            self._stopped = True
            self._dismiss(list(self._members))

    def _fault(self, member: _Member) -> tuple[str, str] | None:
        """Reason and cause, if something is wrong."""
        handle = member.handle
        try:
            beat = handle.poll()
        except RoleLostError as error:
            return error.reason, error.cause
        if beat is None or beat.incarnation != member.incarnation:
            late = self._clock() - member.employed_at > START_LIMIT_S
            return ("hang", f"no answer within {START_LIMIT_S:g} s of its start") if late else None
        member.beat = beat
        if beat.num_blocks:
            member.failures.clear()
        if beat.error:
            return beat.error_reason or "crash", beat.error
        if handle.silent_s > beat.limit_s:
            return "hang", f"no answer for {handle.silent_s:.0f} s while {beat.activity}"
        if beat.running and beat.idle_s > beat.limit_s:
            return "hang", f"no progress for {beat.idle_s:.0f} s while {beat.activity}"
        return None

    def _replace(self, member: _Member, reason: str, cause: str) -> None:
        worker_id, now = member.handle.worker_id, self._clock()
        share = member.beat.memory_share if member.beat is not None else self._memory_share()
        # A process that is gone without a word was ended by the system, most likely, where memory is short.
        silent = member.beat is None or not member.beat.error
        by_system = silent and reason in ("crash", "memory") and self._guard.is_short(share)
        member.handle.kill()
        self._settle(worker_id, member.incarnation)
        self._retire(member)
        failures = [at for at in member.failures if now - at <= FAILURE_WINDOW_S] + [now]
        if by_system and len(failures) < MAX_FAILURES:
            del self._members[worker_id]
            self._failures_of_held[worker_id] = failures
            self._hold(worker_id, share)
            return
        self.restarts[reason] += 1
        _logger.warning("worker %d is replaced (%s): %s", worker_id, reason, cause)
        if len(failures) >= MAX_FAILURES:
            raise RunFailedError(
                f"worker {worker_id} failed {len(failures)} times within {now - failures[0]:.0f} s without collecting "
                f"a block, last: {cause}; `slotfilm doctor` checks what a worker needs, then go on with --resume"
            )
        self._start(worker_id, failures)

    def _memory_shares(self) -> dict[int, float]:
        """How full each worker's machine is, by worker."""
        return {beat.worker_id: beat.memory_share for beat in self.beats()}

    def _save_memory(self) -> None:
        shares = self._memory_shares()
        worker_id = self._guard.pick(shares)
        if worker_id is not None:
            self._hold(worker_id, shares[worker_id])
            self._dismiss([worker_id])
            self._guard.look_again()

    def _hold(self, worker_id: int, memory_share: float) -> None:
        self.restarts["memory"] += 1
        _logger.warning(
            "worker %d stands still for %g s: %.0f %% of its machine's memory are in use (runtime.max_memory_share)",
            *(worker_id, self._guard.hold(worker_id), 100 * memory_share),
        )

    def _conclude(self, member: _Member) -> None:
        """A worker saw the run's last steps granted and ended; blocks that it could not store are still to come."""
        member.concluded = True
        if self._settle(member.handle.worker_id, member.incarnation):
            self._set_to_work(member)

    def _start(self, worker_id: int, failures: Sequence[float]) -> None:
        handle = self._launch(worker_id)
        member = _Member(handle=handle, incarnation=0, employed_at=0.0, failures=list(failures))
        self._members[worker_id] = member
        self._set_to_work(member)

    def _set_to_work(self, member: _Member) -> None:
        self._retire(member)
        member.incarnation, member.employed_at, member.beat = self._next_incarnation, self._clock(), None
        member.concluded = False
        self._next_incarnation += 1
        self._employ(member.handle, member.incarnation)

    def _dismiss(self, worker_ids: Sequence[int]) -> None:
        leaving = [self._members.pop(worker_id) for worker_id in worker_ids]
        requests = [member.handle.begin_stop(STOP_S) for member in leaving]
        for member, request in zip(leaving, requests, strict=True):
            member.handle.stopped(request, STOP_S)
            member.handle.kill()
            lost = self._settle(member.handle.worker_id, member.incarnation)
            self._retire(member)
            done = [other for other in self._members.values() if other.concluded]
            if lost and done and not self._stopped:  # nobody else would collect these steps
                self._set_to_work(done[0])

    def _retire(self, member: _Member) -> None:
        """Add what an incarnation counted to what those before it had."""
        if member.beat is not None:
            self._rejected_before += member.beat.num_rejected
            self._cut_before += member.beat.num_cut_episodes
            member.beat = None
