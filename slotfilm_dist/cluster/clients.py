"""Typed clients of the actors: the only place that calls `.remote`. Callers see plain values, never references."""

import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import ray
import ray.exceptions

from slotfilm_dist.backend import Player
from slotfilm_dist.cluster.actors import CONCURRENCY, HubActor, LearnerActor, PlayerActor, ShardActor, WorkerActor
from slotfilm_dist.cluster.failures import RoleLostError, RoleSilentError
from slotfilm_dist.cluster.messages import (
    AgentSetup,
    BlockKey,
    BlockNotice,
    HubStatus,
    LearnerStatus,
    ShardBeat,
    StepGrant,
    UpdateGrant,
    WorkerBeat,
)
from slotfilm_dist.config import RunConfig
from slotfilm_dist.messages import EpisodeSummary, SampleBatch, TransitionBlock, WeightSnapshot
from slotfilm_dist.replay.ledger import shard_of
from slotfilm_dist.replay.schema import ReplaySchema
from slotfilm_dist.replay.sharded import join_batches, split_draws

ANSWER_S = 20.0
"""Longest wait for an answer that takes no time to give."""
DRAW_S = 2.0
"""Longest wait for a shard's batches before the other shards are asked instead."""
INSERT_S = 5.0
"""Longest wait for a shard to store a block before it is sent again."""
REFRESH_S = 0.5
"""Pause between questions to a shard that did not answer."""
SHARD_RESTARTS = 100
"""How often a shard's process is replaced in one run."""
INSERTS_AHEAD = 8
"""Blocks under way while replay is filled."""

T = TypeVar("T")


def _launch(cls: type, *arguments: Any, **options: Any) -> Any:
    keywords = options.pop("keywords", {})
    return ray.remote(concurrency_groups=CONCURRENCY[cls], **options)(cls).remote(*arguments, **keywords)


def _answer(reference: Any, name: str, waiting_for: str, timeout_s: float) -> Any:
    """The value behind a reference.

    Raises:
        RoleLostError: the process is gone.
        RoleSilentError: no answer in time.
        Exception: what the role itself raised.
    """
    try:
        return ray.get(reference, timeout=timeout_s)
    except ray.exceptions.GetTimeoutError:
        raise RoleSilentError(name, waiting_for, timeout_s) from None
    except ray.exceptions.RayTaskError as error:
        cause = error.cause if isinstance(error.cause, Exception) else error
        raise cause from None
    except ray.exceptions.RayError as error:
        raise RoleLostError(name, _reason(str(error)), _one_line(str(error))) from None


def _reason(text: str) -> str:
    lower = text.lower()
    if "memory" in lower and ("oom" in lower or "out of memory" in lower or "low memory" in lower):
        return "memory"
    if "preempt" in lower:
        return "preempted"
    return "node_lost" if "node died" in lower or "node was terminated" in lower else "crash"


def _one_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    named = [line for line in lines if line.lower().startswith(("the actor", "worker exit", "the worker"))]
    return (named or lines or ["no reason given"])[0]


class HubClient:
    """The hub as other roles see it."""

    def __init__(self, actor: Any) -> None:
        self._actor = actor

    @classmethod
    def launch(cls, config: RunConfig, namespace: str) -> "HubClient":
        """Start the hub under its name, so that `slotfilm scale` finds it."""
        return cls(_launch(HubActor, config, num_cpus=0, name="hub", namespace=namespace))

    @classmethod
    def find(cls, namespace: str) -> "HubClient":
        """The hub of a live run; raises ``ValueError`` if there is none."""
        try:
            return cls(ray.get_actor("hub", namespace=namespace))
        except ValueError:
            raise ValueError(f"no live run is named {namespace!r} on this cluster; is it still running?") from None

    def admit_steps(
        self, notice: BlockNotice, stored: Iterable[BlockKey], held_version: int, timeout_s: float
    ) -> StepGrant:
        """Wait until a block's steps fit."""
        reference = self._actor.admit_steps.remote(notice, list(stored), held_version, timeout_s)
        return _answer(reference, "hub", "admission of a block", timeout_s + ANSWER_S)

    def admit_updates(self, max_updates: int, timeout_s: float) -> UpdateGrant:
        """Wait until updates are due."""
        reference = self._actor.admit_updates.remote(max_updates, timeout_s)
        return _answer(reference, "hub", "admission of updates", timeout_s + ANSWER_S)

    def publish(self, snapshot: WeightSnapshot) -> None:
        """Send the newest weights; does not wait."""
        self._actor.call.remote("publish", snapshot)

    def confirm(self, stored: Iterable[BlockKey]) -> None:
        """Note that blocks are in replay."""
        self._call("confirm", list(stored))

    def pending(self, worker_id: int, incarnation: int) -> list[BlockKey]:
        """Blocks of a worker that were granted and not confirmed."""
        return self._call("pending", worker_id, incarnation)

    def settle(self, worker_id: int, incarnation: int, stored: Iterable[BlockKey]) -> int:
        """Confirm what a lost worker had stored, take back the rest."""
        return self._call("settle", worker_id, incarnation, list(stored))

    def refund_updates(self, num_updates: int) -> None:
        """Take back updates that did not happen."""
        self._call("refund_updates", num_updates)

    def count_random_steps(self, num_steps: int) -> None:
        """Note the random policy's steps and let learning begin after them."""
        self._call("count_random_steps", num_steps)

    def start_over(self, missing_steps: int) -> None:
        """After a loss of stored steps: no updates until so many new ones have come."""
        self._call("start_over", missing_steps)

    def load(self, limiter: dict[str, Any]) -> None:
        """Continue a run's counters."""
        self._call("load", limiter)

    def save(self, updates: int) -> dict[str, Any]:
        """The counters."""
        return self._call("save", updates)

    def latest(self, newer_than: int) -> WeightSnapshot | None:
        """The newest weights."""
        return self._call("latest", newer_than)

    def newest_version(self) -> int:
        """Version of the newest weights."""
        return self._call("newest_version")

    def set_up_agents(self, setup: AgentSetup) -> None:
        """Give what every policy needs besides the weights."""
        self._call("set_up_agents", setup)

    def agent_setup(self) -> AgentSetup:
        """What every policy needs besides the weights."""
        return self._call("agent_setup")

    def want_workers(self, num_workers: int) -> None:
        """Ask for another number of workers."""
        self._call("want_workers", num_workers)

    def note_alive(self, num_workers: int) -> None:
        """Say how many workers run."""
        self._call("note_alive", num_workers)

    def take_episodes(self) -> list[tuple[EpisodeSummary, int]]:
        """Episodes that ended since the last call."""
        return self._call("take_episodes")

    def status(self) -> HubStatus:
        """The counters."""
        return self._call("status")

    def close(self) -> None:
        """Send everyone who waits home."""
        self._call("close")

    def kill(self) -> None:
        """End the process."""
        ray.kill(self._actor)

    def _call(self, method: str, *arguments: Any) -> Any:
        return _answer(self._actor.call.remote(method, *arguments), "hub", method.replace("_", " "), ANSWER_S)


class ShardClient:
    """One shard as other roles see it."""

    def __init__(self, actor: Any, index: int) -> None:
        self._actor, self.index = actor, index
        self.name = f"shard {index}"
        self._question: Any = None
        self._asked_at = 0.0
        self._last: ShardBeat | None = None

    @classmethod
    def launch(
        cls, config: RunConfig, schema: ReplaySchema, index: int, folder: Path, *, resume: bool
    ) -> "ShardClient":
        """Start a shard; Ray replaces its process when it dies."""
        actor = _launch(
            *(ShardActor, config, schema, index, folder),
            keywords={"resume": resume},
            num_cpus=0,
            max_restarts=SHARD_RESTARTS,
            max_task_retries=0,
        )
        return cls(actor, index)

    def insert(self, block: TransitionBlock) -> bool:
        """Store a block; False if it had been stored before."""
        return self.await_insert(self.begin_insert(block))

    def begin_insert(self, block: TransitionBlock) -> Any:
        """Send a block; `await_insert` takes the result."""
        return self._actor.insert.remote(block)

    def await_insert(self, request: Any) -> bool:
        """The result of `begin_insert`."""
        return _answer(request, self.name, "a block to be stored", INSERT_S)

    def begin_draw(self, sizes: Sequence[int]) -> Any:
        """Ask for batches; `await_draw` takes them."""
        return self._actor.draw.remote(list(sizes))

    def await_draw(self, request: Any) -> tuple[list[SampleBatch], int]:
        """The result of `begin_draw`: batches, and steps stored."""
        return _answer(request, self.name, "batches", DRAW_S)

    def begin_count(self) -> Any:
        """Ask for the number of stored steps."""
        return self._actor.call.remote("num_steps")

    def count(self, request: Any) -> int | None:
        """The result of `begin_count`, or None while there is none; raises `RoleLostError` if it will not come."""
        ready, _ = ray.wait([request], timeout=0)
        return _answer(request, self.name, "its size", DRAW_S) if ready else None

    def num_steps(self, timeout_s: float = ANSWER_S) -> int:
        """Steps stored now."""
        return _answer(self.begin_count(), self.name, "its size", timeout_s)

    def fence(self, worker_id: int, incarnation: int, asked: Iterable[BlockKey]) -> list[BlockKey]:
        """Refuse what comes late from a lost worker."""
        request = self._actor.call.remote("fence", worker_id, incarnation, list(asked))
        return _answer(request, self.name, "to fence a lost worker off", INSERT_S)

    def beat(self, timeout_s: float = ANSWER_S) -> ShardBeat:
        """How it does; waits until its process has started."""
        return _answer(self._actor.call.remote("beat"), self.name, "how it does", timeout_s)

    def poll(self) -> ShardBeat | None:
        """The last beat, None while it does not answer; never waits."""
        if self._question is None:
            self._question, self._asked_at = self._actor.call.remote("beat"), time.monotonic()
        if ray.wait([self._question], timeout=0)[0]:
            question, self._question = self._question, None
            try:
                self._last = _answer(question, self.name, "how it does", ANSWER_S)
            except RoleLostError:
                self._last = None
        elif time.monotonic() - self._asked_at > DRAW_S:
            self._last = None
        return self._last

    def process_id(self) -> int:
        """Of its process now."""
        return _answer(self._actor.call.remote("process_id"), self.name, "its process id", ANSWER_S)

    def begin_snapshot(self) -> Any:
        """Start writing a snapshot; `await_snapshot` waits for it."""
        return self._actor.snapshot.remote()

    def await_snapshot(self, request: Any, timeout_s: float) -> int:
        """The steps in the snapshot."""
        return _answer(request, self.name, "its snapshot to be written", timeout_s)

    def kill(self) -> None:
        """End the process for good."""
        ray.kill(self._actor)


class ReplayClient:
    """All shards as one `ReplayStore`. For one thread at a time; every role has its own.

    A shard that is lost or silent counts as empty until it answers again, so the others are drawn from in proportion to
    what they hold.

    Args:
        shards: in their order.
        seed: of the stream that splits draws among them.
    """

    def __init__(self, shards: Sequence[ShardClient], seed: np.random.SeedSequence) -> None:
        self._shards = list(shards)
        self._rng = np.random.default_rng(seed)
        self._sizes = [0] * len(shards)
        self._counts: dict[int, Any] = {}
        self._asked_at = [0.0] * len(shards)

    def insert(self, block: TransitionBlock) -> bool:
        """Store a block in its shard; False if it had been stored before."""
        return self._shard_of(block).insert(block)

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
            ValueError: nothing is stored in the shards that answer.
        """
        while True:
            self._refresh(wait=sum(self._sizes) == 0)
            sizes = split_draws(self._rng, self._sizes, num_batches, batch_size)
            asked = [
                (shard, shard.begin_draw(wanted.tolist()))
                for shard, wanted in zip(self._shards, sizes.T, strict=True)
                if wanted.any()
            ]
            parts = [batches for shard, request in asked if (batches := self._drawn(shard, request)) is not None]
            if len(parts) == len(asked):
                return [join_batches(of_shards) for of_shards in zip(*parts, strict=True)]

    def num_steps(self) -> int:
        """Steps stored in the shards that answer."""
        self._refresh(wait=sum(self._sizes) == 0)
        return sum(self._sizes)

    def _drawn(self, shard: ShardClient, request: Any) -> list[SampleBatch] | None:
        try:
            batches, self._sizes[shard.index] = shard.await_draw(request)
        except (RoleLostError, RoleSilentError, ValueError):
            self._sizes[shard.index] = 0
            return None
        return batches

    def _refresh(self, *, wait: bool) -> None:
        """Ask shards that count as empty how much they hold."""
        deadline = time.monotonic() + (DRAW_S if wait else 0.0)
        self._ask_empty()
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

    def _ask_empty(self) -> None:
        now = time.monotonic()
        for shard in self._shards:
            i = shard.index
            if self._sizes[i] == 0 and i not in self._counts and now - self._asked_at[i] >= REFRESH_S:
                self._asked_at[i] = now
                self._counts[i] = shard.begin_count()

    def _shard_of(self, block: TransitionBlock) -> ShardClient:
        return self._shards[shard_of(block.worker_id, block.sequence, len(self._shards))]


class WorkerClient:
    """One worker as the supervisor sees it."""

    def __init__(self, actor: Any, worker_id: int) -> None:
        self._actor, self.worker_id = actor, worker_id
        self.name = f"worker {worker_id}"
        self._question: Any = None
        self._last: WorkerBeat | None = None
        self._heard_at = time.monotonic()

    @classmethod
    def launch(
        cls, config: RunConfig, worker_id: int, make_env: Callable[..., Any], limits: Any, num_cpus: float
    ) -> "WorkerClient":
        """Start a worker's process; it does nothing yet."""
        actor = _launch(WorkerActor, config, worker_id, make_env, limits, num_cpus=num_cpus, max_restarts=0)
        return cls(actor, worker_id)

    def train(self, incarnation: int, hub: HubClient, store: ReplayClient, setup: AgentSetup) -> None:
        """Start collecting for replay; does not wait."""
        self._last = None
        self._actor.train.remote(incarnation, hub, store, setup)

    def collect_randomly(self, incarnation: int) -> None:
        """Start collecting with the random policy; does not wait."""
        self._last = None
        self._actor.collect_randomly.remote(incarnation)

    def describe(self, timeout_s: float) -> tuple[int, tuple[str, ...]] | None:
        """Size of an action and the reward's terms, or None while the environment is being built."""
        return _answer(
            self._actor.describe.remote(timeout_s), self.name, "its environment to be built", timeout_s + ANSWER_S
        )

    def begin_take(self, timeout_s: float) -> Any:
        """Ask for the random policy's blocks; `taken` gives them."""
        return self._actor.take_random_blocks.remote(timeout_s)

    def taken(self, request: Any, timeout_s: float) -> list[TransitionBlock] | None:
        """The result of `begin_take`, or None while there is none; raises `RoleLostError` if it will not come."""
        ready, _ = ray.wait([request], timeout=timeout_s)
        return _answer(request, self.name, "the random policy's blocks", ANSWER_S) if ready else None

    def poll(self) -> WorkerBeat | None:
        """The last beat, None before the first; never waits.

        Raises:
            RoleLostError: the process is gone.
        """
        if self._question is None:
            self._question = self._actor.beat.remote()
        ready, _ = ray.wait([self._question], timeout=0)
        if ready:
            question, self._question = self._question, None
            self._last = _answer(question, self.name, "how it does", ANSWER_S)
            self._heard_at = time.monotonic()
        return self._last

    @property
    def silent_s(self) -> float:
        """Time since it last answered."""
        return time.monotonic() - self._heard_at

    def begin_stop(self, timeout_s: float) -> Any:
        """Ask it to stop its loop; `stopped` waits for it."""
        return self._actor.stop.remote(timeout_s)

    def stopped(self, request: Any, timeout_s: float) -> bool:
        """Whether the loop has ended in time."""
        try:
            return _answer(request, self.name, "its loop to end", timeout_s)
        except (RoleLostError, RoleSilentError):
            return False

    def process_id(self) -> int:
        """Of its process."""
        return _answer(self._actor.process_id.remote(), self.name, "its process id", ANSWER_S)

    def kill(self) -> None:
        """End the process at once; native code cannot be interrupted otherwise."""
        ray.kill(self._actor)


class LearnerClient:
    """The learner as the driver sees it."""

    def __init__(self, actor: Any) -> None:
        self._actor = actor

    @classmethod
    def launch(
        cls, config: RunConfig, action_dim: int, num_threads: int, hub: HubClient, *, num_cpus: float, gpu: bool
    ) -> "LearnerClient":
        """Start the learner's process."""
        actor = _launch(
            *(LearnerActor, config, action_dim, num_threads),
            keywords={"gpu": gpu, "hub": hub},
            num_cpus=num_cpus,
            num_gpus=1 if gpu else 0,
            max_restarts=0,
        )
        return cls(actor)

    def call(self, method: str, *arguments: Any, timeout_s: float, **options: Any) -> Any:
        """A method of `LearnerRole` that takes its time; the same errors, plus those of a lost process."""
        request = self._actor.call.remote(method, *arguments, **options)
        return _answer(request, "learner", method.replace("_", " "), timeout_s)

    def status(self, timeout_s: float = ANSWER_S) -> LearnerStatus:
        """How it does."""
        return _answer(self._actor.status.remote(), "learner", "how it does", timeout_s)

    def process_id(self) -> int:
        """Of its process."""
        return _answer(self._actor.process_id.remote(), "learner", "its process id", ANSWER_S)

    def kill(self) -> None:
        """End the process at once."""
        ray.kill(self._actor)


class PlayerClient:
    """One evaluation process as the driver sees it."""

    def __init__(self, actor: Any, index: int) -> None:
        self._actor = actor
        self.name = f"player {index}"

    @classmethod
    def launch(cls, config: RunConfig, index: int, make_env: Callable[..., Any], num_cpus: float) -> "PlayerClient":
        """Start a player's process."""
        return cls(_launch(PlayerActor, config, make_env, num_cpus=num_cpus, max_restarts=0), index)

    def begin_prepare(
        self, player: Player, camera: bool, setup: AgentSetup | None, snapshot: WeightSnapshot | None
    ) -> Any:
        """Build environment and policy; `answer` waits for it."""
        return self._actor.prepare.remote(player, camera, setup, snapshot)

    def begin_play(self, seed: int) -> Any:
        """Play an episode; `answer` gives its summary."""
        return self._actor.play.remote(seed)

    def begin_record(self, seed: int, video: Path, film_strip: Path) -> Any:
        """Play an episode and write its video; `answer` gives its summary."""
        return self._actor.record.remote(seed, video, film_strip)

    def is_ready(self, request: Any) -> bool:
        """Whether `answer` would not wait."""
        return bool(ray.wait([request], timeout=0)[0])

    def answer(self, request: Any, waiting_for: str, timeout_s: float) -> Any:
        """The result of a request."""
        return _answer(request, self.name, waiting_for, timeout_s)

    def kill(self) -> None:
        """End the process."""
        ray.kill(self._actor)
