"""Collects held-out frames for measurements, or takes those that are there: the same ones for every variant."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from slotfilm_dist.commands.options import episode_seeds
from slotfilm_dist.commands.trained_agent import TrainedAgent, load_trained_agent
from slotfilm_dist.config import RunConfig
from slotfilm_dist.config_files import changed_fields, config_hash
from slotfilm_dist.evaluation.labelled_frames import (
    LabelledFrames,
    collect_frames,
    join_frames,
    load_frames,
    save_frames,
)
from slotfilm_dist.learning.learner import picture_identity
from slotfilm_dist.policy import AgentPolicy, Policy, RandomPolicy
from slotfilm_dist.progress import Progress
from slotfilm_dist.seeds import Role, role_seed


@dataclass(frozen=True, kw_only=True, slots=True)
class FrameRequest:
    """Which frames are wanted."""

    source: str
    """`random`, `expert`, `agent` or a run's directory."""
    first_seed: int
    episodes: int
    steps: int
    """Frames of an episode; 0 for whole episodes."""

    def __post_init__(self) -> None:
        if self.episodes < 1 or self.steps < 0:
            raise ValueError(f"--episodes {self.episodes} --steps {self.steps}: must be 1 or more, and 0 or more")
        episode_seeds(self.first_seed, self.episodes)

    @property
    def seeds(self) -> Sequence[int]:
        """One seed an episode."""
        return episode_seeds(self.first_seed, self.episodes)

    @property
    def label(self) -> str:
        """Name for a folder of results: the source, a run's by its directory's name."""
        return self.source if self.source in ("random", "expert", "agent") else f"agent-of-{Path(self.source).name}"


def heldout_frames(request: FrameRequest, agent: TrainedAgent, artifacts: Path, progress: Progress) -> LabelledFrames:
    """The frames, collected now unless a file of the artifacts has them.

    Args:
        request: which.
        agent: whose environment is used; it acts itself where the source is `agent`.
        artifacts: folder that runs share.
        progress: tells the user.

    Raises:
        ValueError: the simulator cannot render, or the source is no run.
    """
    config = agent.config
    actor = agent if request.source == "agent" else None
    if request.label.startswith("agent-of-"):
        actor = load_trained_agent(Path(request.source), "last", _device(agent), artifacts)
        _check_same_scene(config, actor.config, request.source)
    path = artifacts / frames_file(config, request, actor.weights if actor else request.source)
    if path.exists():
        progress.say(f"evaluate  held-out frames are there: {path}")
        return load_frames(path)
    frames = _collect(config, request, _num_steps(config, request), actor, progress)
    save_frames(frames, path)
    return frames


def _check_same_scene(config: RunConfig, other: RunConfig, source: str) -> None:
    """Raise ``ValueError`` if an agent cannot act in the environment of another run's config."""
    fields = changed_fields(replace(config.env, max_steps=other.env.max_steps), other.env, "env.")
    fields |= changed_fields(config.obs, other.obs, "obs.") if config.obs.state_fields != other.obs.state_fields else {}
    if fields:
        raise ValueError(f"--frames {source}: it was trained with another {', '.join(fields)}; take another run's")


def frames_file(config: RunConfig, request: FrameRequest, who: str) -> str:
    """Name of the file of such frames: all that they depend on, and nothing else.

    Args:
        config: of the environment.
        request: which frames.
        who: acts: the source, or the weights of the agent that it stands for.
    """
    steps = _num_steps(config, request)
    identity = {"who": who, "first_seed": request.first_seed, "episodes": request.episodes, "steps": steps}
    identity |= picture_identity(config)
    return f"frames-{config_hash(config.env, config.obs.state_fields, config.success, identity)}.npz"


def _num_steps(config: RunConfig, request: FrameRequest) -> int:
    return min(request.steps or config.env.max_steps, config.env.max_steps)


def _collect(
    config: RunConfig, request: FrameRequest, steps: int, actor: TrainedAgent | None, progress: Progress
) -> LabelledFrames:
    from slotfilm_dist.envs.wrist_env import WristEnv

    # Of the reward's settings only the target's radius can change a frame: variants of other rewards share frames.
    env = WristEnv(config, camera=True)
    try:
        policy = _policy(config, request.source, env, actor)
        progress.begin("evaluate", f"{request.episodes} x {steps} held-out frames, {request.label} acting")
        episodes = []
        for episode in collect_frames(env, policy, request.seeds, steps):
            episodes.append(episode)
            progress.show(len(episodes), request.episodes, {"frames": str(sum(len(e["step"]) for e in episodes))})
    finally:
        progress.end()
        env.close()
    return join_frames(episodes)


def _policy(config: RunConfig, source: str, env: object, actor: TrainedAgent | None) -> Policy:
    """Who acts."""
    from slotfilm_dist.envs.expert import ExpertPolicy
    from slotfilm_dist.envs.wrist_env import WristEnv

    assert isinstance(env, WristEnv)
    if source == "expert":
        return ExpertPolicy(env)
    if source == "random":
        return RandomPolicy(env.action_dim, role_seed(0, Role.EVALUATION))
    assert actor is not None
    return acting_policy(actor)


def acting_policy(agent: TrainedAgent) -> AgentPolicy:
    """The agent, acting deterministically; raises ``ValueError`` where only the pre-trained encoder was loaded."""
    if agent.actor is None:
        raise ValueError("--checkpoint pretrained has no policy: use --checkpoint last, or other frames")
    seed = role_seed(agent.config.seed, Role.EVALUATION)
    return AgentPolicy(agent.encoder, agent.actor, seed, deterministic=True)


def _device(agent: TrainedAgent) -> torch.device:
    return next(agent.encoder.buffers()).device
