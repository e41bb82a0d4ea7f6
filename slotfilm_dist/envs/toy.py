"""An environment without a simulator, for tests of the system around it: a point to be moved to a goal."""

import time
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

from slotfilm_dist.config import RunConfig
from slotfilm_dist.messages import Observation, StepResult

ACTION_DIM = 7
STEP_LENGTH = 0.1
"""Distance that a full action moves the point."""
SLOW_STEP_S = 0.02
"""Time that a step of `SlowToyEnv` takes, at least."""
REACHED = 0.1
"""Distance to the goal that counts as solved."""


class ToyEnv:
    """Points in a cube of side 2, each with a goal; implements `VectorEnv`.

    The state vector begins with the point and the goal; the rest of it are fixed functions of the two. The picture's
    colours follow the point. The reward is 1 - distance / 4. The same seed gives the same episode.

    Args:
        config: the run; `obs.state_dim`, `obs.num_objects`, `env.max_steps` and `env.image_size` matter here.
        camera: give pictures and labels.
        num_envs: points moved together.
    """

    action_dim = ACTION_DIM
    reward_term_names: tuple[str, ...] = ("reach",)

    def __init__(self, config: RunConfig, *, camera: bool, num_envs: int = 1) -> None:
        self.num_envs = num_envs
        self.has_camera = camera
        """Whether it gives pictures."""
        self.episode_steps = config.env.max_steps
        """Steps after which an episode is truncated."""
        self.fresh_episodes = False
        """Without a meaning here: every episode follows from its seed alone."""
        self._config = config
        self._point = np.zeros((num_envs, 3), np.float32)
        self._goal = np.zeros((num_envs, 3), np.float32)
        self._elapsed = np.zeros(num_envs, np.int64)
        frequencies = np.arange(config.obs.state_dim, dtype=np.float32)
        self._mixture = np.sin(frequencies[None] * np.arange(1, 7, dtype=np.float32)[:, None])

    def reset(self, seeds: Sequence[int]) -> Observation:
        """Start an episode in every environment; the same seed gives the same episode."""
        if len(seeds) != self.num_envs:
            raise ValueError(f"seeds: got {len(seeds)} for {self.num_envs} environments")
        for i, seed in enumerate(seeds):
            self._restart(i, seed)
        return self._observe()

    def step(self, action: Float32[np.ndarray, "envs action"], next_seeds: Sequence[int]) -> StepResult:
        """Move the points by the first three components of the action."""
        self._point = np.clip(self._point + STEP_LENGTH * action[:, :3], -1, 1).astype(np.float32)
        self._elapsed += 1
        distance = np.linalg.norm(self._goal - self._point, axis=1)
        reward = (1 - distance / 4).astype(np.float32)
        success = distance < REACHED
        terminated = success & self._config.env.terminate_on_success
        truncated = (self._elapsed >= self.episode_steps) & ~terminated
        final = self._observe()
        for i in np.flatnonzero(terminated | truncated).tolist():
            self._restart(i, next_seeds[i])
        return StepResult(
            observation=self._observe(),
            final=final,
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            success=success,
            placed=success,
            grasped=success,
            contact=success,
            reward_terms=reward[:, None],
        )

    def close(self) -> None:
        """Nothing to release."""

    def _restart(self, i: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self._point[i], self._goal[i] = rng.uniform(-1, 1, (2, 3)).astype(np.float32)
        self._elapsed[i] = 0

    def _observe(self) -> Observation:
        count, objects = self.num_envs, self._config.obs.num_objects
        proprio = (np.concatenate((self._point, self._goal), axis=1) @ self._mixture).astype(np.float32)
        uv = np.zeros((count, objects, 2), np.float32)
        goal = np.zeros((count, 3), np.float32)
        rgb = None
        if self.has_camera:
            size = self._config.env.image_size
            colours = 1 + ((self._point + 1) * 127).astype(np.uint8)  # never all black, which counts as a failure
            rgb = np.broadcast_to(colours[:, None, None], (count, size, size, 3)).copy()
            uv[:] = (self._goal[:, None, :2] + 1) / 2
        return Observation(
            rgb=rgb, proprio=proprio, uv=uv, visible=np.full((count, objects), self.has_camera), goal=goal
        )


def make_toy_env(config: RunConfig, camera: bool) -> ToyEnv:
    """The toy environment as `RayBackend` asks for one."""
    return ToyEnv(config, camera=camera)


class SlowToyEnv(ToyEnv):
    """A toy environment whose step takes as long as a small simulator's."""

    def step(self, action: Float32[np.ndarray, "envs action"], next_seeds: Sequence[int]) -> StepResult:
        """Wait, then move the points."""
        time.sleep(SLOW_STEP_S)
        return super().step(action, next_seeds)


def make_slow_toy_env(config: RunConfig, camera: bool) -> SlowToyEnv:
    """The slow one as `RayBackend` asks for one."""
    return SlowToyEnv(config, camera=camera)
