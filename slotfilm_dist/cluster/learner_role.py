"""The learner on a cluster: asks for updates, fetches batches ahead, updates, publishes weights. Plain, without Ray."""

import dataclasses
import queue
import threading
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch

from slotfilm_dist.cluster.failures import RoleLostError, RoleSilentError
from slotfilm_dist.cluster.hub import chunk_updates
from slotfilm_dist.cluster.messages import AgentSetup, LearnerStatus, UpdateGrant
from slotfilm_dist.config import RunConfig
from slotfilm_dist.learning.checkpoint import CheckpointStore, read_checkpoint, write_checkpoint
from slotfilm_dist.learning.learner import Learner, dataset_hash, learning_hash
from slotfilm_dist.messages import SampleBatch, TransitionBlock, WeightSnapshot
from slotfilm_dist.replay.dataset import open_dataset
from slotfilm_dist.replay.schema import ReplaySchema

ADMIT_S = 0.5
"""Longest wait of one request for updates; what is due by then is granted."""
RETRY_S = 0.25
"""Pause before replay is asked again."""
REQUEST_BYTES = 32 << 20
"""Batches of one request together stay below this, unless a single one is larger."""
UNFINISHED = ".unfinished"


@runtime_checkable
class UpdateLink(Protocol):
    """What the learner asks of the hub."""

    def admit_updates(self, max_updates: int, timeout_s: float) -> UpdateGrant:
        """Wait until updates are due."""
        ...

    def refund_updates(self, num_updates: int) -> None:
        """Take back updates that did not happen."""
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


class LearnerRole:
    """Holds the learner; `start` runs two threads until `stop`.

    *Fetcher*: consumes grants of updates and replay; produces chunks of batches, one ready while the next is fetched.
    Waits for the limiter, for replay to hold `replay.min_steps`, for a shard's answer, and for room.

    *Updater*: consumes chunks; produces updates and, every `runtime.publish_every`, weights. Waits for a chunk.

    Both stop within a slice of their waits; updates that were granted and not made are given back.

    Args:
        config: the run.
        action_dim: size of an action.
        device: where it computes.
        hub: admits updates, takes weights.
    """

    def __init__(self, config: RunConfig, action_dim: int, device: torch.device, hub: UpdateLink) -> None:
        self._config, self._action_dim, self._device = config, action_dim, device
        self._hub = hub
        self._store: SampleLink | None = None
        self._learner: Learner | None = None
        self._state = threading.Lock()
        self._stopping = threading.Event()
        self._ready: queue.Queue[list[SampleBatch]] = queue.Queue(1)
        self._threads: list[threading.Thread] = []
        self._waiting_for = self._error = ""
        self._waited_s = self._batch_wait_s = self._update_s = 0.0
        self._version_offset = 0
        self._granted = self._made = 0

    def fetch_weights(self) -> None:
        """Find out whether the backbone's initial weights can be had; raises ``ValueError`` if not."""
        Learner(self._config, self._action_dim, torch.device("cpu"))

    def load_agent(self, checkpoints: Path) -> int:
        """Build the agent of a run's newest checkpoint and publish it; gives the steps it learned from.

        Raises:
            ValueError: there is no checkpoint that can be used.
        """
        found = CheckpointStore(checkpoints, self._config.checkpoint.keep).read_last(learning_hash(self._config))
        if found is None:
            raise ValueError(f"{checkpoints} holds no checkpoint; the run has not trained yet")
        learner = self._learner = Learner(self._config, self._action_dim, self._device, fetch_weights=False)
        learner.load_checkpoint(found[0])
        self._introduce()
        return int(found[0].values["limiter"]["env_steps"])

    def begin_pretraining(self, dataset: Path, artifact: Path) -> None:
        """Get ready to pre-train on a dataset, or to go on where an interrupted pre-training stopped."""
        learner = self._learner = Learner(self._config, self._action_dim, self._device)
        learner.begin_pretraining(open_dataset(dataset, dataset_hash(self._config), verify=False))
        unfinished = artifact.with_name(artifact.name + UNFINISHED)
        if unfinished.exists():
            learner.load_pretrain_state(read_checkpoint(unfinished, learner.pretrain_state().config_hash))

    def pretrain(self, num_steps: int) -> tuple[dict[str, float], int]:
        """Take gradient steps; gives metrics and the steps done in all."""
        learner = self.learner
        return (learner.pretrain(num_steps) if learner.pretrain_steps < self._config.pretrain.steps else {}), (
            learner.pretrain_steps
        )

    def save_pretraining(self, artifact: Path, *, finished: bool) -> None:
        """Write the pre-training's result, or what there is of it beside the place of the result."""
        path = artifact if finished else artifact.with_name(artifact.name + UNFINISHED)
        write_checkpoint(path, self.learner.pretrain_state())

    def begin(
        self, dataset: Path, pretrained: Path | None, resume_from: Path | None
    ) -> tuple[dict[str, Any], ReplaySchema, int]:
        """Build the agent and publish its first weights.

        Args:
            dataset: the random policy's data.
            pretrained: checkpoint of the pre-trained encoder, if there is one.
            resume_from: folder of the run's checkpoints; None for a fresh start.

        Returns:
            The plain values of the checkpoint that it continues, empty for a fresh start; how replay stores this
            agent's transitions; the random policy's steps.

        Raises:
            ValueError: a file does not fit or is damaged.
        """
        config = self._config
        store = CheckpointStore(resume_from, config.checkpoint.keep) if resume_from else None
        found = store.read_last(learning_hash(config)) if store else None
        fetch = not (pretrained or found)
        learner = self._learner = Learner(config, self._action_dim, self._device, fetch_weights=fetch)
        data = open_dataset(dataset, dataset_hash(config), verify=False)
        if pretrained is not None:
            learner.load_pretrained(read_checkpoint(pretrained))
        learner.begin_rl(data)
        if found is not None:
            learner.load_checkpoint(found[0])
        self._introduce()
        return (dict(found[0].values) if found is not None else {}), learner.schema(), data.num_steps

    def _introduce(self) -> None:
        """Give policies the encoder and the first weights."""
        learner = self.learner
        arrays = {k: v.detach().cpu().numpy() for k, v in learner.encoder.state_dict().items()}
        self._hub.set_up_agents(AgentSetup(action_dim=self._action_dim, encoder=arrays))
        # A learner that goes back to a checkpoint must not publish a version that its workers have already seen.
        self._version_offset = max(0, self._hub.newest_version() + 1 - learner.updates)
        self._hub.publish(self._snapshot())

    def connect(self, store: SampleLink) -> None:
        """Take replay, which is built to this agent's schema."""
        self._store = store

    def refill(self, dataset: Path) -> int:
        """Store the random policy's data in replay; gives the steps."""
        data = open_dataset(dataset, dataset_hash(self._config), verify=False)
        return self._replay.insert_all(self.learner.stored_blocks(data))

    def start(self) -> None:
        """Start fetching and updating."""
        self._stopping = threading.Event()
        self._ready = queue.Queue(1)
        self._error = ""
        self._threads = [
            threading.Thread(target=self._guard, args=(loop,), name=loop.__name__.strip("_"), daemon=True)
            for loop in (self._fetch_loop, self._update_loop)
        ]
        for thread in self._threads:
            thread.start()

    def stop(self, timeout_s: float) -> int:
        """Stop after the running update and give back what was granted; gives the updates made.

        Raises:
            RoleSilentError: a thread still runs when time is up.
        """
        self._stopping.set()
        deadline = time.monotonic() + timeout_s
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))
            if thread.is_alive():
                raise RoleSilentError("learner", f"its thread {thread.name} to end", timeout_s)
        if self._threads:
            self._hub.refund_updates(self._granted - self._made)
            self._granted = self._made
            self._hub.publish(self._snapshot())
        self._threads = []
        return self.learner.updates

    def status(self) -> LearnerStatus:
        """How it does."""
        learner = self._learner
        with self._state:
            updates = learner.updates if learner else 0
            metrics = learner.metrics() if learner and self._made else {}
        metrics["learner_wait_s_total"] = self._waited_s
        if self._update_s:
            metrics |= {"learner_update_s": self._update_s, "learner_batch_wait_s": self._batch_wait_s}
        return LearnerStatus(updates=updates, metrics=metrics, waiting_for=self._waiting_for, error=self._error)

    def save(self, folder: Path, values: Mapping[str, Any], *, best: bool) -> tuple[int, int]:
        """Write a checkpoint between two updates; gives its size in bytes and the updates behind it."""
        with self._state:
            checkpoint, updates = self.learner.checkpoint(values), self.learner.updates
        if "limiter" in values:
            limiter = {**values["limiter"], "updates": updates}
            checkpoint = dataclasses.replace(checkpoint, values={**checkpoint.values, "limiter": limiter})
        store = CheckpointStore(folder, self._config.checkpoint.keep)
        return (store.write_best(checkpoint) if best else store.write(checkpoint, updates)), updates

    @property
    def learner(self) -> Learner:
        """Exists once pre-training or training has begun."""
        assert self._learner is not None, "begin comes first"
        return self._learner

    @property
    def _replay(self) -> SampleLink:
        assert self._store is not None, "connect comes first"
        return self._store

    def _snapshot(self) -> WeightSnapshot:
        snapshot = self.learner.snapshot()
        return dataclasses.replace(snapshot, version=snapshot.version + self._version_offset)

    def _guard(self, loop: Any) -> None:
        try:
            loop()
        except Exception as error:  # told to the driver, which ends or restarts the learner
            self._error = f"{type(error).__name__}: {error}".splitlines()[0]
            self._stopping.set()

    def _fetch_loop(self) -> None:
        chunk = chunk_updates(self._config.schedule.updates_per_step)
        schema, size = self.learner.schema(), self._config.sac.batch_size
        chunk = max(1, min(chunk, REQUEST_BYTES // (2 * schema.row_bytes * size)))
        while not self._stopping.is_set():
            grant = self._hub.admit_updates(chunk, ADMIT_S)
            self._waited_s += grant.waited_s
            self._waiting_for = grant.waiting_for and f"the limiter: {grant.waiting_for}"
            if grant.num_updates:
                self._granted += grant.num_updates
                self._pass_on(self._fetch(grant.num_updates, size))

    def _fetch(self, num_batches: int, batch_size: int) -> list[SampleBatch]:
        """Batches, once replay holds enough; none when the loop is told to stop."""
        began = time.monotonic()
        wanted = self._config.replay.min_steps
        while not self._stopping.is_set():
            try:
                stored = self._replay.num_steps()
                if stored >= wanted:
                    return self._replay.sample(num_batches, batch_size)
                self._waiting_for = f"replay to hold {wanted} steps; it holds {stored}"
            except (RoleLostError, RoleSilentError) as error:
                self._waiting_for = str(error)
            self._stopping.wait(RETRY_S)
            self._waited_s += time.monotonic() - began
            began = time.monotonic()
        return []

    def _pass_on(self, batches: list[SampleBatch]) -> None:
        while batches and not self._stopping.is_set():
            try:
                self._ready.put(batches, timeout=RETRY_S)
                return
            except queue.Full:
                continue

    def _update_loop(self) -> None:
        learner, every = self.learner, self._config.runtime.publish_every
        next_publish = learner.updates + every
        while not self._stopping.is_set():
            began = time.monotonic()
            try:
                batches = self._ready.get(timeout=RETRY_S)
            except queue.Empty:
                continue
            self._batch_wait_s = time.monotonic() - began
            for batch in batches:
                if self._stopping.is_set():
                    break
                self._update(batch)
                if learner.updates >= next_publish:
                    self._hub.publish(self._snapshot())
                    next_publish = learner.updates + every

    def _update(self, batch: SampleBatch) -> None:
        began = time.monotonic()
        with self._state:
            before = self.learner.updates
            self.learner.update(batch)
            made = self.learner.updates - before
        self._made += made
        if not made:  # skipped for a loss that was not finite: it is due again
            self._granted -= 1
            self._hub.refund_updates(1)
        self._update_s = time.monotonic() - began
