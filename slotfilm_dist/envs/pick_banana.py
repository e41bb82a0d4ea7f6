"""PickBanana-v1: grasp the banana and hold it at a target point beside a bowl (Section 5, Table 1).

A ManiSkill task like any other: it is registered under its name, takes ManiSkill's keyword arguments, works with its
wrappers and vector environment, and is written batched, so that it also runs with ``sim_backend="gpu"``.
"""

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import sapien
import torch
from mani_skill import ASSET_DIR
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.building import actors
from mani_skill.utils.registration import register_env
from mani_skill.utils.scene_builder.table import TableSceneBuilder
from mani_skill.utils.structs.pose import Pose
from mani_skill.utils.structs.types import SimConfig
from transforms3d.euler import euler2quat

from slotfilm_dist.config import EnvConfig, RewardConfig, SuccessConfig
from slotfilm_dist.envs.meshes import object_files
from slotfilm_dist.envs.panda import SlotfilmPanda
from slotfilm_dist.envs.reward import Progress, RewardTerms, progress, reward_inputs, reward_terms
from slotfilm_dist.envs.reward_bounds import max_reward
from slotfilm_dist.envs.scene import SceneReader, SceneState

CONTROL_HZ = 20
SIM_HZ = 100
ROBOT_BASE_X_M = -0.615
START_QPOS = (0.0, 0.0, 0.0, -np.pi * 2 / 3, 0.0, np.pi * 2 / 3, np.pi / 4, 0.04, 0.04)
"""Arm above the table, gripper down and open, as in ManiSkill's PickSingleYCB."""
START_NOISE_RAD = 0.02
YCB_MODELS = {"banana": "011_banana", "bowl": "024_bowl"}

BANANA_X_M = (-0.10, 0.04)
BANANA_Y_M = (-0.08, 0.08)
BOWL_DISTANCE_M = (0.17, 0.22)
"""Distance of the bowl's centre from the banana's, to the robot's left or right."""
BOWL_BEARING_RAD = np.pi / 6
"""Largest turn of the bowl's bearing away from straight left or right."""
GOAL_OFFSET_M = 0.10
"""Horizontal distance of the target from the bowl's centre: beside the bowl, on the side of the table's middle."""
FIXED_GOAL_M = (0.0, 0.0, 0.15)
MESH_CACHE = Path.home() / ".cache" / "slotfilm" / "meshes"


@register_env("PickBanana-v1", max_episode_steps=400)
class PickBananaEnv(BaseEnv):
    """Pick a banana up and hold it still at a target point beside a bowl.

    Args:
        task_config: goal placement, assets and the wrist camera; the paper's by default.
        reward_config: the reward's form and weights.
        success_config: when the task is solved.
        mesh_cache: folder for the generated meshes.
    """

    SUPPORTED_ROBOTS = ["panda_wristcam_direct", "panda_wristcam"]  # noqa: RUF012  declared by the base class
    SUPPORTED_REWARD_MODES: ClassVar[list[str]] = ["dense", "normalized_dense", "sparse", "none"]
    agent: SlotfilmPanda  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(
        self,
        *args: Any,
        robot_uids: str = SlotfilmPanda.uid,
        task_config: EnvConfig | None = None,
        reward_config: RewardConfig | None = None,
        success_config: SuccessConfig | None = None,
        mesh_cache: Path = MESH_CACHE,
        **kwargs: Any,
    ) -> None:
        self.task_config = task_config or EnvConfig()
        self.reward_config = reward_config or RewardConfig()
        self.success_config = success_config or SuccessConfig()
        self._mesh_cache = mesh_cache
        self._state: SceneState | None = None
        kwargs.setdefault("control_mode", self.task_config.control_mode)
        super().__init__(*args, robot_uids=robot_uids, **kwargs)

    @property
    def _default_sim_config(self) -> SimConfig:
        return SimConfig(sim_freq=SIM_HZ, control_freq=CONTROL_HZ)

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        pose = sapien_utils.look_at([0.55, 0.55, 0.5], [-0.05, 0.0, 0.1])
        return CameraConfig("render_camera", pose, 512, 512, 1, 0.01, 100)

    def _load_agent(self, options: dict) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        super()._load_agent(options, sapien.Pose(p=[ROBOT_BASE_X_M, 0, 0]))

    def _load_scene(self, options: dict) -> None:
        self.table_scene = TableSceneBuilder(env=self)
        self.table_scene.build()
        self.banana, self._banana_z = self._build_object("banana", sapien.Pose(p=[0, 0, 0.1]))
        self.bowl, self._bowl_z = self._build_object("bowl", sapien.Pose(p=[0, 0.2, 0.1]))
        self.goal_site = actors.build_sphere(
            self.scene,
            radius=self.reward_config.delta_m,
            color=[0, 1, 0, 1],
            name="goal_site",
            body_type="kinematic",
            add_collision=False,
            initial_pose=sapien.Pose(),
        )
        if not self.task_config.goal_visible:
            self._hidden_objects.append(self.goal_site)

    def _build_object(self, kind: str, pose: sapien.Pose) -> tuple[Any, float]:
        """The actor and the height of its origin when it rests on the table."""
        if self.task_config.assets == "ycb":
            return self._build_ycb(kind, pose)
        files = object_files(kind, self._mesh_cache)  # type: ignore[arg-type]  # the two kinds are literals here
        builder = self.scene.create_actor_builder()
        material = sapien.physx.PhysxMaterial(files.static_friction, files.dynamic_friction, 0.0)
        for path in files.collisions:
            builder.add_convex_collision_from_file(str(path), material=material, density=files.density_kg_m3)
        builder.add_visual_from_file(str(files.visual))
        builder.set_initial_pose(pose)
        return builder.build(name=kind), files.rest_height_m

    def _build_ycb(self, kind: str, pose: sapien.Pose) -> tuple[Any, float]:
        model = YCB_MODELS[kind]
        if not (ASSET_DIR / "assets/mani_skill2_ycb/models" / model).exists():
            raise ValueError(
                f"env.assets = 'ycb': {model} is not installed; "
                "run `python -m mani_skill.utils.download_asset ycb`, or use env.assets = 'procedural'"
            )
        builder = actors.get_actor_builder(self.scene, id=f"ycb:{model}")
        builder.set_initial_pose(pose)
        actor = builder.build(name=kind)
        mesh = actor.get_first_collision_mesh()
        assert mesh is not None, "YCB models have collision meshes"
        return actor, float(-mesh.bounding_box.bounds[0, 2])

    def _after_reconfigure(self, options: dict) -> None:
        self.reader = SceneReader(self, ("banana", "bowl"), "goal_site")

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            count = len(env_idx)
            self._state = None
            self.table_scene.table.set_pose(
                sapien.Pose(p=[-0.12, 0, -self.table_scene.table_height], q=euler2quat(0, 0, np.pi / 2).tolist())
            )
            banana, bowl, goal = self._draw_layout(count)
            self.banana.set_pose(Pose.create_from_pq(p=banana, q=_yaw(_uniform(count, -np.pi, np.pi))))
            self.bowl.set_pose(Pose.create_from_pq(p=bowl, q=_yaw(_uniform(count, -np.pi, np.pi))))
            self.goal_site.set_pose(Pose.create_from_pq(p=goal))
            qpos = torch.tensor(START_QPOS, dtype=torch.float32).repeat(count, 1)
            qpos[:, :7] += torch.randn(count, 7) * START_NOISE_RAD
            self.agent.reset(qpos)
            self.agent.robot.set_pose(sapien.Pose([ROBOT_BASE_X_M, 0, 0]))

    def _draw_layout(self, count: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Positions [count, 3] of banana, bowl and goal."""
        banana = torch.stack(
            (_uniform(count, *BANANA_X_M), _uniform(count, *BANANA_Y_M), torch.full((count,), self._banana_z)), dim=-1
        )
        side = torch.where(torch.rand(count) < 0.5, -1.0, 1.0)
        bearing = side * (np.pi / 2 + _uniform(count, -BOWL_BEARING_RAD, BOWL_BEARING_RAD))
        distance = _uniform(count, *BOWL_DISTANCE_M)
        bowl = banana.clone()
        bowl[:, 0] += distance * torch.cos(bearing)
        bowl[:, 1] += distance * torch.sin(bearing)
        bowl[:, 2] = self._bowl_z
        height = _uniform(count, *self.task_config.goal_height_m)
        toward_middle = torch.atan2(-bowl[:, 1], -0.05 - bowl[:, 0]) + _uniform(count, -np.pi / 3, np.pi / 3)
        goal = torch.stack(
            (
                bowl[:, 0] + GOAL_OFFSET_M * torch.cos(toward_middle),
                bowl[:, 1] + GOAL_OFFSET_M * torch.sin(toward_middle),
                height,
            ),
            dim=-1,
        )
        if self.task_config.goal == "fixed":
            goal = torch.tensor(FIXED_GOAL_M).repeat(count, 1)
        elif self.task_config.goal == "random":
            goal = torch.stack(
                (_uniform(count, -0.1, 0.1), _uniform(count, -0.1, 0.1), _uniform(count, 0.02, 0.3)), dim=-1
            )
        return banana, bowl, goal

    def _after_control_step(self) -> None:
        self._state = None

    def set_state_dict(self, *arguments: Any, **keywords: Any) -> Any:
        """ManiSkill's; also what a reset to given states calls."""
        self._state = None
        return super().set_state_dict(*arguments, **keywords)

    def scene_state(self) -> SceneState:
        """The simulator's state after the last control step, read once."""
        if self._state is None:
            self._state = self.reader.read()
        return self._state

    def evaluate(self) -> dict[str, torch.Tensor]:
        """Success, placed, grasped, contact, the reward's components and its inputs at this instant."""
        scene = self.scene_state()
        now = progress(scene, self.reward_config, self.success_config)
        inputs = reward_inputs(scene, now)
        self._terms: RewardTerms = reward_terms(inputs, self.reward_config)
        return {
            "success": now.success,
            "is_placed": now.placed,
            "is_static": now.static,
            "is_grasped": scene.grasped,
            "contact": scene.contact,
            "reward_inputs": inputs.packed(),
            **self._term_info(now),
        }

    def _term_info(self, now: Progress) -> dict[str, torch.Tensor]:
        terms = self._terms
        return {
            "reward_reach": terms.reach,
            "reward_grasp": terms.grasp,
            "reward_place": terms.place,
            "reward_post_grasp": terms.post_grasp,
            "reward_static": terms.static,
            "object_to_tcp_m": now.object_to_tcp_m,
            "object_to_goal_m": now.object_to_goal_m,
        }

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        scene = self.scene_state()
        extra = {
            "tcp_pose": scene.tcp_pose,
            "tcp_twist": scene.tcp_twist,
            "goal": scene.goal,
            "is_grasped": scene.grasped.float(),
        }
        if "state" in self.obs_mode:
            extra |= {"banana_pose": scene.object_poses[:, 0], "bowl_pose": scene.object_poses[:, 1]}
        return extra

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """The paper's reward of this instant, [envs]."""
        return self._terms.total()

    def compute_normalized_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """The reward divided by its upper bound, [envs]."""
        return self._terms.total() / max_reward(self.reward_config)

    def step(self, action: Any) -> tuple[Any, torch.Tensor, torch.Tensor, torch.Tensor, dict]:
        """One control step; success ends the episode only if `terminate_on_success` is set."""
        obs, reward, terminated, truncated, info = super().step(action)
        if not self.task_config.terminate_on_success:
            terminated = torch.zeros_like(terminated)
        return obs, reward, terminated, truncated, info


def _uniform(count: int, low: float, high: float) -> torch.Tensor:
    return torch.rand(count) * (high - low) + low


def _yaw(angle: torch.Tensor) -> torch.Tensor:
    zero = torch.zeros_like(angle)
    return torch.stack((torch.cos(angle / 2), zero, zero, torch.sin(angle / 2)), dim=-1)
