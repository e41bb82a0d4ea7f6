"""The environments of a run in one process: one to train in, one to play in, each built at its first need."""

from collections.abc import Callable, Iterator, Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from slotfilm_dist.backend import Player, RunFailedError
from slotfilm_dist.config import RunConfig
from slotfilm_dist.envs.expert import ExpertPolicy
from slotfilm_dist.envs.wrist_env import WristEnv
from slotfilm_dist.evaluation.rollouts import Watch, play_episodes
from slotfilm_dist.messages import EpisodeSummary, Observation, StepResult
from slotfilm_dist.policy import Policy, RandomPolicy
from slotfilm_dist.rejection import BrokenEnvironmentError
from slotfilm_dist.seeds import Role, role_seed

MAX_BROKEN = 5
"""Environments given up in one start of a run before it stops."""


@runtime_checkable
class LocalEnv(Protocol):
    """A `VectorEnv` whose episodes can be shortened, or built anew each time."""

    num_envs: int
    action_dim: int
    reward_term_names: tuple[str, ...]

    @property
    def has_camera(self) -> bool:
        """Whether it gives pictures."""
        ...

    @property
    def episode_steps(self) -> int:
        """Steps after which an episode is truncated."""
        ...

    @episode_steps.setter
    def episode_steps(self, steps: int) -> None: ...

    @property
    def fresh_episodes(self) -> bool:
        """Whether the simulator is built anew for every episode."""
        ...

    @fresh_episodes.setter
    def fresh_episodes(self, fresh: bool) -> None: ...

    def reset(self, seeds: Sequence[int]) -> Observation:
        """Start an episode."""
        ...

    def step(self, action: Float32[np.ndarray, "envs action"], next_seeds: Sequence[int]) -> StepResult:
        """Execute one control step."""
        ...

    def close(self) -> None:
        """Release the simulator."""
        ...


def make_wrist_env(config: RunConfig, camera: bool) -> LocalEnv:
    """The simulator."""
    return WristEnv(config, camera=camera)


class LocalEnvs:
    """Builds, replaces and closes them.

    Args:
        config: the run.
        make_env: builds an environment, with a camera or without.
    """

    def __init__(self, config: RunConfig, make_env: Callable[[RunConfig, bool], LocalEnv]) -> None:
        self._config, self._make_env = config, make_env
        self._training: LocalEnv | None = None
        self._playing: LocalEnv | None = None
        self.num_broken = 0

    @property
    def any(self) -> LocalEnv:
        """Whichever is there, to ask for its sizes."""
        return self._playing or self.training

    @property
    def training(self) -> LocalEnv:
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
        """
        if self._playing is None or (camera and not self._playing.has_camera):
            if self._playing is not None:
                self._playing.close()
            self._playing = self._make_env(self._config, camera)
        yield from play_episodes(self._playing, self._policy(player, agent, self._playing), seeds, watch)

    def close(self) -> None:
        """Release the simulators."""
        for env in (self._training, self._playing):
            if env is not None:
                env.close()

    def _policy(self, player: Player, agent: Policy | None, env: LocalEnv) -> Policy:
        if player == "random":
            return RandomPolicy(env.action_dim, role_seed(self._config.seed, Role.EVALUATION))
        if player == "expert":
            if not isinstance(env, WristEnv):
                raise ValueError("the scripted expert plays in the simulator only")
            return ExpertPolicy(env)
        assert agent is not None, "begin_training comes first"
        return agent
