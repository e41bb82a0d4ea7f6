"""The workers of a run as the backend drives them: random policy first, training after, cared for all the time."""

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from slotfilm_dist.backend import RunFailedError
from slotfilm_dist.cluster.clients import is_ready
from slotfilm_dist.cluster.failures import RoleLostError, RoleSilentError
from slotfilm_dist.cluster.hub_client import HubClient
from slotfilm_dist.cluster.inference_client import InferenceClient
from slotfilm_dist.cluster.messages import AgentSetup, BlockKey, HubStatus
from slotfilm_dist.cluster.placement import WORKER_RESOURCE, nodes_for, share_for_more
from slotfilm_dist.cluster.replay_client import ReplayClient, ShardClient
from slotfilm_dist.cluster.role_clients import WorkerClient
from slotfilm_dist.cluster.scaling import Load, WorkerScaler
from slotfilm_dist.cluster.session import Session
from slotfilm_dist.cluster.shard_watch import ShardWatch
from slotfilm_dist.cluster.system import Supervisor
from slotfilm_dist.config import RunConfig
from slotfilm_dist.contracts import VectorEnv
from slotfilm_dist.messages import TransitionBlock
from slotfilm_dist.replay.ledger import shard_of
from slotfilm_dist.seeds import Role, role_seed

TICK_S = 0.25
"""Pause of the caretaker between two looks at all roles."""
TAKE_S = 1.0
"""Longest wait of one request for the random policy's blocks."""
INSERT_STREAMS = 1_000_000
"""Workers' replay clients draw from streams beyond those of the shards; they never sample, but have one."""


def make_wrist_env(config: RunConfig, camera: bool) -> VectorEnv:
    """The simulator."""
    from slotfilm_dist.envs.wrist_env import WristEnv

    return WristEnv(config, camera=camera)


class Workforce:
    """Workers, and the caretaker thread that keeps them and the shards alive from the start to `close`.

    Args:
        config: the run.
        session: the cluster.
        hub: counts their steps.
        make_env: builds an environment.
        limits: how long workers may go without progress.
        share_cpus: cores of each worker.
        first_incarnation: higher than any of earlier starts of the run.
        snapshot_s: seconds between snapshots of replay.
        labels: of the workers' metrics; empty for none.
    """

    def __init__(
        self,
        config: RunConfig,
        session: Session,
        hub: HubClient,
        make_env: Callable[..., Any],
        limits: Any,
        share_cpus: float,
        first_incarnation: int,
        snapshot_s: float,
        labels: Mapping[str, str],
    ) -> None:
        self._config, self._session, self._hub = config, session, hub
        self._make_env, self._limits, self._share_cpus = make_env, limits, share_cpus
        self._snapshot_s, self._labels = snapshot_s, labels
        self._shards: Sequence[ShardClient] = ()
        self._agent: AgentSetup | InferenceClient | None = None
        self._scaler = WorkerScaler(max_workers=config.runtime.max_workers, worker_cpus=share_cpus)
        self._launched: set[int] = set()
        self._already = 0
        self._failure: RunFailedError | None = None
        self._closing = threading.Event()
        self.watch: ShardWatch | None = None
        self.supervisor = Supervisor(
            *(self._launch, self._employ, self._settle, first_incarnation), config.runtime.max_memory_share
        )
        self.supervisor.scale(config.runtime.num_workers)
        self._caretaker = threading.Thread(target=self._take_care, name="caretaker", daemon=True)
        self._caretaker.start()

    @property
    def training(self) -> bool:
        """The workers collect for replay."""
        return self._agent is not None

    def check(self) -> None:
        """Raise `RunFailedError` if a role could not be kept alive."""
        if self._failure is not None:
            raise self._failure

    def describe(self) -> tuple[int, tuple[str, ...]]:
        """Size of an action and the reward's terms, from the first worker, once it has built its environment."""
        while True:
            self.check()
            for client in self._clients()[:1]:
                with contextlib.suppress(RoleLostError, RoleSilentError):  # the caretaker replaces it
                    described = client.describe(TAKE_S)
                    if described is not None:
                        return described
            time.sleep(TICK_S / 10)

    def random_blocks(self, num_steps: int, already: int) -> Iterator[TransitionBlock]:
        """The random policy's blocks, as they come from any worker, after `already` steps that are there."""
        if already != self._already:  # what the workers began with may be what is there
            self._already = already
            self.supervisor.employ_again()
        requests: dict[WorkerClient, Any] = {}
        done = 0
        while done < num_steps:
            self.check()
            clients = self._clients()
            requests = {client: requests.get(client) or client.begin_take(TAKE_S) for client in clients}
            for client in clients:
                try:
                    blocks = client.taken(requests[client], TICK_S / 10)
                except RoleLostError:
                    del requests[client]  # the caretaker replaces it
                    continue
                if blocks is not None:
                    del requests[client]
                for block in blocks or ():
                    done += block.num_steps
                    yield block

    def train(self, shards: Sequence[ShardClient], watch: ShardWatch, agent: AgentSetup | InferenceClient) -> None:
        """Set all workers to collect for replay with the trained agent, in their processes or in one for all."""
        self._shards, self.watch, self._agent = shards, watch, agent
        self.supervisor.employ_again()

    def adapt(self, counts: HubStatus, learner_waited_s: float) -> None:
        """Where the run decides by itself how many workers it has: decide, by who has waited for whom.

        Args:
            counts: of the run now.
            learner_waited_s: time that the learner has waited for something to learn from, summed.
        """
        if not (counts.auto_workers and self.training):
            return
        if self.supervisor.num_held:  # there is no memory for so many
            if self.supervisor.num_surplus:
                self._hub.adapt_workers(counts.wanted_workers - self.supervisor.num_surplus)
            return
        load = Load(
            at_s=time.monotonic(),
            wanted_workers=counts.wanted_workers,
            alive_workers=counts.alive_workers,
            free_cpus=self._room(counts.alive_workers),
            learner_waited_s=learner_waited_s,
            workers_waited_s={beat.worker_id: beat.waited_s for beat in self.supervisor.beats()},
        )
        wanted = self._scaler.wanted(load)
        if wanted != counts.wanted_workers:
            self._hub.adapt_workers(wanted)

    def _room(self, num_workers: int) -> float:
        """Cores for more workers; on nodes that offer themselves to workers these ask Ray for none, so we count."""
        on = nodes_for(self._session.nodes(), WORKER_RESOURCE)
        if not self._session.place(WORKER_RESOURCE):
            return self._session.available_cpus()
        return sum(node.get("CPU", 0.0) for node in on) - num_workers * self._share_cpus

    def process_ids(self) -> dict[str, int]:
        """Of the workers' processes, by name."""
        return {f"worker {client.worker_id}": client.process_id() for client in self._clients()}

    def stop(self) -> None:
        """Stop all workers for good."""
        self.supervisor.stop()

    def close(self) -> None:
        """Stop the caretaker, then all workers."""
        self._closing.set()
        self._caretaker.join()
        self.stop()

    def _clients(self) -> list[WorkerClient]:
        return [handle for handle in self.supervisor.handles if isinstance(handle, WorkerClient)]

    def _launch(self, worker_id: int) -> WorkerClient:
        """A worker that must wait for cores collects nothing: all but the first ones take what there is, down to 0."""
        share, resources = self._share_cpus, self._session.place(WORKER_RESOURCE)
        if worker_id >= self._config.runtime.num_workers or worker_id in self._launched:
            share = 0.0 if resources else min(share, share_for_more(1, self._session.available_cpus()))
        self._launched.add(worker_id)
        return WorkerClient.launch(
            *(self._config, worker_id, self._make_env, self._limits, share), resources=resources, labels=self._labels
        )

    def _employ(self, handle: Any, incarnation: int) -> None:
        if self._agent is None:
            handle.collect_randomly(incarnation, self._already)
            return
        seed = role_seed(self._config.seed, Role.REPLAY, INSERT_STREAMS + handle.worker_id, incarnation)
        handle.train(incarnation, self._hub, ReplayClient(self._shards, seed), self._agent)

    def _settle(self, worker_id: int, incarnation: int) -> int:
        """Take back the steps that a worker was granted and that no shard holds, now that it is gone; gives them."""
        asked = self._hub.pending(worker_id, incarnation)
        stored: list[BlockKey] = []
        for shard in self._shards:
            mine = [k for k in asked if shard_of(k.worker_id, k.sequence, len(self._shards)) == shard.index]
            try:
                stored += shard.fence(worker_id, incarnation, mine)
            except (RoleLostError, RoleSilentError):
                continue  # what it held of this worker since its snapshot is lost with it
        return self._hub.settle(worker_id, incarnation, stored)

    def _take_care(self) -> None:
        """The caretaker's loop: consumes beats, produces restarts and snapshots; ends with `close` or a failure."""
        snapshot_s = self._snapshot_s if self._config.checkpoint.save_replay else math.inf
        next_snapshot = time.monotonic() + snapshot_s
        snapshots: dict[int, Any] = {}
        while not self._closing.wait(TICK_S):
            try:
                self.supervisor.tick()
                self.supervisor.scale(self._hub.status().wanted_workers)
                self._hub.note_alive(self.supervisor.num_alive)
                if self.watch is not None:
                    self.watch.tick()
                    if time.monotonic() >= next_snapshot:
                        for shard in self._shards:
                            last = snapshots.get(shard.index)
                            if last is None or is_ready(last):  # else it is still being written
                                snapshots[shard.index] = shard.begin_snapshot()
                        next_snapshot = time.monotonic() + snapshot_s
            except RunFailedError as error:
                self._failure = error
                return
            except (RoleLostError, RoleSilentError) as error:
                self._failure = RunFailedError(f"{error}; go on with --resume")
                return
            except Exception as error:  # a mistake of ours must stop the run, not the care alone
                self._failure = RunFailedError(f"the caretaker failed: {type(error).__name__}: {error}")
                return
