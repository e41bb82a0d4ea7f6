"""The roles of a run as processes on a Ray cluster, behind the same interface as one process."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from slotfilm_dist.backend import Player, TrainReport
from slotfilm_dist.cluster.evaluation import EvaluationPool
from slotfilm_dist.cluster.failures import RoleLostError, RoleSilentError, RunFailedError
from slotfilm_dist.cluster.hub_client import HubClient
from slotfilm_dist.cluster.messages import AgentSetup, LearnerStatus
from slotfilm_dist.cluster.placement import plan
from slotfilm_dist.cluster.replay_client import ReplayClient, ShardClient
from slotfilm_dist.cluster.reporting import Reporter
from slotfilm_dist.cluster.role_clients import LearnerClient
from slotfilm_dist.cluster.session import Session, namespace_of, read_cluster_file
from slotfilm_dist.cluster.system import ShardWatch
from slotfilm_dist.cluster.workforce import Workforce, make_wrist_env
from slotfilm_dist.config import RunConfig
from slotfilm_dist.contracts import VectorEnv
from slotfilm_dist.machine import usable_cores
from slotfilm_dist.messages import EpisodeSummary, TransitionBlock
from slotfilm_dist.seeds import Role, role_seed

SLICE_S = 0.1
"""Waits for a stop are cut in slices of this length."""
REPORT_S = 1.0
"""Seconds between reports of training."""
STOP_S = 5.0
"""Time that the learner gets to finish its update."""
LEARNER_SILENCE_S = 60.0
"""Time without an answer after which the learner counts as lost."""
SNAPSHOT_S = 600.0
"""Seconds between snapshots of replay in the background."""
PRETRAIN_CHUNK = 10
"""Pre-training steps between reports."""
PRETRAIN_SAVE_S = 60.0
"""Seconds between checkpoints of an unfinished pre-training."""
LONG_S = 3600.0
"""Longest wait for what depends on the size of data: reading, encoding, writing."""
MAX_LEARNER_RESTARTS = 10
"""Losses of the learner before the run is given up."""
INCARNATIONS_PER_START = 100_000
"""Incarnations of one start of a run; the next start counts on from a higher number than any before."""


class RayBackend:
    """Implements `Backend` on Ray. A caretaker thread keeps workers and shards alive from the start to `close`.

    Args:
        config: the run.
        run: its directory, which every node must see: checkpoints, replay snapshots, `cluster.json`.
        make_env: builds an environment; a function at the top of a module.
        limits: how long workers may go without progress; None for the defaults.
        snapshot_s: seconds between snapshots of replay.
    """

    def __init__(
        self,
        config: RunConfig,
        run: Path,
        make_env: Callable[[RunConfig, bool], VectorEnv] = make_wrist_env,
        limits: Any = None,
        snapshot_s: float = SNAPSHOT_S,
    ) -> None:
        self._config, self._run, self._make_env = config, run.resolve(), make_env
        self._limits, self._snapshot_s = limits, snapshot_s
        self._session: Session | None = None
        self._learner: LearnerClient | None = None
        self._hub: HubClient | None = None
        self._workforce: Workforce | None = None
        self._pool: EvaluationPool | None = None
        self._shards: list[ShardClient] = []
        self._setup: AgentSetup | None = None
        self._learner_restarts = 0
        self.action_dim = 0
        self.reward_term_names: tuple[str, ...] = ()

    def prepare(self) -> None:
        """Start Ray, the hub and the workers, and wait until one of them has its environment; writes nothing.

        Raises:
            ValueError: the cluster lacks what the config asks for, or initial weights cannot be had.
            RunFailedError: no worker could build its environment; names why.
        """
        config, session = self._config, Session()
        self._session = session
        self._placement = plan(config, session.nodes())
        self._starts = int(read_cluster_file(self._run).get("starts", 0)) + 1
        self._hub = HubClient.launch(config, namespace_of(self._run))
        self._workforce = Workforce(
            *(config, session, self._hub, self._make_env, self._limits, self._placement.share_cpus),
            first_incarnation=self._starts * INCARNATIONS_PER_START,
            snapshot_s=self._snapshot_s,
        )
        self.action_dim, self.reward_term_names = self._workforce.describe()
        if config.encoder.uses_image and config.encoder.backbone != "random":
            self._launch_learner().call("fetch_weights", timeout_s=LONG_S)

    def enter(self) -> None:
        """Note in the run directory where the run lives, so that `slotfilm scale` finds it."""
        assert self._session is not None, "prepare comes first"
        self._session.write_cluster_file(self._run, namespace_of(self._run), self._starts)

    def random_blocks(self, num_steps: int, start: int) -> Iterator[TransitionBlock]:
        """Blocks of the random policy from all workers; a continued collection has random streams of its own."""
        self.enter()
        yield from self._workers.random_blocks(num_steps)

    def pretrain(self, dataset: Path, artifact: Path) -> Iterator[dict[str, float]]:
        """Pre-train in the learner's process, continuing what an interrupted pre-training left."""
        self.enter()
        learner = self._learner or self._launch_learner()
        dataset, artifact = dataset.resolve(), artifact.resolve()
        learner.call("begin_pretraining", dataset, artifact, timeout_s=LONG_S)
        saved_at, done = time.monotonic(), 0
        while done < self._config.pretrain.steps:
            metrics, done = learner.call("pretrain", PRETRAIN_CHUNK, timeout_s=LONG_S)
            if metrics:
                yield metrics
            self._workers.check()
            if time.monotonic() - saved_at > PRETRAIN_SAVE_S:
                learner.call("save_pretraining", artifact, finished=False, timeout_s=LONG_S)
                saved_at = time.monotonic()
        learner.call("save_pretraining", artifact, finished=True, timeout_s=LONG_S)

    def begin_training(self, dataset: Path, pretrained: Path | None, resume_from: Path | None) -> dict[str, Any]:
        """Build the learner in its process; replay follows in `train`."""
        self.enter()
        self._sources = dataset.resolve(), pretrained.resolve() if pretrained else None
        self._resumed = resume_from is not None
        learner = self._learner or self._launch_learner()
        values, self._schema, random_steps = learner.call(
            "begin", *self._sources, resume_from.resolve() if resume_from else None, timeout_s=LONG_S
        )
        if values:
            self._counts.load(values["limiter"])
        else:
            self._counts.count_random_steps(random_steps)
        self._setup = self._counts.agent_setup()
        return values

    def load_agent(self, checkpoints: Path) -> int:
        """Build the agent of a run's newest checkpoint, to play with; gives the environment steps it learned from.

        Raises:
            ValueError: there is no checkpoint that can be used.
        """
        learner = self._learner or self._launch_learner()
        env_steps = learner.call("load_agent", checkpoints.resolve(), timeout_s=LONG_S)
        self._workers.stop()
        self._setup = self._counts.agent_setup()
        return env_steps

    def train(self, should_stop: Callable[[], bool]) -> Iterator[TrainReport]:
        """Train until the schedule's end, or until `should_stop`, reporting once a second."""
        self._build_replay()
        workers, reporter = self._workers, Reporter(self._config)
        self._learning.call("start", timeout_s=LONG_S)
        assert self._setup is not None, "begin_training comes first"
        workers.train(self._shards, self._watch, self._setup)
        finished = False
        while not (finished or should_stop()):
            _wait(REPORT_S, should_stop)
            workers.check()
            status = self._learner_status()
            report = self._report(reporter, status)
            yield report
            self._close_players()
            counts = self._counts.status()
            finished = counts.finished and counts.updates_owed == 0 and status.updates >= counts.updates
        workers.stop()
        self._learning.call("stop", STOP_S, timeout_s=2 * STOP_S)
        self._watch.tick(wait=True)
        yield self._report(reporter, self._learner_status())

    def play(self, player: Player, seeds: Sequence[int]) -> Iterator[EpisodeSummary]:
        """Play episodes in processes of their own; training goes on meanwhile."""
        camera = player == "agent" and self._config.encoder.uses_image
        num_workers = len(self._workers.supervisor.handles)
        # While training goes on, its workers keep most of the cores.
        size = num_workers // 2 if num_workers else self._config.runtime.num_workers
        pool = self._players(max(1, min(len(seeds), size)))
        snapshot = self._counts.latest(-1) if player == "agent" else None
        yield from pool.play(player, seeds, camera=camera, setup=self._setup, snapshot=snapshot)

    def record(self, player: Player, seed: int, video: Path, film_strip: Path) -> EpisodeSummary:
        """Play one episode with the camera on and write its video and film strip."""
        snapshot = self._counts.latest(-1) if player == "agent" else None
        return self._players(1).record(
            player, seed, video.resolve(), film_strip.resolve(), setup=self._setup, snapshot=snapshot
        )

    def save(self, folder: Path, values: Mapping[str, Any], *, with_replay: bool, best: bool = False) -> int:
        """Write a checkpoint in the learner's process, and replay beside it."""
        own = {"limiter": self._counts.save(0)}
        size, _ = self._learning.call("save", folder.resolve(), own | dict(values), best=best, timeout_s=LONG_S)
        if with_replay and not best:
            requests = [(shard, shard.begin_snapshot()) for shard in self._shards]
            for shard, request in requests:
                shard.await_snapshot(request, LONG_S)
        return size

    def close(self) -> None:
        """Stop workers, then the learner, then replay, then Ray."""
        self._close_players()
        if self._workforce is not None:
            _attempt(self._workforce.close)
            self._workforce = None
        if self._learner is not None:
            learner, self._learner = self._learner, None
            _attempt(lambda: learner.call("stop", STOP_S / 2, timeout_s=STOP_S))
            learner.kill()
        for shard in self._shards:
            shard.kill()
        self._shards = []
        if self._hub is not None:
            _attempt(self._hub.close)
            self._hub.kill()
            self._hub = None
        if self._session is not None:
            self._session.close()
            self._session = None

    def want_workers(self, num_workers: int) -> None:
        """Ask for another number of workers; the caretaker starts or stops them."""
        self._counts.want_workers(num_workers)

    def process_ids(self) -> dict[str, int]:
        """Of the processes that live now, by the role's name."""
        ids = {f"shard {shard.index}": shard.process_id() for shard in self._shards}
        if self._learner is not None:
            ids["learner"] = self._learner.process_id()
        ids["hub"] = self._counts.process_id()
        return ids | self._workers.process_ids()

    @property
    def _workers(self) -> Workforce:
        assert self._workforce is not None, "the backend is closed"
        return self._workforce

    @property
    def _counts(self) -> HubClient:
        assert self._hub is not None, "the backend is closed"
        return self._hub

    @property
    def _learning(self) -> LearnerClient:
        assert self._learner is not None, "begin_training comes first"
        return self._learner

    def _launch_learner(self) -> LearnerClient:
        threads = self._config.runtime.learner_threads or max(1, int(usable_cores()) // 2)
        self._learner = LearnerClient.launch(
            self._config,
            self.action_dim,
            threads,
            self._counts,
            num_cpus=self._placement.share_cpus,
            gpu=self._placement.gpu,
        )
        return self._learner

    def _build_replay(self) -> None:
        """Start the shards, with what a run that goes on had stored, or with the random policy's data."""
        folder = self._run / "checkpoints" / "replay"
        self._shards = [
            ShardClient.launch(self._config, self._schema, index, folder / f"shard-{index:02d}", resume=self._resumed)
            for index in range(self._config.replay.num_shards)
        ]
        stored = [shard.beat(LONG_S).stats.num_steps for shard in self._shards]
        self._learning.call("connect", self._replay_client(), timeout_s=LONG_S)
        if sum(stored) == 0:
            self._learning.call("refill", self._sources[0], timeout_s=LONG_S)
        self._watch = ShardWatch(self._shards, self._config.replay.min_steps, self._counts.start_over)

    def _replay_client(self) -> ReplayClient:
        return ReplayClient(self._shards, role_seed(self._config.seed, Role.REPLAY, 0, self._learner_restarts))

    def _learner_status(self) -> LearnerStatus:
        """How the learner does; a lost one is replaced and goes on from the last checkpoint.

        Raises:
            RunFailedError: it failed by itself, or was lost too often.
        """
        try:
            status = self._learning.status(LEARNER_SILENCE_S)
        except (RoleLostError, RoleSilentError) as error:
            return self._replace_learner(error)
        if status.error:
            raise RunFailedError(f"the learner stopped: {status.error}; go on with --resume")
        return status

    def _replace_learner(self, error: Exception) -> LearnerStatus:
        self._learner_restarts += 1
        if self._learner_restarts > MAX_LEARNER_RESTARTS:
            raise RunFailedError(
                f"the learner was lost {self._learner_restarts} times, last: {error}; --resume goes on"
            )
        self._learning.kill()
        learner = self._launch_learner()
        folder = self._run / "checkpoints"
        found = folder if any(folder.glob("updates-*")) else None
        learner.call("begin", *self._sources, found, timeout_s=LONG_S)
        status = learner.status()
        # What was granted and is lost with the process is due again.
        self._counts.refund_updates(self._counts.status().updates - status.updates)
        learner.call("connect", self._replay_client(), timeout_s=LONG_S)
        learner.call("start", timeout_s=LONG_S)
        return status

    def _report(self, reporter: Reporter, status: LearnerStatus) -> TrainReport:
        supervisor, counts = self._workers.supervisor, self._counts.status()
        metrics = reporter.metrics(
            counts,
            status,
            supervisor.beats(),
            list(self._watch.beats.values()),
            supervisor.restarts,
            self._watch.num_restarts,
        )
        metrics["learner_restarts_total/crash"] = float(self._learner_restarts)
        episodes = tuple(self._counts.take_episodes())
        return TrainReport(env_steps=counts.env_steps, updates=status.updates, metrics=metrics, episodes=episodes)

    def _players(self, size: int) -> EvaluationPool:
        if self._pool is None or self._pool.size < size:
            self._close_players()
            self._pool = EvaluationPool(self._config, self._make_env, self._placement.share_cpus, size)
        return self._pool

    def _close_players(self) -> None:
        if self._pool is not None:
            self._pool.close()
            self._pool = None


def _wait(seconds: float, should_stop: Callable[[], bool]) -> None:
    until = time.monotonic() + seconds
    while time.monotonic() < until and not should_stop():
        time.sleep(SLICE_S)


def _attempt(ending: Callable[[], Any]) -> None:
    """End a role; what is gone already needs no ending."""
    try:
        ending()
    except (RoleLostError, RoleSilentError):
        return
