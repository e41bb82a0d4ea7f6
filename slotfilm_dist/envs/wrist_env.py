"""A ManiSkill task as the agent meets it: wrist picture, state vector and labels in, actions out.

The one place where simulator values become `Observation`s and `StepResult`s.
"""

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import mani_skill.envs  # noqa: F401  registers ManiSkill's tasks
import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

import slotfilm_dist.envs.pick_banana  # noqa: F401  registers PickBanana-v1
from slotfilm_dist.config import RunConfig
from slotfilm_dist.envs.projection import project
from slotfilm_dist.envs.reward import TERMS
from slotfilm_dist.envs.scene import SceneReader, SceneState
from slotfilm_dist.envs.tasks import task_named
from slotfilm_dist.messages import Observation, StepResult

NEAR_SCALE_M = 0.05
"""Distance over which `object_to_goal_near` tells positions apart: twice the radius of the target."""


class WristEnv:
    """One task in one process (or many on a GPU), resetting itself in the step that ends an episode.

    Args:
        config: the run; `env`, `obs`, `reward` and `success` matter here.
        camera: render the wrist camera; without it no Vulkan driver is needed and the labels are zero.
        num_envs: environments stepped together; more than one needs `env.sim_backend = gpu`.

    Raises:
        ValueError: the task does not fit the config, or assets are missing.
    """

    def __init__(self, config: RunConfig, *, camera: bool, num_envs: int = 1) -> None:
        self._task = task_named(config.env.task)
        self._config = config
        self.num_envs = num_envs
        own = self._task.own_reward
        kwargs: dict[str, Any] = {"control_mode": config.env.control_mode}
        if own:
            kwargs |= {"task_config": config.env, "reward_config": config.reward, "success_config": config.success}
        backend = "none"
        self._make_camera: Callable[[], Any] = lambda: None
        if camera:
            from slotfilm_dist.envs.camera import WristCamera, render_device

            kwargs |= {"sensor_configs": WristCamera.sensor_configs(config.env)}
            backend = render_device(config.env.render_backend)
            self._make_camera = lambda: WristCamera(self._env, config.env)
        try:
            self._env: Any = gym.make(
                self._task.env_id,
                num_envs=num_envs,
                obs_mode="none",
                reward_mode="dense" if own else "normalized_dense",
                robot_uids=self._task.robot,
                sim_backend="physx_cuda" if config.env.sim_backend == "gpu" else "physx_cpu",
                render_backend=backend,
                **kwargs,
            ).unwrapped
        except AssertionError as error:
            if "supported modes" not in str(error):
                raise
            raise ValueError(f"env.control_mode = {config.env.control_mode!r}: {error}") from None
        except RuntimeError as error:
            raise ValueError(_cannot_build(config, str(error), camera=camera)) from error
        actions = self._env.single_action_space
        if not (np.all(actions.low == -1) and np.all(actions.high == 1)):
            raise ValueError(
                f"env.control_mode = {config.env.control_mode!r}: its actions are absolute and not in [-1, 1], as a "
                "policy's are; take pd_ee_delta_pose, pd_ee_delta_pos or pd_joint_delta_pos"
            )
        self.action_dim = int(actions.shape[0])
        self.reward_term_names: tuple[str, ...] = TERMS if own else ("reward",)
        self._attach()
        self._elapsed = np.zeros(num_envs, np.int64)
        self.episode_steps = config.env.max_steps
        """Steps after which an episode is truncated."""
        self.fresh_episodes = False
        """Build the simulator anew also where `step` resets it."""

    @property
    def has_camera(self) -> bool:
        """Whether pictures are rendered."""
        return self._camera is not None

    @property
    def base_env(self) -> Any:
        """ManiSkill's environment, for scripted policies and tests."""
        return self._env

    def scene(self) -> SceneState:
        """The simulator's state now."""
        return self._env.scene_state() if self._task.own_reward else self._reader.read()

    def reset(self, seeds: Sequence[int]) -> Observation:
        """Start an episode in every environment; the same seed gives the same episode, bit for bit.

        On the CPU the simulator is built anew for that (half a second), unless nothing has moved in it yet: PhysX keeps
        an order of contacts that depends on what went before and changes the last digits. The automatic reset within
        `step` does without: there the same seed gives the same start.
        """
        if len(seeds) != self.num_envs:
            raise ValueError(f"seeds: got {len(seeds)} for {self.num_envs} environments")
        self._env.reset(seed=list(seeds) if self.num_envs > 1 else int(seeds[0]), options={"reconfigure": self._moved})
        if self._moved:
            self._attach()
        self._elapsed[:] = 0
        return self._observe()

    def step(self, action: Float32[np.ndarray, "envs action"], next_seeds: Sequence[int]) -> StepResult:
        """Execute one control step of actions in [-1, 1]; an ended episode is followed by the one of its next seed."""
        self._moved = not self._env.gpu_sim_enabled
        _, reward, terminated, _, info = self._env.step(torch.from_numpy(action))
        self._elapsed += 1
        success = _array(info["success"], bool)
        ended = _array(terminated, bool) if self._config.env.terminate_on_success else np.zeros(self.num_envs, bool)
        truncated = (self._elapsed >= self.episode_steps) & ~ended
        final = self._observe()
        scene = self.scene()
        result = {
            "final": final,
            "reward": _array(reward, np.float32),
            "terminated": ended,
            "truncated": truncated,
            "success": success,
            "placed": _array(info[self._task.placed], bool),
            "grasped": _array(scene.grasped, bool),
            "contact": _array(scene.contact, bool),
            "reward_terms": self._terms(reward, info),
            "reward_inputs": _array(info["reward_inputs"], np.float32) if self._task.own_reward else None,
        }
        over = ended | truncated
        observation = self._restart(over, next_seeds) if over.any() else final
        return StepResult(observation=observation, **result)

    def close(self) -> None:
        """Release the simulator."""
        self._env.close()

    def _attach(self) -> None:
        """Take hold of the simulator's objects after they were built."""
        self._moved = False
        self._camera = self._make_camera()
        self._reader = SceneReader(self._env, self._task.objects, self._task.goal)

    def _terms(self, reward: Tensor, info: dict[str, Tensor]) -> Float32[np.ndarray, "envs terms"]:
        if not self._task.own_reward:
            return _array(reward, np.float32)[:, None]
        return _array(torch.stack([info[f"reward_{name}"] for name in TERMS], dim=-1), np.float32)

    def _restart(self, over: np.ndarray, next_seeds: Sequence[int]) -> Observation:
        indices = np.flatnonzero(over)
        if self.fresh_episodes and len(indices) == self.num_envs:
            return self.reset(next_seeds)
        self._env.reset(
            seed=[int(next_seeds[i]) for i in indices.tolist()],
            options={"env_idx": torch.as_tensor(indices, device=self._env.device)},
        )
        self._elapsed[indices] = 0
        return self._observe()

    def _observe(self) -> Observation:
        scene = self.scene()
        proprio = torch.cat([self._field(scene, name) for name in self._config.obs.state_fields], dim=-1)
        num_objects = len(self._task.objects)
        if self._camera is None:
            return Observation(
                rgb=None,
                proprio=_array(proprio, np.float32),
                uv=np.zeros((self.num_envs, num_objects, 2), np.float32),
                visible=np.zeros((self.num_envs, num_objects), bool),
                goal=np.zeros((self.num_envs, 3), np.float32),
            )
        points = torch.cat((scene.object_poses[..., :3], scene.goal[:, None]), dim=1)
        uv, visible = project(points, self._camera.pose(), self._camera.tan_half_fov, self._config.env.near_m)
        rgb = self._camera.capture()
        if self._config.env.occlusion:
            visible[:, :num_objects] &= self._camera.unoccluded(self._task.objects)
        goal_in_view = visible[:, num_objects:] & bool(self._task.goal)
        return Observation(
            rgb=rgb,
            proprio=_array(proprio, np.float32),
            uv=_array(uv[:, :num_objects], np.float32),
            visible=_array(visible[:, :num_objects], bool),
            goal=_array(torch.cat((uv[:, num_objects], goal_in_view), dim=-1), np.float32),
        )

    def _field(self, scene: SceneState, name: str) -> Float[Tensor, "envs field"]:
        position = scene.object_poses[:, 0, :3]
        tcp = scene.tcp_pose[:, :3]
        match name:
            case "qpos" | "qvel" | "tcp_pose" | "tcp_twist" | "goal":
                return getattr(scene, name)
            case "is_grasped":
                return scene.grasped[:, None].float()
            case "object_poses":
                return scene.object_poses.flatten(1)
            case "object_pose":
                return scene.object_poses[:, 0]
            case "tcp_to_goal":
                return scene.goal - tcp
            case "tcp_to_object":
                return position - tcp
            case "object_to_goal":
                return scene.goal - position
            case "object_to_goal_near":
                return torch.tanh((scene.goal - position) / NEAR_SCALE_M)
            case _:
                raise ValueError(f"obs.state_fields: {name!r} is not known to the simulator")


def _cannot_build(config: RunConfig, reason: str, *, camera: bool) -> str:
    """What a user can do about a simulator that does not start."""
    if config.env.sim_backend == "gpu":
        return f"env.sim_backend = 'gpu': {reason}; use env.sim_backend = 'cpu', or see `slotfilm doctor`"
    if camera:
        return (
            f"env.render_backend = {config.env.render_backend!r}: the simulator cannot render ({reason}); "
            "`slotfilm doctor` says what is missing, `bash ops/setup_vulkan.sh` installs a software driver"
        )
    return f"env.task = {config.env.task!r}: the simulator does not start ({reason})"


def _array(value: Tensor, dtype: Any) -> np.ndarray:
    return value.cpu().numpy().astype(dtype, copy=False)
