"""Every role of a run in one process, without Ray: the same seed gives the same numbers.

    RolloutLoop --block--> ShardedReplay --batch--> Learner
         ^                                            |
         '------------- shares its networks ----------'

One loop takes turns: collect a block, make the updates that the limiter owes for it. A stop waits for the end of the
running episode, where the simulator's state follows from a seed, so that a resumed run continues exactly.
"""

import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from slotfilm_dist.backend import IsDue, Player, RunFailedError, TrainReport, never_due
from slotfilm_dist.config import RunConfig
from slotfilm_dist.contracts import AdjustableEnv
from slotfilm_dist.evaluation.rollouts import Recorder
from slotfilm_dist.evaluation.video import write_film_strip, write_video
from slotfilm_dist.learning.checkpoint import CheckpointStore, read_checkpoint
from slotfilm_dist.learning.learner import Learner, dataset_hash, learning_hash
from slotfilm_dist.learning.off_policy import TrainingDivergedError
from slotfilm_dist.learning.pretraining_files import continue_unfinished, save_finished, save_unfinished
from slotfilm_dist.learning.recovery import Recovery
from slotfilm_dist.local_envs import LocalEnvs, make_wrist_env
from slotfilm_dist.machine import usable_cores, usable_memory_bytes
from slotfilm_dist.messages import EpisodeSummary, SampleBatch, TrainingEpisode, TransitionBlock
from slotfilm_dist.nets.agent import build_encoder
from slotfilm_dist.policy import AgentPolicy, RandomPolicy
from slotfilm_dist.rejection import BrokenEnvironmentError
from slotfilm_dist.replay.dataset import open_dataset
from slotfilm_dist.replay.limiter import RateLimiter
from slotfilm_dist.replay.memory import check_memory
from slotfilm_dist.replay.shard import ReplayShard, build_shard
from slotfilm_dist.replay.sharded import ShardedReplay
from slotfilm_dist.replay.snapshot import MANIFEST, read_snapshot, write_snapshot
from slotfilm_dist.rollout import RolloutLoop
from slotfilm_dist.seeds import Role, role_seed

PRETRAIN_CHUNK = 10
"""Pre-training steps between reports."""
PRETRAIN_SAVE_S = 60.0
"""Seconds between checkpoints of an unfinished pre-training."""
REPORT_S = 1.0
"""Seconds between reports of training."""
STOP_PATIENCE_S = 20.0
"""How long a stop waits for the end of the episode; where a resume has to be exact, as long as it takes."""

_logger = logging.getLogger(__name__)


def learner_device(config: RunConfig, option: str = "--runtime.device") -> torch.device:
    """Where the learner computes; raises ``ValueError``, naming the option, if a GPU is asked for and there is none."""
    wanted = config.runtime.device
    if wanted == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if wanted == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"runtime.device = 'cuda': torch finds no CUDA GPU here; use {option} cpu or auto")
    return torch.device(wanted)


class LocalBackend:
    """Implements `Backend` in one process.

    Args:
        config: the run.
        make_env: builds an environment, with a camera or without.
    """

    def __init__(
        self, config: RunConfig, make_env: Callable[[RunConfig, bool], AdjustableEnv] = make_wrist_env
    ) -> None:
        self._config = config
        self._device = learner_device(config)
        self._use_threads(all_cores=False)
        self._envs = LocalEnvs(config, make_env)
        self._rejected_before = self._cut_before = 0
        self._learner: Learner | None = None

    def prepare(self) -> None:
        """Find out now whether memory suffices and simulator, renderer, assets and initial weights are there.

        Raises:
            ValueError: something is missing; says what and how to mend it.
        """
        check_memory(self._config, usable_memory_bytes())
        if self._config.encoder.uses_image and self._config.encoder.backbone != "random":
            build_encoder(self._config, fetch_weights=True)
        self._envs.training  # noqa: B018  built here

    @property
    def action_dim(self) -> int:
        """Size of the action."""
        return self._envs.any.action_dim

    @property
    def reward_term_names(self) -> tuple[str, ...]:
        """Names of the reward's components."""
        return self._envs.any.reward_term_names

    def random_blocks(self, num_steps: int, start: int) -> Iterator[TransitionBlock]:
        """Blocks of the random policy; a collection continued at step `start` has random streams of its own."""
        seed = self._config.seed
        done = tries = 0
        while done < num_steps:
            streams = {"worker": tries, "incarnation": start}
            policy = RandomPolicy(self.action_dim, role_seed(seed, Role.RANDOM_ACTIONS, **streams))
            self._envs.training.episode_steps = self._config.random_episode_length
            try:
                loop = RolloutLoop(
                    self._envs.training, policy, role_seed(seed, Role.RANDOM_EPISODES, **streams), incarnation=start
                )
                while done < num_steps:
                    block = loop.collect(min(self._config.runtime.block_steps, num_steps - done))
                    done += block.num_steps
                    yield block
            except BrokenEnvironmentError as error:
                self._envs.replace_broken(error)
                tries += 1
        self._envs.training.episode_steps = self._config.env.max_steps

    def pretrain(self, dataset: Path, artifact: Path) -> Iterator[dict[str, float]]:
        """Pre-train and write the result, continuing what an interrupted pre-training left."""
        self._use_threads(all_cores=True)
        learner = self._learner = Learner(self._config, self.action_dim, self._device)
        learner.begin_pretraining(open_dataset(dataset, dataset_hash(self._config)))
        continue_unfinished(learner, artifact)
        saved_at = time.monotonic()
        while learner.pretrain_steps < self._config.pretrain.steps:
            yield learner.pretrain(PRETRAIN_CHUNK)
            if time.monotonic() - saved_at > PRETRAIN_SAVE_S:
                save_unfinished(learner, artifact)
                saved_at = time.monotonic()
        save_finished(learner, artifact)
        self._use_threads(all_cores=False)

    def begin_training(self, dataset: Path, pretrained: Path | None, resume_from: Path | None) -> dict[str, Any]:
        """Build learner, replay, limiter and rollouts; give back the checkpoint's values."""
        config = self._config
        store = CheckpointStore(resume_from, config.checkpoint.keep) if resume_from else None
        found = store.read_last(learning_hash(config), strict=config.checkpoint.strict) if store else None
        learner = self._learner = Learner(
            config, self.action_dim, self._device, fetch_weights=not (pretrained or found)
        )
        data = open_dataset(dataset, dataset_hash(config))
        if pretrained is not None:
            learner.load_pretrained(read_checkpoint(pretrained))
        learner.begin_rl(data)
        values: dict[str, Any] = {}
        if found is not None:
            checkpoint, problems = found
            for problem in problems:
                _logger.warning("an older checkpoint is used: %s", problem)
            learner.load_checkpoint(checkpoint)
            values = checkpoint.values
        self._recovery = Recovery(learner)
        if resume_from is not None:
            self._recovery.use(resume_from)
        self._store = self._build_replay(learner)
        snapshot = resume_from / "replay" if resume_from else None
        if values and snapshot is not None and (snapshot / MANIFEST).exists():
            self._store.load(read_snapshot(snapshot))
        else:
            self._use_threads(all_cores=True)
            for block in learner.stored_blocks(data):
                self._store.insert(block)
            self._use_threads(all_cores=False)
        self._limiter = RateLimiter(
            config.schedule.updates_per_step,
            min_steps=max(config.replay.min_steps, config.schedule.random_steps),
            slack_updates=0,
            # Enough for a block while an update takes many steps, as the smallest ratios ask for.
            slack_steps=max(
                4 * config.runtime.block_steps + config.sac.batch_size,
                config.runtime.block_steps + math.ceil(1 / config.schedule.updates_per_step) + 1,
            ),
        )
        self._limiter.try_insert(data.num_steps)
        self._limiter.start_learning(data.num_steps)
        self._policy = AgentPolicy(learner.encoder, learner.rl.actor, role_seed(config.seed, Role.ACTIONS))
        self._policy.version = learner.updates
        self._loop = self._new_loop(0)
        if values:
            self._limiter.load(values["limiter"])
            if "rollout" in values:  # a checkpoint written on a cluster has neither: its workers draw anew
                self._loop.load(values["rollout"])
                self._policy.load_noise(values["noise"])
            if self._store.knows(0, self._loop.incarnation, self._loop.sequence):
                # Replay is ahead of an older checkpoint, or has been on a cluster: these blocks are others.
                self._loop = self._new_loop(self._store.newest_incarnation(0) + 1)
        return values

    def _new_loop(self, incarnation: int) -> RolloutLoop:
        """Rollouts with episodes of their own for every incarnation."""
        seed = role_seed(self._config.seed, Role.EPISODES, incarnation=incarnation)
        return RolloutLoop(self._envs.training, self._policy, seed, incarnation=incarnation)

    def load_agent(self, checkpoints: Path) -> int:
        """Build the agent of a run's newest checkpoint, to play with; gives the environment steps it learned from.

        Raises:
            ValueError: there is no checkpoint that can be used.
        """
        found = CheckpointStore(checkpoints, self._config.checkpoint.keep).read_last(learning_hash(self._config))
        if found is None:
            raise ValueError(f"{checkpoints} holds no checkpoint; the run has not trained yet")
        checkpoint, _ = found
        self._learner = Learner(self._config, self.action_dim, self._device, fetch_weights=False)
        self._learner.load_checkpoint(checkpoint)
        return int(checkpoint.values["limiter"]["env_steps"])

    def train(self, should_stop: Callable[[], bool], is_due: IsDue = never_due) -> Iterator[TrainReport]:
        """Collect and update in turn until the schedule's end; a stop waits for an end of the episode that is near."""
        config, learner, limiter = self._config, self._trained(), self._limiter
        episodes: list[TrainingEpisode] = []
        reported, patient_until = time.monotonic(), math.inf
        began_steps, began_updates = limiter.env_steps, learner.updates
        while (left := config.schedule.total_steps - limiter.env_steps) > 0 or limiter.updates_owed():
            if limiter.updates_owed():  # also those that a return to a checkpoint has lost
                self._update(self._store.sample(1, config.sac.batch_size)[0])
            else:
                self._policy.version = learner.updates
                block = self._collect(min(config.runtime.block_steps, left))
                is_new = self._store.insert(block)
                assert is_new, "blocks of one process are numbered"
                limiter.try_insert(block.num_steps)
                where = {"policy_version": block.policy_version, "env_steps": limiter.env_steps}
                episodes += [TrainingEpisode(summary=episode, **where) for episode in block.episodes]
            settled = self._loop.at_episode_start and not limiter.updates_owed()
            elapsed = time.monotonic() - reported
            if elapsed >= REPORT_S or (settled and is_due(limiter.env_steps, learner.updates)):
                metrics = self._metrics() | {
                    "worker_env_steps_per_s": (limiter.env_steps - began_steps) / elapsed,
                    "learner_updates_per_s": (learner.updates - began_updates) / elapsed,
                    "replay_stored_steps": self._store.num_steps(),
                    "limiter_ratio": limiter.ratio,
                }
                yield self._report(metrics, episodes, settled)
                episodes = []
                reported, began_steps, began_updates = time.monotonic(), limiter.env_steps, learner.updates
            if should_stop():
                patience_s = math.inf if config.runtime.exact_resume else STOP_PATIENCE_S
                patient_until = min(patient_until, time.monotonic() + patience_s)
                if settled or time.monotonic() >= patient_until:
                    break
        yield self._report(self._metrics(), episodes, True)

    def _collect(self, num_steps: int) -> TransitionBlock:
        """A block; an environment that is broken is replaced, and its worker's next incarnation goes on."""
        while True:
            try:
                return self._loop.collect(num_steps)
            except BrokenEnvironmentError as error:
                self._envs.replace_broken(error)
                self._rejected_before += self._loop.num_rejected
                self._cut_before += self._loop.num_cut_episodes
                self._loop = self._new_loop(self._loop.incarnation + 1)

    def _update(self, batch: SampleBatch) -> None:
        """One update that is due; what a return to a checkpoint loses is due again."""
        try:
            self._trained().update(batch)
        except TrainingDivergedError as error:
            try:
                lost = self._recovery.roll_back(error)
            except TrainingDivergedError as final:
                raise RunFailedError(f"the learner stopped: {final}; go on with --resume") from final
            _logger.warning("%s; went back by %d updates, with half the rates", error, lost)
        self._limiter.set_updates(self._trained().updates)

    def _metrics(self) -> dict[str, float]:
        return self._trained().metrics() | {
            "learner_rollbacks_total": self._recovery.num_rollbacks,
            "worker_nonfinite_total": self._rejected_before + self._loop.num_rejected,
            "worker_cut_episodes_total": self._cut_before + self._loop.num_cut_episodes,
            "worker_restarts_total/nonfinite": self._envs.num_broken,
        }

    def play(self, player: Player, seeds: Sequence[int], should_stop: Callable[[], bool]) -> Iterator[EpisodeSummary]:
        """Play episodes in an environment of their own; a stop takes effect between two."""
        camera = player == "agent" and self._config.encoder.uses_image
        for episode in self._envs.play(player, self._agent(player), seeds, camera=camera):
            yield episode
            if should_stop():
                return

    def record(self, player: Player, seed: int, video: Path, film_strip: Path) -> EpisodeSummary:
        """Play one episode with the camera on and write its video and film strip."""
        recorder = Recorder(self._learner.encoder if player == "agent" and self._learner else None)
        summary = next(self._envs.play(player, self._agent(player), [seed], camera=True, watch=recorder))
        write_video(recorder.frames, video)
        write_film_strip(recorder.frames, film_strip)
        return summary

    def save(self, folder: Path, values: Mapping[str, Any], *, with_replay: bool, best: bool = False) -> int:
        """Write a checkpoint, and replay beside it."""
        learner = self._trained()
        learner.settle()
        self._limiter.set_updates(learner.updates)
        own = {"limiter": self._limiter.save(), "rollout": self._loop.save(), "noise": self._policy.save_noise()}
        checkpoint = learner.checkpoint(own | dict(values))
        store = CheckpointStore(folder, self._config.checkpoint.keep)
        if best:
            return store.write_best(checkpoint)
        size = store.write(checkpoint, learner.updates)
        self._recovery.use(folder)
        if with_replay:
            write_snapshot(folder / "replay", self._store.view())
        return size

    def close(self) -> None:
        """Release the simulators."""
        self._envs.close()

    def _build_replay(self, learner: Learner) -> ShardedReplay:
        config, schema = self._config, learner.schema()
        shards = [build_shard(ReplayShard, config, schema, index) for index in range(config.replay.num_shards)]
        return ShardedReplay(shards, role_seed(config.seed, Role.REPLAY))

    def _agent(self, player: Player) -> AgentPolicy | None:
        """The trained agent, deterministic, where it is to play."""
        if player != "agent":
            return None
        learner = self._trained()
        seed = role_seed(self._config.seed, Role.EVALUATION)
        return AgentPolicy(learner.encoder, learner.rl.actor, seed, deterministic=True)

    def _use_threads(self, *, all_cores: bool) -> None:
        """Threads of torch: all cores for the backbone's large products, half of them for the small ones of SAC.

        More would be slower there: threads that wait for each other spin.
        """
        cores = int(usable_cores())
        torch.set_num_threads(self._config.runtime.learner_threads or max(1, cores if all_cores else cores // 2))

    def _trained(self) -> Learner:
        assert self._learner is not None, "begin_training comes first"
        return self._learner

    def _report(self, metrics: Mapping[str, float], episodes: list[TrainingEpisode], settled: bool) -> TrainReport:
        place = {"env_steps": self._limiter.env_steps, "updates": self._trained().updates}
        return TrainReport(**place, metrics=metrics, episodes=tuple(episodes), settled=settled)
