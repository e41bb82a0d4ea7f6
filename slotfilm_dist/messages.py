"""What crosses a process: frozen dataclasses of numpy arrays and scalars. They are read-only; copy to keep.

Axis names: *envs* environments of one worker, *rows* rows of a block (see `TransitionBlock`), *batch* sampled
transitions, *objects* objects whose positions supervise the slots, *proprio* the state vector.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Shaped, UInt8


@dataclass(frozen=True, kw_only=True, slots=True)
class Observation:
    """What a batch of environments observes at one instant, with the labels that supervise pre-training."""

    rgb: UInt8[np.ndarray, "envs height width 3"] | None
    """The wrist camera's picture; None where the agent has no camera."""
    proprio: Float32[np.ndarray, "envs proprio"]
    """The state vector, fields in the order of `obs.state_fields`."""
    uv: Float32[np.ndarray, "envs objects 2"]
    """Objects' projected centres in image units: (0, 0) is the top left corner, (1, 1) the bottom right one."""
    visible: Bool[np.ndarray, "envs objects"]
    """The object's centre lies in front of the camera and inside the picture."""
    goal: Float32[np.ndarray, "envs 3"]
    """The goal's projection u, v in image units and 1 if it is in view, else 0; zeros where a task has no goal."""


@dataclass(frozen=True, kw_only=True, slots=True)
class StepResult:
    """What one action led to, in environments that reset themselves in the same step."""

    observation: Observation
    """What to act on next: the first observation of a new episode where one has just ended."""
    final: Observation
    """What the action led to: the true next observation, also where the episode ended."""
    reward: Float32[np.ndarray, " envs"]
    """Unscaled reward."""
    terminated: Bool[np.ndarray, " envs"]
    """The task ended: no bootstrap."""
    truncated: Bool[np.ndarray, " envs"]
    """The clock ran out: bootstrap."""
    success: Bool[np.ndarray, " envs"]
    """The task is solved at this instant."""
    placed: Bool[np.ndarray, " envs"]
    """The object is within the target region."""
    grasped: Bool[np.ndarray, " envs"]
    """Both fingers press on the object."""
    contact: Bool[np.ndarray, " envs"]
    """Any finger touches the object with more than 0.5 N."""
    reward_terms: Float32[np.ndarray, "envs terms"]
    """The reward's weighted components, named by the environment's `reward_term_names`; they add up to the reward."""
    reward_inputs: Float32[np.ndarray, "envs inputs"] | None = None
    """What the reward was computed from, whatever its config; None where the environment brings its own reward."""


@dataclass(frozen=True, kw_only=True, slots=True)
class EpisodeSummary:
    """One finished episode."""

    seed: int
    """Seed it was reset with."""
    length: int
    """Steps taken."""
    episode_return: float
    """Undiscounted sum of the unscaled reward."""
    success_once: bool
    """Solved at some step."""
    success_at_end: bool
    """Solved at the last step."""
    placed_at_end: bool
    """The object was in the target region at the last step."""
    grasped_once: bool
    """Grasped at some step."""
    reward_terms: tuple[float, ...]
    """Sum of each reward component."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainingEpisode:
    """An episode that ended in a stored block."""

    summary: EpisodeSummary
    policy_version: int
    """Version of the weights that acted, of that block; -1 for the random policy."""
    env_steps: int
    """Environment steps of the run once that block was stored."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TransitionBlock:
    """Consecutive steps of one worker, oldest first. Built by RolloutLoop, stored by ReplayShard.

    Frames are stored once. Row i holds a frame and, where `is_step` is set, the step taken from it, whose next frame
    is row i + 1. A row without a step holds the true last frame of an episode or the frame that the following block
    starts with, so every step's next frame lies in its own block.
    """

    worker_id: int
    """Who collected it."""
    incarnation: int
    """How often that worker had been restarted."""
    sequence: int
    """Number of this block within the incarnation, from 0; with the two above it makes inserts idempotent."""
    policy_version: int
    """Version of the weights that acted first; newer ones may have taken over within the block. -1 for the random
    policy. The learner reports the age."""
    backbone_hash: str
    """Hash of the frozen backbone that made the tokens; empty where `visual` holds none."""
    visual: Shaped[np.ndarray, "rows *visual"]
    """Tokens float16 [rows, 64, 42], pictures uint8 [rows, height, width, 3], or [rows, 0] without a camera."""
    proprio: Float32[np.ndarray, "rows proprio"]
    goal: Float32[np.ndarray, "rows 3"]
    uv: Float32[np.ndarray, "rows objects 2"]
    visible: Bool[np.ndarray, "rows objects"]
    action: Float32[np.ndarray, "rows action"]
    """The action executed, in [-1, 1]."""
    reward: Float32[np.ndarray, " rows"]
    """Unscaled reward."""
    terminated: Bool[np.ndarray, " rows"]
    """The task ended: no bootstrap."""
    truncated: Bool[np.ndarray, " rows"]
    """The clock ran out: bootstrap."""
    is_step: Bool[np.ndarray, " rows"]
    """The row holds a step, not only a last frame."""
    reward_inputs: Float32[np.ndarray, "rows inputs"] | None = None
    """What the reward was computed from, if the environment tells; kept in shared data, not in replay."""
    episodes: tuple[EpisodeSummary, ...] = ()
    """Episodes that ended within the block."""

    @property
    def num_rows(self) -> int:
        """Frames held."""
        return len(self.reward)

    @property
    def num_steps(self) -> int:
        """Steps held."""
        return int(self.is_step.sum())


@dataclass(frozen=True, kw_only=True, slots=True)
class SampleBatch:
    """Transitions drawn uniformly from replay."""

    visual: Shaped[np.ndarray, "batch *visual"]
    proprio: Float32[np.ndarray, "batch proprio"]
    goal: Float32[np.ndarray, "batch 3"]
    action: Float32[np.ndarray, "batch action"]
    reward: Float32[np.ndarray, " batch"]
    """Unscaled reward; with n-step returns the discounted sum up to the next frame."""
    discount: Float32[np.ndarray, " batch"]
    """What the next frame's value counts: gamma to the number of steps that lie between."""
    terminated: Bool[np.ndarray, " batch"]
    """The task ended in the last of these steps."""
    truncated: Bool[np.ndarray, " batch"]
    """The clock ran out in the last of these steps."""
    next_visual: Shaped[np.ndarray, "batch *visual"]
    next_proprio: Float32[np.ndarray, "batch proprio"]
    next_goal: Float32[np.ndarray, "batch 3"]


@dataclass(frozen=True, kw_only=True, slots=True)
class WeightSnapshot:
    """What a worker needs to act: actor, fusion encoder and state statistics."""

    version: int
    """Updates behind these weights; grows without gaps being promised."""
    published_at_s: float
    """Wall clock at publication, in seconds since the epoch."""
    arrays: dict[str, np.ndarray]
    """Parameters and buffers by name."""
