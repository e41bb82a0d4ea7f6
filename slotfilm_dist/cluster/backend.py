"""The roles of a run as processes on a Ray cluster, behind the same interface as one process."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from slotfilm_dist.backend import IsDue, Player, TrainReport, never_due
from slotfilm_dist.cluster.evaluation import EvaluationPool
from slotfilm_dist.cluster.failures import RoleLostError, RoleSilentError
from slotfilm_dist.cluster.hub_client import HubClient
from slotfilm_dist.cluster.inference_client import InferenceClient
from slotfilm_dist.cluster.learner_keeper import LONG_S, SILENCE_S, STOP_S, LearnerKeeper
from slotfilm_dist.cluster.messages import AgentSetup, LearnerStatus
from slotfilm_dist.cluster.placement import STATE_RESOURCE, Placement, plan
from slotfilm_dist.cluster.replay_client import ReplayClient, ShardClient
from slotfilm_dist.cluster.reporting import Reporter
from slotfilm_dist.cluster.session import Session, namespace_of, read_cluster_file
from slotfilm_dist.cluster.shard_watch import ShardWatch
from slotfilm_dist.cluster.wiring import Wiring
from slotfilm_dist.cluster.workforce import Workforce, make_wrist_env
from slotfilm_dist.config import RunConfig
from slotfilm_dist.contracts import VectorEnv
from slotfilm_dist.messages import EpisodeSummary, TransitionBlock, WeightSnapshot
from slotfilm_dist.metrics import metric_labels
from slotfilm_dist.seeds import Role, role_seed

SLICE_S = 0.1
"""Waits for a stop are cut in slices of this length."""
REPORT_S = 1.0
"""Seconds between reports of training."""
SNAPSHOT_S = 600.0
"""Seconds between snapshots of replay in the background."""
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
        wiring: what lies between the learner and its links.
        placement: what the roles ask for, for a run that has its share of the cluster; None plans for all of it.
    """

    def __init__(
        self,
        config: RunConfig,
        run: Path,
        make_env: Callable[[RunConfig, bool], VectorEnv] = make_wrist_env,
        limits: Any = None,
        snapshot_s: float = SNAPSHOT_S,
        wiring: Wiring | None = None,
        placement: Placement | None = None,
    ) -> None:
        self._config, self._run, self._make_env = config, run.resolve(), make_env
        self._limits, self._snapshot_s, self._wiring = limits, snapshot_s, wiring or Wiring()
        self._given_placement = placement
        self._session: Session | None = None
        self._learner: LearnerKeeper | None = None
        self._hub: HubClient | None = None
        self._inference: InferenceClient | None = None
        self._labels = metric_labels(config, run.resolve().name) if config.runtime.metrics_port else {}
        self._workforce: Workforce | None = None
        self._pool: EvaluationPool | None = None
        self._shards: list[ShardClient] = []
        self._setup: AgentSetup | None = None
        self._training = False
        self.action_dim = 0
        self.reward_term_names: tuple[str, ...] = ()

    def prepare(self) -> None:
        """Start Ray, the hub and the workers, and wait until one of them has its environment; writes nothing.

        Raises:
            ValueError: the cluster lacks what the config asks for, or initial weights cannot be had.
            RunFailedError: no worker could build its environment; names why.
        """
        config, session = self._config, Session(metrics_port=self._config.runtime.metrics_port)
        self._session = session
        kept = session.place(STATE_RESOURCE)
        placement = self._given_placement or plan(config, session.nodes())
        self._placement = dataclasses.replace(placement, state_resources=kept)
        self._starts = int(read_cluster_file(self._run).get("starts", 0)) + 1
        self._hub = HubClient.launch(config, namespace_of(self._run), kept)
        self._workforce = Workforce(
            *(config, session, self._hub, self._make_env, self._limits, self._placement.share_cpus),
            first_incarnation=self._starts * INCARNATIONS_PER_START,
            snapshot_s=self._snapshot_s,
            labels=self._labels,
        )
        self._pool = EvaluationPool(config, self._make_env, self._placement.share_cpus)
        self.action_dim, self.reward_term_names = self._workforce.describe()
        if config.encoder.uses_image and config.encoder.backbone != "random":
            self._learning.call("fetch_weights")

    def enter(self) -> None:
        """Note in the run directory where the run lives, so that `slotfilm scale` finds it."""
        assert self._session is not None, "prepare comes first"
        self._session.write_cluster_file(self._run, namespace_of(self._run), self._starts)

    def random_blocks(self, num_steps: int, start: int) -> Iterator[TransitionBlock]:
        """Blocks of the random policy from all workers; a continued collection has random streams of its own."""
        self.enter()
        yield from self._workers.random_blocks(num_steps, start)

    def pretrain(self, dataset: Path, artifact: Path) -> Iterator[dict[str, float]]:
        """Pre-train in the learner's process, continuing what an interrupted pre-training left."""
        self.enter()
        yield from self._learning.pretrain(dataset.resolve(), artifact.resolve(), self._workers.check)

    def begin_training(self, dataset: Path, pretrained: Path | None, resume_from: Path | None) -> dict[str, Any]:
        """Build the learner in its process; replay follows in `train`."""
        self.enter()
        self._resumed = resume_from is not None
        beginning = self._learning.begin(
            dataset.resolve(),
            pretrained.resolve() if pretrained else None,
            resume_from.resolve() if resume_from else None,
        )
        self._schema = beginning.schema
        if beginning.values:
            self._counts.load(beginning.values["limiter"])
        else:
            self._counts.count_random_steps(beginning.random_steps)
        self._setup = self._counts.agent_setup()
        return beginning.values

    def load_agent(self, checkpoints: Path) -> int:
        """Build the agent of a run's newest checkpoint, to play with; gives the environment steps it learned from.

        Raises:
            ValueError: there is no checkpoint that can be used.
        """
        env_steps = self._learning.call("load_agent", checkpoints.resolve())
        self._workers.stop()
        self._setup = self._counts.agent_setup()
        return env_steps

    def train(self, should_stop: Callable[[], bool], is_due: IsDue = never_due) -> Iterator[TrainReport]:
        """Train until the schedule's end, or until `should_stop`, reporting once a second."""
        self._build_replay()
        workers, reporter = self._workers, Reporter(self._config)
        self._learning.start(self._replay_client)
        assert self._setup is not None, "begin_training comes first"
        if self._placement.central_inference:
            self._inference = InferenceClient.launch(self._config, self._counts, self._placement, self._labels)
        workers.train(self._shards, self._watch, self._inference or self._setup)
        finished, self._training = False, True
        while not (finished or should_stop()):
            _wait(REPORT_S, should_stop)
            workers.check()
            status = self._learning.status()
            report = self._report(reporter, status)
            yield report
            self._players.close()
            counts = self._counts.status()
            workers.adapt(counts, status.metrics.get("learner_wait_s_total", 0.0))
            finished = counts.finished and counts.updates_owed == 0 and status.updates >= counts.updates
        self._training = False
        workers.stop()
        # Not in less time than an update may take: what comes after this is the last checkpoint.
        self._learning.call("stop", SILENCE_S, timeout_s=SILENCE_S + STOP_S)
        self._watch.tick(wait=True)
        yield self._report(reporter, self._learning.status())

    def play(self, player: Player, seeds: Sequence[int], should_stop: Callable[[], bool]) -> Iterator[EpisodeSummary]:
        """Play episodes in processes of their own; training goes on meanwhile. A stop takes effect at once."""
        camera = player == "agent" and self._config.encoder.uses_image
        num_workers = len(self._workers.supervisor.handles)
        # While training goes on, its workers keep most of the cores.
        assert self._session is not None, "prepare comes first"
        room = self._players.room(self._session.available_cpus())
        size = min(num_workers // 2, room) if num_workers else self._config.runtime.num_workers
        self._players.grow(max(1, min(len(seeds), size)))
        snapshot = self._acting_weights() if player == "agent" else None

        looked_at = time.monotonic()

        def give_up() -> bool:
            nonlocal looked_at
            self._workers.check()
            if self._training and time.monotonic() - looked_at >= REPORT_S:
                self._learning.status()  # which replaces a lost one
                looked_at = time.monotonic()
            return should_stop()

        yield from self._players.play(player, seeds, give_up, camera=camera, setup=self._setup, snapshot=snapshot)

    def record(self, player: Player, seed: int, video: Path, film_strip: Path) -> EpisodeSummary:
        """Play one episode with the camera on and write its video and film strip."""
        snapshot = self._counts.latest(-1) if player == "agent" else None
        self._players.grow(1)
        return self._players.record(
            player, seed, video.resolve(), film_strip.resolve(), setup=self._setup, snapshot=snapshot
        )

    def save(self, folder: Path, values: Mapping[str, Any], *, with_replay: bool, best: bool = False) -> int:
        """Write a checkpoint in the learner's process, and replay beside it.

        Raises:
            OSError: it could not be written, or a role was lost that should have written it.
        """
        own = {"limiter": self._counts.save(0)}
        try:
            size, _ = self._learning.call("save", folder.resolve(), own | dict(values), best=best)
            if with_replay and not best:
                requests = [(shard, shard.begin_snapshot()) for shard in self._shards]
                for shard, request in requests:
                    shard.await_snapshot(request, LONG_S)
        except (RoleLostError, RoleSilentError) as error:
            raise OSError(str(error)) from error
        return size

    def close(self) -> None:
        """Stop workers, then the learner, then replay, then Ray; each whatever becomes of the one before."""
        with contextlib.ExitStack() as steps:  # the last one first
            if self._session is not None:
                steps.callback(self._session.close)
            if self._hub is not None:
                steps.callback(self._hub.kill)
                steps.callback(_unless_lost, self._hub.close)
            for shard in self._shards:
                steps.callback(shard.kill)
            if self._inference is not None:
                steps.callback(self._inference.kill)
            if self._learner is not None:
                steps.callback(_unless_lost, self._learner.close)
            if self._workforce is not None:
                steps.callback(_unless_lost, self._workforce.close)
            if self._pool is not None:
                steps.callback(self._pool.close)
            self._session = self._hub = self._inference = self._learner = self._workforce = self._pool = None
            self._shards = []

    def want_workers(self, num_workers: int) -> None:
        """Ask for another number of workers; the caretaker starts or stops them."""
        self._counts.want_workers(num_workers)

    def want_auto_workers(self) -> None:
        """Let the run decide how many workers it needs."""
        self._counts.want_auto_workers()

    def process_ids(self) -> dict[str, int]:
        """Of the processes that live now, by the role's name."""
        ids = {f"shard {shard.index}": shard.process_id() for shard in self._shards}
        if self._learner is not None:
            ids["learner"] = self._learner.process_id()
        if self._inference is not None:
            ids["inference"] = self._inference.process_id()
        ids["hub"] = self._counts.process_id()
        return ids | self._workers.process_ids()

    @property
    def _players(self) -> EvaluationPool:
        assert self._pool is not None, "prepare comes first"
        return self._pool

    @property
    def _workers(self) -> Workforce:
        assert self._workforce is not None, "the backend is closed"
        return self._workforce

    @property
    def _counts(self) -> HubClient:
        assert self._hub is not None, "the backend is closed"
        return self._hub

    @property
    def _learning(self) -> LearnerKeeper:
        """The learner, whose process starts at the first need."""
        if self._learner is None:
            self._learner = LearnerKeeper(
                *(self._config, self._run, self._counts, self._placement, self.action_dim), wiring=self._wiring
            )
        return self._learner

    def _acting_weights(self) -> WeightSnapshot | None:
        """What an evaluation plays with; while training goes on, the learner keeps it whole: it may become `best`."""
        with contextlib.suppress(RoleLostError, RoleSilentError):  # the next report replaces it
            if self._training:
                return self._learning.call("hold_candidate")
        return self._counts.latest(-1)

    def _build_replay(self) -> None:
        """Start the shards, with what a run that goes on had stored, or with the random policy's data."""
        folder = self._run / "checkpoints" / "replay"
        self._shards = [
            ShardClient.launch(
                *(self._config, self._schema, index, folder / f"shard-{index:02d}"),
                resume=self._resumed,
                resources=self._placement.state_resources,
            )
            for index in range(self._config.replay.num_shards)
        ]
        stored = [shard.beat(LONG_S).stats.num_steps for shard in self._shards]
        if sum(stored) == 0:
            self._learning.refill(self._replay_client)
        self._watch = ShardWatch(self._shards)

    def _replay_client(self) -> ReplayClient:
        return ReplayClient(self._shards, role_seed(self._config.seed, Role.REPLAY, 0, self._learning.num_restarts))

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
        metrics["learner_restarts_total/crash"] = float(self._learning.num_restarts)
        if self._inference is not None:
            metrics |= reporter.of_inference(self._inference.poll(), self._inference.num_restarts)
        metrics["worker_nonfinite_total"] = float(supervisor.num_rejected)
        metrics["worker_cut_episodes_total"] = float(supervisor.num_cut_episodes)
        episodes = tuple(self._counts.take_episodes())
        return TrainReport(env_steps=counts.env_steps, updates=status.updates, metrics=metrics, episodes=episodes)


def _unless_lost(close: Callable[[], object]) -> None:
    """Close a role that may be gone already."""
    with contextlib.suppress(RoleLostError, RoleSilentError):
        close()


def _wait(seconds: float, should_stop: Callable[[], bool]) -> None:
    until = time.monotonic() + seconds
    while time.monotonic() < until and not should_stop():
        time.sleep(SLICE_S)
