"""What the roles ask of each other. The loop that uses them:

observation = env.reset(seeds)
while True:
    step = env.step(policy.act(observation))      # VectorEnv
    store.insert(block)                           # ReplayStore
    snapshot = weights.latest(version)            # WeightSource
    batches = store.sample(num_batches, size)
    sink.write(step, values)                      # MetricSink
"""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from slotfilm_dist.messages import Observation, SampleBatch, StepResult, TransitionBlock, WeightSnapshot


@runtime_checkable
class VectorEnv(Protocol):
    """Environments stepped together that reset themselves in the step that ends an episode."""

    num_envs: int
    action_dim: int
    reward_term_names: tuple[str, ...]

    def reset(self, seeds: Sequence[int]) -> Observation:
        """Start an episode in every environment; the same seed gives the same episode."""
        ...

    def step(self, action: Float32[np.ndarray, "envs action"], next_seeds: Sequence[int]) -> StepResult:
        """Execute one control step of actions in [-1, 1]; an ended episode is followed by the one of its next seed."""
        ...

    def close(self) -> None:
        """Release the simulator."""
        ...


@runtime_checkable
class AdjustableEnv(Protocol):
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


@runtime_checkable
class ReplayStore(Protocol):
    """Where transitions wait for the learner."""

    def insert(self, block: TransitionBlock) -> bool:
        """Store a block; False if it had been stored before."""
        ...

    def sample(self, num_batches: int, batch_size: int) -> list[SampleBatch]:
        """Draw batches uniformly over all stored steps; raises ``ValueError`` when nothing is stored."""
        ...

    def num_steps(self) -> int:
        """Steps stored now."""
        ...


@runtime_checkable
class WeightSource(Protocol):
    """Where a worker gets its policy."""

    def latest(self, newer_than: int) -> WeightSnapshot | None:
        """The newest weights, or None while there are none newer than the given version."""
        ...


@runtime_checkable
class MetricSink(Protocol):
    """Where numbers go."""

    def write(self, values: Mapping[str, float]) -> None:
        """Record values by metric name."""
        ...


@runtime_checkable
class Saveable(Protocol):
    """Anything with state: loading what was saved continues as if nothing had happened."""

    def save(self) -> dict[str, Any]:
        """The state as nested dicts of arrays and scalars."""
        ...

    def load(self, state: Mapping[str, Any]) -> None:
        """Take over a saved state; raises ``ValueError`` if it does not fit."""
        ...
