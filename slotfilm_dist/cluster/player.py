"""Plays evaluation episodes, apart from training. Plain, without Ray."""

from pathlib import Path

from slotfilm_dist.backend import Player
from slotfilm_dist.cluster.messages import AgentSetup
from slotfilm_dist.cluster.worker import EnvFactory, build_policy
from slotfilm_dist.config import RunConfig
from slotfilm_dist.contracts import VectorEnv
from slotfilm_dist.evaluation.rollouts import Recorder, play_episodes
from slotfilm_dist.evaluation.video import write_film_strip, write_video
from slotfilm_dist.messages import EpisodeSummary, WeightSnapshot
from slotfilm_dist.policy import AgentPolicy, Policy, RandomPolicy
from slotfilm_dist.seeds import Role, role_seed


class PlayerRole:
    """Plays whole episodes in an environment of its own.

    Args:
        config: the run.
        make_env: builds the environment.
    """

    def __init__(self, config: RunConfig, make_env: EnvFactory) -> None:
        self._config = config
        self._make_env = make_env
        self._env: VectorEnv | None = None
        self._camera = False
        self._policy: Policy | None = None

    def prepare(
        self, player: Player, *, camera: bool, setup: AgentSetup | None, snapshot: WeightSnapshot | None
    ) -> None:
        """Build the environment, with a camera from its first need on, and who acts.

        Raises:
            ValueError: the scripted expert does not know this environment.
        """
        if self._env is None or (camera and not self._camera):
            if self._env is not None:
                self._env.close()
            self._env, self._camera = self._make_env(self._config, camera), camera
        self._policy = self._build(player, self._env, setup, snapshot)

    def play(self, seed: int) -> EpisodeSummary:
        """One episode."""
        env, policy = self._prepared()
        if isinstance(policy, RandomPolicy):
            # Actions that follow from the episode's seed alone, however many players share the episodes.
            policy = RandomPolicy(env.action_dim, role_seed(self._config.seed, Role.EVALUATION, seed))
        return next(play_episodes(env, policy, [seed]))

    def record(self, seed: int, video: Path, film_strip: Path) -> EpisodeSummary:
        """One episode, with its video and film strip."""
        env, policy = self._prepared()
        encoder = policy.encoder if isinstance(policy, AgentPolicy) else None
        recorder = Recorder(encoder)
        summary = next(play_episodes(env, policy, [seed], recorder))
        write_video(recorder.frames, video)
        write_film_strip(recorder.frames, film_strip)
        return summary

    def _build(
        self, player: Player, env: VectorEnv, setup: AgentSetup | None, snapshot: WeightSnapshot | None
    ) -> Policy:
        seed = role_seed(self._config.seed, Role.EVALUATION)
        if player == "random":
            return RandomPolicy(env.action_dim, seed)
        if player == "expert":
            from slotfilm_dist.envs.expert import ExpertPolicy
            from slotfilm_dist.envs.wrist_env import WristEnv

            if not isinstance(env, WristEnv):
                raise ValueError("the scripted expert plays in the simulator only")
            return ExpertPolicy(env)
        assert setup is not None, "begin_training comes first"
        assert snapshot is not None, "begin_training comes first"
        policy = build_policy(self._config, setup, seed, deterministic=True)
        policy.load(snapshot.version, snapshot.arrays)
        return policy

    def _prepared(self) -> tuple[VectorEnv, Policy]:
        assert self._env is not None, "prepare comes first"
        assert self._policy is not None, "prepare comes first"
        return self._env, self._policy
