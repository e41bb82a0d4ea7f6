"""The Panda with a wrist camera, with ManiSkill's end-effector controller taken short on the CPU.

ManiSkill computes the target pose and the inverse kinematics of one robot through some hundred small tensor operations,
2.2 ms a step. The same arithmetic on SAPIEN's own objects takes a tenth of that. Other controllers and the GPU go
through ManiSkill unchanged.
"""

import math
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.agents.registration import register_agent
from mani_skill.agents.robots.panda.panda_wristcam import PandaWristCam

FAST_CONTROL_MODE = "pd_ee_delta_pose"


def quaternion_from_euler_xyz(x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Quaternion (w, x, y, z) of the rotation Rx(x) Ry(y) Rz(z), angles in rad."""
    cx, sx, cy, sy, cz, sz = (f(a / 2) for a in (x, y, z) for f in (math.cos, math.sin))
    return (
        cx * cy * cz - sx * sy * sz,
        sx * cy * cz + cx * sy * sz,
        cx * sy * cz - sx * cy * sz,
        cx * cy * sz + sx * sy * cz,
    )


@register_agent()
class SlotfilmPanda(PandaWristCam):
    """`panda_wristcam` whose `pd_ee_delta_pose` controller is computed directly; the motion is the same."""

    uid = "panda_wristcam_direct"

    def set_action(self, action: torch.Tensor) -> None:
        """Command one control step; actions lie in [-1, 1], 3 translations, 3 rotations, 1 gripper."""
        if self.scene.gpu_sim_enabled or self.control_mode != FAST_CONTROL_MODE:
            super().set_action(action)
            return
        command = np.asarray(action, dtype=np.float64)[0]
        if not np.isfinite(command).all():
            raise ValueError(f"action = {command.tolist()}: must be finite")
        self._command_arm(command[:6])
        self._command_gripper(float(command[6]))

    def before_simulation_step(self) -> None:
        """The controllers of the direct path set their targets once a control step."""
        if self.scene.gpu_sim_enabled or self.control_mode != FAST_CONTROL_MODE:
            super().before_simulation_step()

    def _command_arm(self, command: np.ndarray) -> None:
        arm = self._part("arm")
        config, kinematics = arm.config, arm.kinematics
        low, high = config.pos_lower, config.pos_upper
        position = np.clip(command[:3], -1, 1) * (high - low) / 2 + (high + low) / 2
        rotation = command[3:]
        norm = float(np.linalg.norm(rotation))
        # ManiSkill scales rotations by the lower bound, which turns their sign; kept, so that actions mean the same.
        rotation = (rotation / norm if norm > 1 else rotation) * config.rot_lower
        robot = self.robot._objs[0]
        current = robot.root_pose.inv() * arm.ee_link._objs[0].entity_pose
        turn = sapien.Pose(q=quaternion_from_euler_xyz(*rotation.tolist()))
        target = sapien.Pose(p=current.p + position, q=(turn * sapien.Pose(q=current.q)).q)
        qpos, solved, _ = kinematics.pmodel.compute_inverse_kinematics(
            kinematics.end_link_idx, target, initial_qpos=robot.qpos, active_qmask=self._ik_mask, max_iterations=100
        )
        # Out of reach: stay where the arm is, as ManiSkill does.
        for joint, value in zip(self._arm_joints, qpos if solved else robot.qpos, strict=False):
            joint.set_drive_target(float(value))

    def _command_gripper(self, command: float) -> None:
        config = self._part("gripper").config
        low, high = config.lower, config.upper
        target = min(max(command, -1.0), 1.0) * (high - low) / 2 + (high + low) / 2
        for joint in self._finger_joints:
            joint.set_drive_target(target)

    def _after_init(self) -> None:
        super()._after_init()
        joints = {joint.name: joint._objs[0] for joint in self.robot.active_joints}
        self._arm_joints = [joints[name] for name in self.arm_joint_names]
        self._finger_joints = [joints[name] for name in self.gripper_joint_names]

    def _part(self, name: str) -> Any:
        """The controller of the arm or of the gripper, of the combined one that this control mode has."""
        combined: Any = self.controller
        return combined.controllers[name]

    @property
    def _ik_mask(self) -> np.ndarray:
        return self._part("arm").kinematics.qmask.numpy()
