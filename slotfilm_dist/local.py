"""Every role of a run in one process, without Ray: the same seed gives the same numbers.

    RolloutLoop --block--> ShardedReplay --batch--> Learner
         ^                                            |
         '------------- shares its networks ----------'

One loop takes turns: collect a block, make the updates that the limiter owes for it. A stop waits for the end of the
running episode, where the simulator's state follows from a seed, so that a resumed run continues exactly.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from slotfilm_dist.backend import Player, TrainReport
from slotfilm_dist.config import RunConfig
from slotfilm_dist.envs.expert import ExpertPolicy
from slotfilm_dist.envs.wrist_env import WristEnv
from slotfilm_dist.evaluation.rollouts import Recorder, Watch, play_episodes
from slotfilm_dist.evaluation.video import write_film_strip, write_video
from slotfilm_dist.learning.checkpoint import CheckpointStore, read_checkpoint, write_checkpoint
from slotfilm_dist.learning.learner import Learner, dataset_hash, learning_hash
from slotfilm_dist.machine import usable_cores, usable_memory_bytes
from slotfilm_dist.messages import EpisodeSummary, TransitionBlock
from slotfilm_dist.policy import AgentPolicy, Policy, RandomPolicy
from slotfilm_dist.replay.dataset import open_dataset
from slotfilm_dist.replay.limiter import RateLimiter
from slotfilm_dist.replay.memory import check_memory
from slotfilm_dist.replay.shard import ReplayShard
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


def learner_device(config: RunConfig) -> torch.device:
    """Where the learner computes; raises ``ValueError`` if a GPU is asked for and there is none."""
    wanted = config.runtime.device
    if wanted == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if wanted == "cuda" and not torch.cuda.is_available():
        raise ValueError("runtime.device = 'cuda': torch finds no CUDA GPU here; use --runtime.device cpu or auto")
    return torch.device(wanted)


class LocalBackend:
    """Implements `Backend` in one process.

    Args:
        config: the run.
    """

    def __init__(self, config: RunConfig) -> None:
        self._config = config
        self._device = learner_device(config)
        self._use_threads(all_cores=False)
        self._training_env: WristEnv | None = None
        self._playing_env: WristEnv | None = None
        self._learner: Learner | None = None

    def prepare(self) -> None:
        """Find out now whether memory suffices and simulator, renderer, assets and initial weights are there.

        Raises:
            ValueError: something is missing; says what and how to mend it.
        """
        check_memory(self._config, usable_memory_bytes())
        self._env  # noqa: B018  built here
        if self._config.encoder.uses_image and self._config.encoder.backbone != "random":
            Learner(self._config, self.action_dim, torch.device("cpu"))

    @property
    def action_dim(self) -> int:
        """Size of the action."""
        return self._any_env.action_dim

    @property
    def reward_term_names(self) -> tuple[str, ...]:
        """Names of the reward's components."""
        return self._any_env.reward_term_names

    def random_blocks(self, num_steps: int, start: int) -> Iterator[TransitionBlock]:
        """Blocks of the random policy; a collection continued at step `start` has random streams of its own."""
        seed = self._config.seed
        policy = RandomPolicy(self.action_dim, role_seed(seed, Role.RANDOM_ACTIONS, incarnation=start))
        loop = RolloutLoop(
            self._env, policy, role_seed(seed, Role.RANDOM_EPISODES, incarnation=start), incarnation=start
        )
        self._env.episode_steps = self._config.schedule.random_episode_steps or self._config.env.max_steps
        done = 0
        while done < num_steps:
            block = loop.collect(min(self._config.runtime.block_steps, num_steps - done))
            done += block.num_steps
            yield block
        self._env.episode_steps = self._config.env.max_steps

    def pretrain(self, dataset: Path, artifact: Path) -> Iterator[dict[str, float]]:
        """Pre-train and write the result, continuing what an interrupted pre-training left."""
        self._use_threads(all_cores=True)
        learner = self._learner = Learner(self._config, self.action_dim, self._device)
        learner.begin_pretraining(open_dataset(dataset, dataset_hash(self._config), verify=False))
        unfinished = artifact.with_name(artifact.name + ".unfinished")
        if unfinished.exists():
            learner.load_pretrain_state(read_checkpoint(unfinished, learner.pretrain_state().config_hash))
        saved_at = time.monotonic()
        while learner.pretrain_steps < self._config.pretrain.steps:
            yield learner.pretrain(PRETRAIN_CHUNK)
            if time.monotonic() - saved_at > PRETRAIN_SAVE_S:
                write_checkpoint(unfinished, learner.pretrain_state())
                saved_at = time.monotonic()
        write_checkpoint(artifact, learner.pretrain_state())
        self._use_threads(all_cores=False)

    def begin_training(self, dataset: Path, pretrained: Path | None, resume_from: Path | None) -> dict[str, Any]:
        """Build learner, replay, limiter and rollouts; give back the checkpoint's values."""
        config = self._config
        found = (
            CheckpointStore(resume_from, config.checkpoint.keep).read_last(learning_hash(config))
            if resume_from
            else None
        )
        learner = self._learner = Learner(
            config, self.action_dim, self._device, fetch_weights=not (pretrained or found)
        )
        data = open_dataset(dataset, dataset_hash(config), verify=False)
        if pretrained is not None:
            learner.load_pretrained(read_checkpoint(pretrained))
        learner.begin_rl(data)
        values: dict[str, Any] = {}
        if found is not None:
            checkpoint, _ = found
            learner.load_checkpoint(checkpoint)
            values = checkpoint.values
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
            slack_steps=4 * config.runtime.block_steps + config.sac.batch_size,
        )
        self._limiter.try_insert(data.num_steps)
        self._limiter.start_learning(data.num_steps)
        self._policy = AgentPolicy(learner.encoder, learner.rl.actor, role_seed(config.seed, Role.ACTIONS))
        self._loop = RolloutLoop(self._env, self._policy, role_seed(config.seed, Role.EPISODES))
        if values:
            self._limiter.load(values["limiter"])
            if "rollout" in values:  # a checkpoint written on a cluster has neither: its workers draw anew
                self._loop.load(values["rollout"])
                self._policy.load_noise(values["noise"])
        return values

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

    def train(self, should_stop: Callable[[], bool]) -> Iterator[TrainReport]:
        """Collect and update in turn until the schedule's end; a stop takes effect where an episode ends."""
        config, learner, limiter = self._config, self._trained(), self._limiter
        episodes: list[tuple[EpisodeSummary, int]] = []
        reported = time.monotonic()
        began_steps, began_updates = limiter.env_steps, learner.updates
        while limiter.env_steps < config.schedule.total_steps:
            left = config.schedule.total_steps - limiter.env_steps
            block = self._loop.collect(min(config.runtime.block_steps, left))
            self._store.insert(block)
            limiter.try_insert(block.num_steps)
            episodes += [(episode, block.policy_version) for episode in block.episodes]
            for _ in range(limiter.updates_owed()):
                learner.update(self._store.sample(1, config.sac.batch_size)[0])
                limiter.try_update(1)
            self._policy.version = learner.updates
            now = time.monotonic()
            if now - reported >= REPORT_S:
                elapsed = now - reported
                metrics = learner.metrics() | {
                    "worker_env_steps_per_s": (limiter.env_steps - began_steps) / elapsed,
                    "learner_updates_per_s": (learner.updates - began_updates) / elapsed,
                    "replay_stored_steps": self._store.num_steps(),
                    "limiter_ratio": limiter.ratio,
                }
                yield self._report(metrics, episodes)
                episodes = []
                reported, began_steps, began_updates = time.monotonic(), limiter.env_steps, learner.updates
            if self._loop.at_episode_start and should_stop():
                break
        yield self._report(learner.metrics(), episodes)

    def play(self, player: Player, seeds: Sequence[int]) -> Iterator[EpisodeSummary]:
        """Play episodes in an environment of their own."""
        camera = player == "agent" and self._config.encoder.uses_image
        yield from self._play(player, seeds, camera=camera)

    def record(self, player: Player, seed: int, video: Path, film_strip: Path) -> EpisodeSummary:
        """Play one episode with the camera on and write its video and film strip."""
        recorder = Recorder(self._learner.encoder if player == "agent" and self._learner else None)
        summary = next(self._play(player, [seed], camera=True, watch=recorder))
        write_video(recorder.frames, video)
        write_film_strip(recorder.frames, film_strip)
        return summary

    def save(self, folder: Path, values: Mapping[str, Any], *, with_replay: bool, best: bool = False) -> int:
        """Write a checkpoint, and replay beside it."""
        learner = self._trained()
        own = {"limiter": self._limiter.save(), "rollout": self._loop.save(), "noise": self._policy.save_noise()}
        checkpoint = learner.checkpoint(own | dict(values))
        store = CheckpointStore(folder, self._config.checkpoint.keep)
        if best:
            return store.write_best(checkpoint)
        size = store.write(checkpoint, learner.updates)
        if with_replay:
            write_snapshot(folder / "replay", self._store.view())
        return size

    def close(self) -> None:
        """Release the simulators."""
        for env in (self._training_env, self._playing_env):
            if env is not None:
                env.close()

    def _build_replay(self, learner: Learner) -> ShardedReplay:
        config, schema = self._config, learner.schema()
        count = config.replay.num_shards
        shards = [
            ReplayShard(
                schema,
                -(-config.replay.capacity // count),
                role_seed(config.seed, Role.REPLAY, index + 1),
                index=index,
                num_shards=count,
                block_steps=config.runtime.block_steps,
                n_step=config.n_step,
                gamma=config.sac.gamma,
            )
            for index in range(count)
        ]
        return ShardedReplay(shards, role_seed(config.seed, Role.REPLAY))

    def _play(
        self, player: Player, seeds: Sequence[int], *, camera: bool, watch: Watch | None = None
    ) -> Iterator[EpisodeSummary]:
        env = self._evaluation_env(camera)
        yield from play_episodes(env, self._player(player, env), seeds, watch)

    @property
    def _env(self) -> WristEnv:
        """The environment that training collects in, built at the first need."""
        if self._training_env is None:
            self._training_env = WristEnv(self._config, camera=self._config.encoder.uses_image)
            self._training_env.fresh_episodes = self._config.runtime.exact_resume
        return self._training_env

    @property
    def _any_env(self) -> WristEnv:
        return self._playing_env or self._env

    def _evaluation_env(self, camera: bool) -> WristEnv:
        """An environment of its own, so that training's is not disturbed; with a camera from its first need on."""
        if self._playing_env is None or (camera and not self._playing_env.has_camera):
            if self._playing_env is not None:
                self._playing_env.close()
            self._playing_env = WristEnv(self._config, camera=camera)
        return self._playing_env

    def _player(self, player: Player, env: WristEnv) -> Policy:
        seed = role_seed(self._config.seed, Role.EVALUATION)
        if player == "random":
            return RandomPolicy(self.action_dim, seed)
        if player == "expert":
            return ExpertPolicy(env)
        learner = self._trained()
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

    def _report(self, metrics: Mapping[str, float], episodes: list[tuple[EpisodeSummary, int]]) -> TrainReport:
        return TrainReport(
            env_steps=self._limiter.env_steps,
            updates=self._trained().updates,
            metrics=metrics,
            episodes=tuple(episodes),
        )
