"""A scripted policy that solves PickBanana through the agent's own actions: proof that the task can be solved.

It reads object poses from the simulator, which the agent never sees.
"""

from enum import Enum

import numpy as np
from jaxtyping import Float32, Float64, Shaped
from scipy.spatial.transform import Rotation

from slotfilm_dist.envs.wrist_env import WristEnv
from slotfilm_dist.messages import Observation

POSITION_STEP_M = 0.1
ROTATION_STEP_RAD = -0.1
"""What an action of 1 means; ManiSkill's controller turns rotations the other way round."""
HOVER_M = 0.09
"""Height above the object from which the gripper goes down."""
LIFT_M = 0.05
"""Height above the goal at which the object travels, clear of the bowl."""
CLOSE_STEPS = 8
POSITION_GAIN = 0.7
OPEN, CLOSED = 1.0, -1.0


class Phase(Enum):
    """What the expert is doing."""

    HOVER = "hover"
    DESCEND = "descend"
    CLOSE = "close"
    LIFT = "lift"
    CARRY = "carry"
    HOLD = "hold"


class ExpertPolicy:
    """Grasps the first object across its middle and holds it at the goal.

    Args:
        env: the single environment it acts in.
    """

    version = -1
    backbone_hash = ""

    def __init__(self, env: WristEnv) -> None:
        if env.num_envs != 1 or env.action_dim != 7:
            raise ValueError("the expert acts in one environment with the 7-D pd_ee_delta_pose controller")
        self._env = env
        self._begin()

    def _begin(self) -> None:
        self._phase = Phase.HOVER
        self._waited = 0
        self._last_elapsed = -1

    def visual(self, observation: Observation) -> Shaped[np.ndarray, "envs *visual"]:
        """Nothing: the expert does not look."""
        return np.empty((len(observation.proprio), 0), np.uint8)

    def act(
        self, observation: Observation, visual: Shaped[np.ndarray, "envs *visual"]
    ) -> Float32[np.ndarray, "envs action"]:
        """The next action, from the simulator's state."""
        elapsed = int(self._env.base_env.elapsed_steps[0])
        if elapsed <= self._last_elapsed:
            self._begin()
        self._last_elapsed = elapsed
        scene = self._env.scene()
        tcp = scene.tcp_pose[0].double().numpy()
        target = scene.object_poses[0, 0].double().numpy()
        goal = scene.goal[0].double().numpy()
        self._advance(tcp, target, goal, bool(scene.grasped[0]))
        position, gripper = self._aim(tcp, target, goal)
        error = (_grasp_rotation(tcp, target) * _rotation(tcp).inv()).as_rotvec()
        move = POSITION_GAIN * (position - tcp[:3]) / POSITION_STEP_M
        turn = error / ROTATION_STEP_RAD
        turn /= max(1.0, float(np.linalg.norm(turn)))
        if self._phase in (Phase.LIFT, Phase.CARRY, Phase.HOLD):
            turn *= 0.0
        return np.concatenate((move.clip(-1, 1), turn, [gripper])).astype(np.float32)[None]

    def _aim(
        self, tcp: Float64[np.ndarray, "7"], target: Float64[np.ndarray, "7"], goal: Float64[np.ndarray, "3"]
    ) -> tuple[Float64[np.ndarray, "3"], float]:
        """Where the tool centre point should go, and the gripper's command."""
        up = np.array([0.0, 0.0, 1.0])
        held_at = goal + (tcp[:3] - target[:3])
        match self._phase:
            case Phase.HOVER:
                return target[:3] + HOVER_M * up, OPEN
            case Phase.DESCEND:
                return target[:3], OPEN
            case Phase.CLOSE:
                return target[:3], CLOSED
            case Phase.LIFT:
                return np.append(tcp[:2], held_at[2] + LIFT_M), CLOSED
            case Phase.CARRY:
                return held_at + LIFT_M * up, CLOSED
            case Phase.HOLD:
                return held_at, CLOSED

    def _advance(
        self,
        tcp: Float64[np.ndarray, "7"],
        target: Float64[np.ndarray, "7"],
        goal: Float64[np.ndarray, "3"],
        grasped: bool,
    ) -> None:
        aligned = (_grasp_rotation(tcp, target) * _rotation(tcp).inv()).magnitude() < 0.06
        offset = tcp[:3] - target[:3]
        across = float(np.linalg.norm(target[:2] - goal[:2]))
        match self._phase:
            case Phase.HOVER if aligned and np.linalg.norm(offset[:2]) < 0.01 and offset[2] < HOVER_M + 0.02:
                self._enter(Phase.DESCEND)
            case Phase.DESCEND if np.linalg.norm(offset) < 0.008:
                self._enter(Phase.CLOSE)
            case Phase.CLOSE if self._waited >= CLOSE_STEPS:
                self._enter(Phase.LIFT if grasped else Phase.HOVER)
            case Phase.LIFT if target[2] > goal[2] + 0.6 * LIFT_M:
                self._enter(Phase.CARRY)
            case Phase.CARRY if across < 0.012:
                self._enter(Phase.HOLD)
            case Phase.LIFT | Phase.CARRY | Phase.HOLD if not grasped and np.linalg.norm(offset) > 0.06:
                self._enter(Phase.HOVER)
            case _:
                self._waited += 1

    def _enter(self, phase: Phase) -> None:
        self._phase = phase
        self._waited = 0


def _rotation(pose: Float64[np.ndarray, "7"]) -> Rotation:
    return Rotation.from_quat(pose[[4, 5, 6, 3]])


def _grasp_rotation(tcp: Float64[np.ndarray, "7"], target: Float64[np.ndarray, "7"]) -> Rotation:
    """Gripper straight down, closing across the object's x axis, with the smaller of the two possible turns."""
    body = _rotation(target).apply([1.0, 0.0, 0.0])
    closing = np.array([-body[1], body[0], 0.0])
    closing /= max(float(np.linalg.norm(closing)), 1e-9)
    if closing @ _rotation(tcp).apply([0.0, 1.0, 0.0]) < 0:
        closing = -closing
    down = np.array([0.0, 0.0, -1.0])
    return Rotation.from_matrix(np.stack((np.cross(closing, down), closing, down), axis=1))
