"""Thin shells that put the plain roles into Ray actors. They add a process and nothing else.

Imports of a role stand in its constructor, so that a shard's process never loads torch.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import ray

from slotfilm_dist.cluster.messages import (
    AgentSetup,
    BlockKey,
    BlockNotice,
    InferenceAnswer,
    InferenceRequest,
    InferenceStatus,
    LearnerStatus,
    WorkerBeat,
)
from slotfilm_dist.config import RunConfig
from slotfilm_dist.machine import offer_memory
from slotfilm_dist.messages import EpisodeSummary, TransitionBlock, WeightSnapshot

if TYPE_CHECKING:
    from slotfilm_dist.backend import Player
    from slotfilm_dist.cluster.worker import EnvFactory, Limits
    from slotfilm_dist.replay.schema import ReplaySchema


OFFERED = {"worker": 1000, "inference": 600, "shard": 400, "learner": 200}
"""When memory runs out, the system ends processes with more of this first: what a run can lose before what it cannot.
A thousand outweighs all memory of the machine. The hub and the driver offer nothing."""


class HubActor:
    """A `Hub` in a process; workers wait in a group of threads of their own and never keep the learner waiting."""

    def __init__(self, config: RunConfig) -> None:
        from slotfilm_dist.cluster.hub import Hub, build_limiter

        schedule = config.schedule
        limiter = build_limiter(
            schedule.updates_per_step,
            max(config.replay.min_steps, schedule.random_steps),
            config.runtime.block_steps,
        )
        runtime = config.runtime
        self._hub = Hub(limiter, schedule.total_steps, runtime.num_workers, auto_workers=runtime.auto_workers)

    @ray.method(concurrency_group="workers")
    def admit_steps(self, notice: BlockNotice, stored: Sequence[BlockKey], timeout_s: float) -> Any:
        return self._hub.admit_steps(notice, stored, timeout_s)

    @ray.method(concurrency_group="learner")
    def admit_updates(self, max_updates: int, timeout_s: float) -> Any:
        return self._hub.admit_updates(max_updates, timeout_s)

    @ray.method(concurrency_group="publish")
    def publish(self, snapshot: WeightSnapshot) -> None:
        """Put weights where every process of a node reads the same copy, then tell those who wait for them."""
        if snapshot.version >= self._hub.newest_version():
            self._shared = snapshot.version, ray.put(snapshot)
            self._hub.publish(snapshot)

    @ray.method(concurrency_group="weights")
    def await_newer(self, newer_than: int, timeout_s: float) -> list[Any]:
        """The newest weights' place in the object store, in a list, or an empty one when time runs out."""
        newer = self._hub.await_newer(newer_than, timeout_s)
        return [self._shared[1]] if newer is not None else []

    @ray.method(concurrency_group="control")
    def call(self, method: str, *arguments: Any) -> Any:
        """Any other method of the hub; none of them waits."""
        return getattr(self._hub, method)(*arguments)

    @ray.method(concurrency_group="control")
    def process_id(self) -> int:
        return os.getpid()


class ShardActor:
    """A `ShardRole` in a process; started again by Ray when it dies, with its last snapshot."""

    def __init__(self, config: RunConfig, schema: "ReplaySchema", index: int, folder: Path, *, resume: bool) -> None:
        offer_memory(OFFERED["shard"])
        from slotfilm_dist.cluster.shard_role import FencedShard, ShardRole
        from slotfilm_dist.replay.shard import build_shard

        self._role = ShardRole(build_shard(FencedShard, config, schema, index), folder)
        restarted = ray.get_runtime_context().was_current_actor_reconstructed
        if resume or restarted:
            self._role.restore(strict=not restarted)

    @ray.method(concurrency_group="insert")
    def insert(self, block: TransitionBlock) -> bool:
        return self._role.insert(block)

    @ray.method(concurrency_group="draw")
    def draw(self, num_rows: int) -> Any:
        return self._role.draw(num_rows)

    @ray.method(concurrency_group="control")
    def call(self, method: str, *arguments: Any) -> Any:
        """Any other method of the role that is quick."""
        return getattr(self._role, method)(*arguments)

    @ray.method(concurrency_group="snapshot")
    def snapshot(self) -> int:
        return self._role.snapshot()


class WorkerActor:
    """A `WorkerLoop` in a process, which exports its own metrics with its beats."""

    def __init__(
        self,
        config: RunConfig,
        worker_id: int,
        make_env: "EnvFactory",
        limits: "Limits",
        labels: Mapping[str, str],
    ) -> None:
        _prepare_for_acting(config)
        from slotfilm_dist.cluster.ray_sink import RaySink
        from slotfilm_dist.cluster.reporting import WorkerMetrics
        from slotfilm_dist.cluster.worker import WorkerLoop
        from slotfilm_dist.sinks import FanOut

        self._loop = WorkerLoop(config, worker_id, make_env, limits)
        self._metrics = WorkerMetrics(FanOut([RaySink(labels, str(worker_id))] if labels else []))

    def train(self, incarnation: int, hub: Any, store: Any, agent: Any) -> None:
        self._loop.train(incarnation, hub, store, agent)

    def collect_randomly(self, incarnation: int, already: int) -> None:
        self._loop.collect_randomly(incarnation, already)

    def describe(self, timeout_s: float) -> tuple[int, tuple[str, ...]] | None:
        return self._loop.describe(timeout_s)

    def take_random_blocks(self, timeout_s: float) -> list[TransitionBlock]:
        return self._loop.take_random_blocks(timeout_s)

    def stop(self, timeout_s: float) -> bool:
        return self._loop.stop(timeout_s)

    @ray.method(concurrency_group="control")
    def beat(self) -> WorkerBeat:
        beat = self._loop.beat()
        self._metrics.note(beat)
        return beat

    @ray.method(concurrency_group="control")
    def process_id(self) -> int:
        return os.getpid()


class InferenceActor:
    """An `InferenceServer` in a process; started again by Ray when it dies. It exports how late its weights are.

    The agent comes from the hub and not as an argument: Ray may have dropped a large argument when it starts it again.
    """

    def __init__(self, config: RunConfig, hub: Any, labels: Mapping[str, str], *, gpu: bool) -> None:
        offer_memory(OFFERED["inference"])
        import torch

        from slotfilm_dist.cluster.inference import DEADLINE_S, InferenceServer
        from slotfilm_dist.cluster.ray_sink import RaySink
        from slotfilm_dist.cluster.worker import build_policy
        from slotfilm_dist.seeds import Role, role_seed
        from slotfilm_dist.sinks import FanOut

        torch.set_num_threads(config.runtime.worker_threads)
        device = torch.device("cuda" if gpu else "cpu")
        policy = build_policy(config, hub.agent_setup(), role_seed(config.seed, Role.ACTIONS), device=device)
        runtime = config.runtime
        self._server = InferenceServer(
            policy,
            hub,
            # A recorded pass takes a GPU less time than anyone would wait to share one.
            deadline_s=0.0 if gpu and runtime.cuda_graphs else DEADLINE_S,
            max_staleness_s=runtime.max_staleness_s,
            cuda_graphs=runtime.cuda_graphs,
        )
        self._sink = FanOut([RaySink(labels, "central")] if labels else [])

    @ray.method(concurrency_group="requests")
    def infer(self, request: InferenceRequest) -> InferenceAnswer:
        return self._server.infer(request)

    @ray.method(concurrency_group="control")
    def policy_version(self) -> int:
        return self._server.policy_version

    @ray.method(concurrency_group="control")
    def status(self) -> InferenceStatus:
        status = self._server.status()
        for lag_s in status.weights_lags_s:
            self._sink.write({"weights_apply_s": lag_s})
        return status

    @ray.method(concurrency_group="control")
    def process_id(self) -> int:
        return os.getpid()


class LearnerActor:
    """A `LearnerRole` in a process."""

    def __init__(self, config: RunConfig, action_dim: int, num_threads: int, *, gpu: bool, hub: Any) -> None:
        offer_memory(OFFERED["learner"])
        import torch

        from slotfilm_dist.cluster.learner_role import LearnerRole

        torch.set_num_threads(num_threads)
        self._role = LearnerRole(config, action_dim, torch.device("cuda" if gpu else "cpu"), hub)

    def call(self, method: str, *arguments: Any, **options: Any) -> Any:
        """A method of the role that takes its time."""
        return getattr(self._role, method)(*arguments, **options)

    @ray.method(concurrency_group="control")
    def status(self) -> LearnerStatus:
        return self._role.status()

    @ray.method(concurrency_group="control")
    def process_id(self) -> int:
        return os.getpid()


class PlayerActor:
    """Plays evaluation episodes in a process of its own, one at a time."""

    def __init__(self, config: RunConfig, make_env: "EnvFactory") -> None:
        _prepare_for_acting(config)
        from slotfilm_dist.cluster.player import PlayerRole

        self._role = PlayerRole(config, make_env)

    def prepare(
        self, player: "Player", camera: bool, setup: AgentSetup | None, snapshot: WeightSnapshot | None
    ) -> None:
        self._role.prepare(player, camera=camera, setup=setup, snapshot=snapshot)

    def play(self, seed: int) -> EpisodeSummary:
        return self._role.play(seed)

    def record(self, seed: int, video: Path, film_strip: Path) -> EpisodeSummary:
        return self._role.record(seed, video, film_strip)


def _prepare_for_acting(config: RunConfig) -> None:
    """One core for drawing and as many torch threads as asked for; more would fight over the cores."""
    offer_memory(OFFERED["worker"])
    os.environ["LP_NUM_THREADS"] = "0"  # the software Vulkan driver draws in the calling thread
    import torch

    torch.set_num_threads(config.runtime.worker_threads)


CONCURRENCY: dict[type, dict[str, int]] = {
    HubActor: {"workers": 64, "weights": 64, "learner": 2, "publish": 1, "control": 4},
    ShardActor: {"insert": 2, "draw": 2, "control": 2, "snapshot": 1},
    WorkerActor: {"control": 1},
    InferenceActor: {"requests": 64, "control": 2},
    LearnerActor: {"control": 2},
    PlayerActor: {},
}
"""Threads of each group of an actor's methods; the rest share one thread."""
