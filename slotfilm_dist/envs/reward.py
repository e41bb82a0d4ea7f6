"""PickBanana's reward (Section 4.5) as a pure function of the scene, batched over environments.

It is computed in two steps, `RewardInputs` from the scene and the reward from those, so that data that were collected
once serve every reward config: what is stored with a step are the inputs.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from slotfilm_dist.config import RewardConfig, SuccessConfig
from slotfilm_dist.envs.scene import SceneState

ARM_JOINTS = 7
"""Joints before the two fingers in `qpos` and `qvel`."""
TERMS = ("reach", "grasp", "place", "post_grasp", "static")
"""Names of the reward's components; an environment that has these tells the inputs of its reward."""
NUM_INPUTS = 12
"""Numbers that `RewardInputs` are packed into, for each environment."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Progress:
    """How far the task has come."""

    object_to_tcp_m: Float[Tensor, " envs"]
    object_to_goal_m: Float[Tensor, " envs"]
    placed: Bool[Tensor, " envs"]
    """The object is within `reward.delta_m` of the goal."""
    static: Bool[Tensor, " envs"]
    """No arm joint is faster than `success.static_threshold`."""
    success: Bool[Tensor, " envs"]


@dataclass(frozen=True, kw_only=True, slots=True)
class RewardInputs:
    """All of an instant that the reward follows from, whatever its config."""

    object_to_tcp_m: Float[Tensor, " envs"]
    object_to_goal_m: Float[Tensor, " envs"]
    grasped: Float[Tensor, " envs"]
    """1 while grasped, else 0."""
    qvel: Float[Tensor, "envs 9"]
    """Joint velocities in rad/s, fingers in m/s."""

    def packed(self) -> Float[Tensor, "envs 12"]:
        """The fields side by side, in their order."""
        columns = (self.object_to_tcp_m, self.object_to_goal_m, self.grasped)
        return torch.cat((torch.stack(columns, dim=-1), self.qvel), dim=-1)

    @classmethod
    def unpacked(cls, packed: Float[Tensor, "envs inputs"]) -> "RewardInputs":
        """What `packed` gave, bit for bit; raises ``ValueError`` if it is not so many numbers."""
        if packed.shape[-1] != NUM_INPUTS:
            raise ValueError(f"reward_inputs: {packed.shape[-1]} numbers a step, expected {NUM_INPUTS}; collect again")
        to_tcp, to_goal, grasped = packed[:, :3].T.contiguous()
        return cls(object_to_tcp_m=to_tcp, object_to_goal_m=to_goal, grasped=grasped, qvel=packed[:, 3:])


@dataclass(frozen=True, kw_only=True, slots=True)
class RewardTerms:
    """The reward's components, weighted and normalised: they add up to the reward."""

    reach: Float[Tensor, " envs"]
    grasp: Float[Tensor, " envs"]
    place: Float[Tensor, " envs"]
    post_grasp: Float[Tensor, " envs"]
    static: Float[Tensor, " envs"]

    def total(self) -> Float[Tensor, " envs"]:
        """The step's reward."""
        return self.reach + self.grasp + self.place + self.post_grasp + self.static


def progress(scene: SceneState, reward: RewardConfig, success: SuccessConfig) -> Progress:
    """Distances and the success condition (Section 5.2: the banana is within the target region)."""
    position = scene.object_poses[:, 0, :3]
    to_goal = torch.linalg.vector_norm(position - scene.goal, dim=-1)
    placed = to_goal <= reward.delta_m
    static = scene.qvel[:, :ARM_JOINTS].abs().amax(dim=-1) <= success.static_threshold
    solved = placed & static if success.require_static else placed
    if success.require_release:
        solved = solved & ~scene.grasped
    return Progress(
        object_to_tcp_m=torch.linalg.vector_norm(position - scene.tcp_pose[:, :3], dim=-1),
        object_to_goal_m=to_goal,
        placed=placed,
        static=static,
        success=solved,
    )


def shaped(distance_m: Float[Tensor, " envs"], config: RewardConfig) -> Float[Tensor, " envs"]:
    """Reaching and placing share this form: exp(-alpha d) beyond delta, the near form within (Section 4.5)."""
    far = torch.exp(-config.alpha * distance_m)
    if config.near_form == "exp_only":
        return far
    if config.near_form == "bounded":
        near = 1.0 / (1.0 + distance_m + config.eps)
    else:
        near = (1.0 / (distance_m + config.eps)).clamp(max=config.near_cap)
    return torch.where(distance_m > config.delta_m, far, near)


def reward_inputs(scene: SceneState, now: Progress) -> RewardInputs:
    """What the reward of this instant follows from."""
    return RewardInputs(
        object_to_tcp_m=now.object_to_tcp_m,
        object_to_goal_m=now.object_to_goal_m,
        grasped=scene.grasped.to(scene.qvel.dtype),
        qvel=scene.qvel,
    )


def reward_terms(now: RewardInputs, config: RewardConfig) -> RewardTerms:
    """The five components of Section 4.5, gated as the text says: placing while grasped, stillness once placed."""
    grasped = now.grasped
    place = shaped(now.object_to_goal_m, config)
    if config.place_gate == "grasp":
        place = place * grasped
    if config.pg_form == "one_minus_exp":
        transport = 1.0 - torch.exp(-config.alpha * now.object_to_goal_m)
    elif config.pg_form == "exp":
        transport = torch.exp(-now.object_to_goal_m)
    else:
        transport = torch.exp(-config.alpha * now.object_to_goal_m)
    velocity = now.qvel[:, :ARM_JOINTS] if config.static_joints == "arm" else now.qvel
    speed = torch.linalg.vector_norm(velocity, ord=2 if config.static_norm == "l2" else float("inf"), dim=-1)
    weights = config.weights
    scale = 1.0 / config.divisor
    return RewardTerms(
        reach=shaped(now.object_to_tcp_m, config) * (weights.reach * scale),
        grasp=grasped * (weights.grasp * scale),
        place=place * (weights.place * scale),
        post_grasp=transport * grasped * (weights.post_grasp * scale),
        static=(1.0 - torch.tanh(config.varpi * speed))
        * (now.object_to_goal_m <= config.delta_m)
        * (weights.static * scale),
    )


def rewards_of(inputs: Float32[np.ndarray, "rows inputs"], config: RewardConfig) -> Float32[np.ndarray, " rows"]:
    """The rewards that the environment would have given with this config, from `RewardInputs` as they were packed.

    On the same kind of device they are equal bit for bit: torch computes a row of a batch as it computes it alone.

    Raises:
        ValueError: the rows do not hold so many numbers.
    """
    return reward_terms(RewardInputs.unpacked(torch.from_numpy(np.array(inputs))), config).total().numpy()


def num_reward_inputs(term_names: tuple[str, ...]) -> int:
    """Numbers stored with a step in an environment whose reward has these components; 0 if it is not this reward."""
    return NUM_INPUTS if term_names == TERMS else 0
