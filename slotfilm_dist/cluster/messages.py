"""What the roles on a cluster tell each other beside blocks, batches and weights."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float16, Float32, Shaped, UInt8

from slotfilm_dist.messages import EpisodeSummary
from slotfilm_dist.replay.schema import ReplaySchema
from slotfilm_dist.replay.shard import ShardStats


@dataclass(frozen=True, kw_only=True, slots=True)
class BlockKey:
    """Who made a block."""

    worker_id: int
    incarnation: int
    sequence: int


@dataclass(frozen=True, kw_only=True, slots=True)
class BlockNotice:
    """What a worker tells of a block before it sends it."""

    key: BlockKey
    num_steps: int
    policy_version: int
    episodes: tuple[EpisodeSummary, ...]
    """Episodes that ended within the block."""


@dataclass(frozen=True, kw_only=True, slots=True)
class StepGrant:
    """The hub's answer to a worker that wants to insert."""

    granted: bool
    """The block may be stored."""
    waited_s: float
    """Time spent waiting, in seconds."""
    waiting_for: str
    """What was still missing when time ran out; empty if granted."""
    finished: bool
    """The run has all its steps: stop collecting."""
    retry_s: float = 0.0
    """Time to let pass before asking again, because too many wait; 0 to ask, and wait, at once."""


@dataclass(frozen=True, kw_only=True, slots=True)
class UpdateGrant:
    """The hub's answer to the learner that wants to update."""

    num_updates: int
    """Updates that may be made now; they have been counted."""
    waited_s: float
    """Time spent waiting, in seconds."""
    waiting_for: str
    """What was still missing when time ran out; empty if anything was granted."""


@dataclass(frozen=True, kw_only=True, slots=True)
class HubStatus:
    """The counters of the run."""

    env_steps: int
    """Steps stored in replay, or collected before."""
    admitted_steps: int
    """The same and those on their way to a shard, for which updates are granted already."""
    updates: int
    """Updates granted."""
    updates_owed: int
    """Updates that the steps so far ask for and that are still to come."""
    ratio: float
    """Updates per environment step since learning began."""
    waiting_workers: int
    waiting_learner: bool
    waited_workers_s: float
    """Time that workers have waited, summed."""
    num_blocks: int
    """Blocks stored."""
    num_refunded_steps: int
    """Steps granted but lost with their worker before they were stored."""
    weights_version: int
    """Newest version, -1 before the first."""
    num_published: int
    weights_age_updates: float
    """Mean number of updates between the newest weights and those that the workers act with."""
    weights_age_s: float
    """Mean time since the weights that the workers act with were published."""
    steps_by_worker: dict[int, int]
    """Steps stored, by worker."""
    wanted_workers: int
    auto_workers: bool
    """The run itself decides how many workers are wanted."""
    alive_workers: int
    finished: bool
    """All steps of the run are stored."""


@dataclass(frozen=True, kw_only=True, slots=True)
class WorkerBeat:
    """What a worker says when it is asked how it does."""

    worker_id: int
    incarnation: int
    activity: str
    """What it does now; names what it waits for."""
    limit_s: float
    """How long that may take without progress before the worker counts as hung."""
    idle_s: float
    """Time since it last made progress."""
    num_steps: int
    """Steps that it has collected in this incarnation."""
    num_blocks: int
    """Blocks that it got rid of in this incarnation."""
    policy_version: int
    waited_s: float
    """Time spent waiting for the limiter and replay."""
    step_s: float
    """Mean time of one environment step in the last block, acting included."""
    weights_lags_s: tuple[float, ...] = ()
    """Times from a publication of weights until they acted here, since the last beat."""
    num_rejected: int = 0
    """Steps of this incarnation that were not finite or showed nothing, and were left out."""
    num_cut_episodes: int = 0
    """Episodes of this incarnation that ended with such a step."""
    memory_share: float = 0.0
    """Share of its machine's memory that is in use, by whomever."""
    error: str = ""
    """Why it stopped, in one line; empty while it runs."""
    error_reason: str = ""
    """The reason by the metric catalogue's words; empty while it runs."""
    running: bool = False
    """Its loop runs."""
    ended: bool = False
    """The loop of this incarnation has come to its end, because the run has its steps or for an error."""


@dataclass(frozen=True, kw_only=True, slots=True)
class InferenceRequest:
    """What a worker sees, to be acted on elsewhere."""

    worker_id: int
    rgb: UInt8[np.ndarray, "envs height width 3"] | None
    """Pictures; None without a camera, or where `visual` is sent instead."""
    visual: Shaped[np.ndarray, "envs *visual"] | None
    """What replay keeps of the pictures, where that is known already."""
    proprio: Float32[np.ndarray, "envs proprio"]
    goal: Float32[np.ndarray, "envs 3"]
    noise: Float32[np.ndarray, "envs action"]
    """Standard normal noise of the action, drawn by the worker."""


@dataclass(frozen=True, kw_only=True, slots=True)
class InferenceAnswer:
    """Tokens and actions for an `InferenceRequest`."""

    tokens: Float16[np.ndarray, "envs tokens dim"] | None
    """None where the agent keeps pictures or has none, or where the request brought tokens."""
    action: Float32[np.ndarray, "envs action"]
    policy_version: int
    backbone_hash: str


@dataclass(frozen=True, kw_only=True, slots=True)
class InferenceStatus:
    """What the inference process says when it is asked how it does."""

    policy_version: int
    """-1 before the first weights."""
    num_requests: int
    num_steps: int
    """Observations answered."""
    num_batches: int
    busy_s: float
    """Time spent computing."""
    weights_lags_s: tuple[float, ...]
    """Times from a publication of weights until they acted here, since the last status."""
    starts: str
    """Changes whenever the process is another one."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ShardBeat:
    """What a shard says when it is asked how it does."""

    stats: ShardStats
    starts: str
    """Changes whenever the shard's process is another one."""
    restored_steps: int
    """Steps taken from a snapshot when it started."""
    snapshot_error: str = ""
    """Why the last snapshot could not be written or read."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LearnerBeginning:
    """What a learner says when it is ready to train."""

    values: dict[str, Any]
    """Plain values of the checkpoint that it continues; empty for a fresh start."""
    problems: tuple[str, ...]
    """Newer checkpoints that could not be read, and why."""
    schema: ReplaySchema
    """How replay stores this agent's transitions."""
    random_steps: int
    """Steps of the random policy's data."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LearnerStatus:
    """What the learner says when it is asked how it does."""

    updates: int
    metrics: dict[str, float]
    """By the metric catalogue's names."""
    waiting_for: str
    """What it waits for now; empty while it updates."""
    error: str = ""
    """Why its loop stopped, in one line; empty while it runs."""


@dataclass(frozen=True, kw_only=True, slots=True)
class AgentSetup:
    """What a policy needs besides the newest weights: the whole encoder, backbone included."""

    action_dim: int
    encoder: dict[str, np.ndarray]
    """Parameters and buffers by name."""
