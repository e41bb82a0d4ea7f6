"""The environments of a run in one process: one to train in, one to play in, each built at its first need."""

from collections.abc import Callable, Iterator, Sequence

from slotfilm_dist.backend import EvaluationFailedError, Player, RunFailedError
from slotfilm_dist.config import RunConfig
from slotfilm_dist.contracts import AdjustableEnv
from slotfilm_dist.envs.expert import ExpertPolicy
from slotfilm_dist.envs.wrist_env import WristEnv
from slotfilm_dist.evaluation.rollouts import Watch, play_episodes
from slotfilm_dist.messages import EpisodeSummary
from slotfilm_dist.policy import Policy, RandomPolicy
from slotfilm_dist.rejection import BrokenEnvironmentError
from slotfilm_dist.seeds import Role, role_seed

MAX_BROKEN = 5
"""Environments given up in one start of a run before it stops."""


def make_wrist_env(config: RunConfig, camera: bool) -> AdjustableEnv:
    """The simulator."""
    return WristEnv(config, camera=camera)


class LocalEnvs:
    """Builds, replaces and closes them.

    Args:
        config: the run.
        make_env: builds an environment, with a camera or without.
    """

    def __init__(self, config: RunConfig, make_env: Callable[[RunConfig, bool], AdjustableEnv]) -> None:
        self._config, self._make_env = config, make_env
        self._training: AdjustableEnv | None = None
        self._playing: AdjustableEnv | None = None
        self.num_broken = 0

    @property
    def any(self) -> AdjustableEnv:
        """Whichever is there, to ask for its sizes."""
        return self._playing or self.training

    @property
    def training(self) -> AdjustableEnv:
        """The environment that training collects in."""
        if self._training is None:
            self._training = self._make_env(self._config, self._config.encoder.uses_image)
            self._training.fresh_episodes = self._config.runtime.exact_resume
        return self._training

    def replace_broken(self, error: BrokenEnvironmentError) -> None:
        """Close the training environment, so that the next need builds another.

        Raises:
            RunFailedError: `MAX_BROKEN` of them were given up.
        """
        self.num_broken += 1
        if self.num_broken >= MAX_BROKEN:
            raise RunFailedError(
                f"{self.num_broken} environments were given up, last: {error}; "
                "`slotfilm doctor` checks what they need, then go on with --resume"
            ) from error
        if self._training is not None:
            self._training.close()
            self._training = None

    def play(
        self, player: Player, agent: Policy | None, seeds: Sequence[int], *, camera: bool, watch: Watch | None = None
    ) -> Iterator[EpisodeSummary]:
        """Play episodes in an environment of their own, so that training's is not disturbed.

        Args:
            player: who acts.
            agent: the policy of the player `agent`.
            seeds: one episode each.
            camera: give pictures.
            watch: told of every step.

        Raises:
            EvaluationFailedError: that environment is broken; the next episodes get a new one.
        """
        if self._playing is None or (camera and not self._playing.has_camera):
            if self._playing is not None:
                self._playing.close()
            self._playing = self._make_env(self._config, camera)
        try:
            yield from play_episodes(self._playing, self._policy(player, agent, self._playing), seeds, watch)
        except BrokenEnvironmentError as error:
            self._playing.close()
            self._playing = None
            raise EvaluationFailedError(f"{error}; `slotfilm doctor` checks what the simulator needs") from error

    def close(self) -> None:
        """Release the simulators."""
        for env in (self._training, self._playing):
            if env is not None:
                env.close()

    def _policy(self, player: Player, agent: Policy | None, env: AdjustableEnv) -> Policy:
        if player == "random":
            return RandomPolicy(env.action_dim, role_seed(self._config.seed, Role.EVALUATION))
        if player == "expert":
            if not isinstance(env, WristEnv):
                raise ValueError("the scripted expert plays in the simulator only")
            return ExpertPolicy(env)
        assert agent is not None, "begin_training comes first"
        return agent
