"""The roles of a run as processes on a Ray cluster, behind the same interface as one process."""

import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from slotfilm_dist.backend import Player, TrainReport
from slotfilm_dist.cluster.clients import HubClient, LearnerClient, ReplayClient, ShardClient, WorkerClient
from slotfilm_dist.cluster.evaluation import EvaluationPool
from slotfilm_dist.cluster.failures import RoleLostError, RoleSilentError, RunFailedError
from slotfilm_dist.cluster.messages import AgentSetup
from slotfilm_dist.cluster.placement import plan, share_for_more
from slotfilm_dist.cluster.reporting import Reporter
from slotfilm_dist.cluster.session import Session
from slotfilm_dist.cluster.system import ShardWatch, Supervisor
from slotfilm_dist.config import RunConfig
from slotfilm_dist.contracts import VectorEnv
from slotfilm_dist.machine import usable_cores
from slotfilm_dist.messages import EpisodeSummary, TransitionBlock
from slotfilm_dist.replay.snapshot import MANIFEST
from slotfilm_dist.seeds import Role, role_seed

TICK_S = 0.25
"""Pause of the caretaker between two looks at all roles."""
REPORT_S = 1.0
"""Seconds between reports of training."""
SNAPSHOT_S = 600.0
"""Seconds between snapshots of replay in the background."""
PRETRAIN_CHUNK = 10
"""Pre-training steps between reports."""
PRETRAIN_SAVE_S = 60.0
"""Seconds between checkpoints of an unfinished pre-training."""
LONG_S = 3600.0
"""Longest wait for what depends on the size of data: reading, encoding, writing."""
MAX_LEARNER_FAILURES = 3
"""Losses of the learner without a report of progress in between before the run is given up."""
INCARNATIONS_PER_START = 100_000
"""Incarnations of one start of a run; the next start counts on from a higher number than any before."""


def make_wrist_env(config: RunConfig, camera: bool) -> VectorEnv:
    """The simulator."""
    from slotfilm_dist.envs.wrist_env import WristEnv

    return WristEnv(config, camera=camera)


def namespace_of(run: Path) -> str:
    """Under what name a run's hub is found."""
    return "slotfilm-" + re.sub(r"[^A-Za-z0-9._-]", "-", run.resolve().name)


class RayBackend:
    """Implements `Backend` on Ray. A caretaker thread keeps workers and shards alive from the start to `close`.

    Args:
        config: the run.
        run: its directory, which every node must see: checkpoints, replay snapshots, `cluster.json`.
        make_env: builds an environment; a function at the top of a module.
        limits: how long workers may go without progress; None for the defaults.
        snapshot_s: seconds between snapshots of replay.

    Raises:
        ValueError: the cluster lacks what the config asks for.
        RunFailedError: no worker could be started.
    """

    def __init__(
        self,
        config: RunConfig,
        run: Path,
        make_env: Callable[[RunConfig, bool], VectorEnv] = make_wrist_env,
        limits: Any = None,
        snapshot_s: float = SNAPSHOT_S,
    ) -> None:
        self._config, self._run, self._make_env, self._limits = config, run.resolve(), make_env, limits
        self._snapshot_s = snapshot_s
        self._session = Session()
        self._learner: LearnerClient | None = None
        self._shards: list[ShardClient] = []
        self._watch: ShardWatch | None = None
        self._caretaker: threading.Thread | None = None
        self._closing = threading.Event()
        self._failure: RunFailedError | None = None
        self._pool: EvaluationPool | None = None
        self._setup: AgentSetup | None = None
        self._training = False
        try:
            self._placement = plan(config, self._session.nodes())
            namespace = namespace_of(self._run)
            starts = self._session.write_cluster_file(self._run, namespace)
            self._hub = HubClient.launch(config, namespace)
            self._num_launched = 0
            self._supervisor = Supervisor(
                self._launch_worker, self._employ, self._settle, starts * INCARNATIONS_PER_START
            )
            self._supervisor.scale(config.runtime.num_workers)
            self._caretaker = threading.Thread(target=self._take_care, name="caretaker", daemon=True)
            self._caretaker.start()
            self.action_dim, self.reward_term_names = self._describe()
        except BaseException:
            self.close()
            raise

    def random_blocks(self, num_steps: int, start: int) -> Iterator[TransitionBlock]:
        """Blocks of the random policy from all workers; a continued collection has random streams of its own."""
        requests: dict[WorkerClient, Any] = {}
        done = 0
        while done < num_steps:
            self._check()
            clients = self._workers()
            requests = {client: request for client, request in requests.items() if client in clients}
            for client in clients:
                request = requests.setdefault(client, None) or client.begin_take(REPORT_S)
                try:
                    blocks = client.taken(request, TICK_S / 10)
                except RoleLostError:
                    blocks = []  # the caretaker replaces it
                requests[client] = request if blocks is None else None
                for block in blocks or ():
                    done += block.num_steps
                    yield block

    def pretrain(self, dataset: Path, artifact: Path) -> Iterator[dict[str, float]]:
        """Pre-train in the learner's process, continuing what an interrupted pre-training left."""
        learner = self._launch_learner()
        dataset, artifact = dataset.resolve(), artifact.resolve()
        learner.call("begin_pretraining", dataset, artifact, timeout_s=LONG_S)
        saved_at, done = time.monotonic(), 0
        while done < self._config.pretrain.steps:
            metrics, done = learner.call("pretrain", PRETRAIN_CHUNK, timeout_s=LONG_S)
            if metrics:
                yield metrics
            self._check()
            if time.monotonic() - saved_at > PRETRAIN_SAVE_S:
                learner.call("save_pretraining", artifact, finished=False, timeout_s=LONG_S)
                saved_at = time.monotonic()
        learner.call("save_pretraining", artifact, finished=True, timeout_s=LONG_S)

    def begin_training(self, dataset: Path, pretrained: Path | None, resume_from: Path | None) -> dict[str, Any]:
        """Build the learner in its process; replay follows in `train`."""
        self._sources = dataset.resolve(), pretrained.resolve() if pretrained else None
        self._resume_from = resume_from.resolve() if resume_from else None
        learner = self._learner or self._launch_learner()
        values, self._schema, self._random_steps = learner.call(
            "begin", *self._sources, self._resume_from, timeout_s=LONG_S
        )
        if values:
            self._hub.load(values["limiter"])
        else:
            self._hub.count_random_steps(self._random_steps)
        self._setup = self._hub.agent_setup()
        return values

    def train(self, should_stop: Callable[[], bool]) -> Iterator[TrainReport]:
        """Train until the schedule's end, or until `should_stop`, reporting once a second."""
        self._build_replay()
        reporter = Reporter(self._config)
        self._start_learning()
        self._training = True
        self._supervisor.employ_again()
        failures: list[int] = []
        finished = False
        while not (finished or should_stop()):
            until = time.monotonic() + REPORT_S
            while time.monotonic() < until and not should_stop():
                time.sleep(TICK_S / 2)
            self._check()
            report = self._report(reporter)
            if report is None:
                failures = [*[at for at in failures if at >= self._hub.status().updates], self._hub.status().updates]
                self._replace_learner(len(failures))
                continue
            yield report
            self._close_players()
            status = self._hub.status()
            finished = status.finished and status.updates_owed == 0 and report.updates >= status.updates
        self._training = False
        self._supervisor.stop()
        if not finished:
            self._learning().call("stop", 10.0, timeout_s=20.0)
        report = self._report(reporter)
        if finished:
            self._learning().call("stop", 10.0, timeout_s=20.0)
        if report is not None:
            yield report

    def play(self, player: Player, seeds: Sequence[int]) -> Iterator[EpisodeSummary]:
        """Play episodes in processes of their own; training goes on meanwhile."""
        camera = player == "agent" and self._config.encoder.uses_image
        workers = self._config.runtime.num_workers
        pool = self._players(max(1, min(len(seeds), workers // 2 if self._training else workers)))
        snapshot = self._hub.latest(-1) if player == "agent" else None
        yield from pool.play(player, seeds, camera=camera, setup=self._setup, snapshot=snapshot)

    def record(self, player: Player, seed: int, video: Path, film_strip: Path) -> EpisodeSummary:
        """Play one episode with the camera on and write its video and film strip."""
        snapshot = self._hub.latest(-1) if player == "agent" else None
        return self._players(1).record(
            player, seed, video.resolve(), film_strip.resolve(), setup=self._setup, snapshot=snapshot
        )

    def save(self, folder: Path, values: Mapping[str, Any], *, with_replay: bool, best: bool = False) -> int:
        """Write a checkpoint in the learner's process, and replay beside it."""
        own = {"limiter": self._hub.save(0)}
        size, _ = self._learning().call("save", folder.resolve(), own | dict(values), best=best, timeout_s=LONG_S)
        if with_replay and not best:
            requests = [(shard, shard.begin_snapshot()) for shard in self._shards]
            for shard, request in requests:
                shard.await_snapshot(request, LONG_S)
        return size

    def close(self) -> None:
        """Stop workers, then the learner, then replay, then Ray."""
        self._closing.set()
        if self._caretaker is not None:
            self._caretaker.join(TICK_S + 10)
            self._caretaker = None
        self._close_players()
        if hasattr(self, "_supervisor"):
            self._attempt(self._supervisor.stop)
        if self._learner is not None:
            self._attempt(lambda: self._learning().call("stop", 3.0, timeout_s=5.0))
            self._learner.kill()
            self._learner = None
        for shard in self._shards:
            shard.kill()
        self._shards = []
        if hasattr(self, "_hub"):
            self._attempt(self._hub.close)
            self._hub.kill()
        self._session.close()

    @staticmethod
    def _attempt(ending: Callable[[], Any]) -> None:
        """End a role; what is gone already needs no ending."""
        try:
            ending()
        except (RoleLostError, RoleSilentError, AssertionError):
            return

    def _launch_worker(self, worker_id: int) -> WorkerClient:
        planned = self._config.runtime.num_workers
        share = self._placement.share_cpus
        if self._num_launched >= planned and worker_id >= planned:
            share = min(share, share_for_more(1, self._session.available_cpus()))
        self._num_launched += 1
        return WorkerClient.launch(self._config, worker_id, self._make_env, self._limits, share)

    def _employ(self, handle: Any, incarnation: int) -> None:
        if self._training and self._setup is not None:
            seed = role_seed(self._config.seed, Role.REPLAY, handle.worker_id + 1_000_000, incarnation)
            handle.train(incarnation, self._hub, ReplayClient(self._shards, seed), self._setup)
        else:
            handle.collect_randomly(incarnation)

    def _settle(self, worker_id: int, incarnation: int) -> None:
        """Take back the steps that a lost worker was granted and that no shard holds."""
        asked = self._hub.pending(worker_id, incarnation)
        stored = []
        for shard in self._shards:
            try:
                stored += shard.fence(worker_id, incarnation, [k for k in asked if self._is_of(k, shard)])
            except (RoleLostError, RoleSilentError):
                continue  # what it held of this worker since its snapshot is lost with it
        self._hub.settle(worker_id, incarnation, stored)

    def _is_of(self, key: Any, shard: ShardClient) -> bool:
        from slotfilm_dist.replay.ledger import shard_of

        return shard_of(key.worker_id, key.sequence, len(self._shards)) == shard.index

    def _workers(self) -> list[WorkerClient]:
        return [handle for handle in self._supervisor.handles if isinstance(handle, WorkerClient)]

    def _describe(self) -> tuple[int, tuple[str, ...]]:
        """Size of an action and the reward's terms, from the first worker that has built its environment."""
        while True:
            self._check()
            for client in self._workers()[:1]:
                try:
                    described = client.begin_describe(REPORT_S)
                except RoleLostError:
                    time.sleep(TICK_S)
                    continue
                if described is not None:
                    return described

    def _take_care(self) -> None:
        """The caretaker's loop: consumes beats, produces restarts and snapshots; ends with `close` or a failure."""
        snapshots: list[Any] = []
        next_snapshot = time.monotonic() + self._snapshot_s
        while not self._closing.wait(TICK_S):
            try:
                self._supervisor.tick()
                wanted = self._hub.status().wanted_workers
                if wanted != len(self._supervisor.handles) and not self._idle_after_training():
                    self._supervisor.scale(wanted)
                self._hub.note_alive(self._supervisor.num_alive)
                if self._watch is not None:
                    self._watch.tick()
                    if self._training and time.monotonic() >= next_snapshot:
                        snapshots = [shard.begin_snapshot() for shard in self._shards]
                        next_snapshot = time.monotonic() + self._snapshot_s
            except RunFailedError as error:
                self._failure = error
                return
            except (RoleLostError, RoleSilentError) as error:
                self._failure = RunFailedError(f"{error}; the run stopped, go on with --resume")
                return
        del snapshots
