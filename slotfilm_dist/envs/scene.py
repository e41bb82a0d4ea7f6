"""Reads what the task needs from the simulator, once a control step.

On the CPU SAPIEN's own objects are read directly: there ManiSkill's batched properties cost several milliseconds a
step. On a GPU the batched properties are the fast way, and the same tensors come out.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

MIN_CONTACT_FORCE_N = 0.5
"""Force from which a finger counts as touching (ManiSkill's `min_force`)."""
MAX_GRASP_ANGLE_DEG = 85.0
"""Largest angle between a finger's force and its closing direction in a grasp (ManiSkill's `max_angle` of PickCube)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneState:
    """The simulator's state as the task sees it; poses are (x, y, z, qw, qx, qy, qz) in metres and the world frame."""

    qpos: Float[Tensor, "envs 9"]
    """Joint positions in rad, fingers in m."""
    qvel: Float[Tensor, "envs 9"]
    """Joint velocities in rad/s, fingers in m/s."""
    tcp_pose: Float[Tensor, "envs 7"]
    """Tool centre point between the finger tips."""
    tcp_twist: Float[Tensor, "envs 6"]
    """Linear (m/s) then angular (rad/s) velocity of the tool centre point."""
    object_poses: Float[Tensor, "envs objects 7"]
    """Tracked objects, in the task's order; the first one is to be grasped."""
    goal: Float[Tensor, "envs 3"]
    """Target point; zeros where the task has none."""
    grasped: Bool[Tensor, " envs"]
    """Both fingers press on the first object, each within 85 degrees of its closing direction."""
    contact: Bool[Tensor, " envs"]
    """Any finger presses on the first object with at least 0.5 N."""


class SceneReader:
    """Reads a `SceneState` from a ManiSkill environment with one Panda robot.

    Args:
        env: the unwrapped ManiSkill environment; the reader must be rebuilt when it is reconfigured.
        objects: names of the environment's attributes that hold the tracked actors.
        goal: name of the attribute that holds the goal's actor; empty for none.
    """

    def __init__(self, env: Any, objects: tuple[str, ...], goal: str) -> None:
        self._env = env
        self._actors = [getattr(env, name) for name in objects]
        self._goal = getattr(env, goal) if goal else None
        self._on_gpu = bool(env.gpu_sim_enabled)
        if not self._on_gpu:
            agent = env.agent
            self._robot = agent.robot._objs[0]
            self._tcp = agent.tcp._objs[0]
            self._fingers = (agent.finger1_link._objs[0], agent.finger2_link._objs[0])
            self._entities = [actor._objs[0] for actor in self._actors]
            self._physx = env.scene.px

    def read(self) -> SceneState:
        """The state now."""
        return self._read_gpu() if self._on_gpu else self._read_cpu()

    def _read_cpu(self) -> SceneState:
        pose = self._tcp.entity_pose
        objects = np.empty((1, len(self._entities), 7), np.float32)
        for i, entity in enumerate(self._entities):
            object_pose = entity.pose
            objects[0, i, :3] = object_pose.p
            objects[0, i, 3:] = object_pose.q
        grasped, contact = self._grasp_cpu()
        goal = np.zeros(3, np.float32) if self._goal is None else self._goal._objs[0].pose.p
        return SceneState(
            qpos=torch.from_numpy(self._robot.qpos[None]),
            qvel=torch.from_numpy(self._robot.qvel[None]),
            tcp_pose=torch.from_numpy(np.concatenate((pose.p, pose.q))[None]),
            tcp_twist=torch.from_numpy(np.concatenate((self._tcp.linear_velocity, self._tcp.angular_velocity))[None]),
            object_poses=torch.from_numpy(objects),
            goal=torch.from_numpy(np.asarray(goal, np.float32)[None]),
            grasped=torch.tensor([grasped]),
            contact=torch.tensor([contact]),
        )

    def _grasp_cpu(self) -> tuple[bool, bool]:
        """Whether the first object is grasped, and whether any finger touches it."""
        if not self._has_moved():
            return False, False
        target = self._entities[0]
        left, right = (finger.entity for finger in self._fingers)
        impulses = {left: np.zeros(3), right: np.zeros(3)}
        touched = False
        for contact in self._physx.get_contacts():
            first, second = (body.entity for body in contact.bodies)
            if first == target:
                finger, sign = second, -1.0
            elif second == target:
                finger, sign = first, 1.0
            else:
                continue
            if finger in (left, right):
                touched = True
                impulses[finger] += sign * np.sum([point.impulse for point in contact.points], axis=0)
        if not touched:
            return False, False
        min_cosine = np.cos(np.deg2rad(MAX_GRASP_ANGLE_DEG))
        pressing, closing = [], []
        for finger, direction in zip(self._fingers, (1.0, -1.0), strict=True):
            force = impulses[finger.entity] / self._physx.timestep
            size = float(np.linalg.norm(force))
            axis = direction * finger.entity_pose.to_transformation_matrix()[:3, 1]
            pressing.append(size >= MIN_CONTACT_FORCE_N)
            closing.append(size > 0 and float(force @ axis) / size >= min_cosine)
        return all(pressing) and all(closing), any(pressing)

    def _read_gpu(self) -> SceneState:
        env, agent = self._env, self._env.agent
        target = self._actors[0]
        forces = [
            env.scene.get_pairwise_contact_forces(finger, target) for finger in (agent.finger1_link, agent.finger2_link)
        ]
        pressing = [torch.linalg.norm(force, dim=-1) >= MIN_CONTACT_FORCE_N for force in forces]
        zeros = torch.zeros(env.num_envs, 3, device=env.device)
        moved = env.elapsed_steps > 0
        return SceneState(
            qpos=agent.robot.get_qpos(),
            qvel=agent.robot.get_qvel(),
            tcp_pose=agent.tcp.pose.raw_pose,
            tcp_twist=torch.cat((agent.tcp.linear_velocity, agent.tcp.angular_velocity), dim=-1),
            object_poses=torch.stack([actor.pose.raw_pose for actor in self._actors], dim=1),
            goal=zeros if self._goal is None else self._goal.pose.p,
            grasped=agent.is_grasping(target, max_angle=MAX_GRASP_ANGLE_DEG) & moved,
            contact=(pressing[0] | pressing[1]) & moved,
        )

    def _has_moved(self) -> bool:
        """Whether a step was simulated since the reset; until then PhysX still holds the last episode's contacts."""
        return int(self._env.elapsed_steps[0]) > 0
