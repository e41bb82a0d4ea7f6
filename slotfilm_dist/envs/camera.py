"""The wrist camera (Table A4): captures pictures straight from SAPIEN, with the render profile applied."""

import math
import os
from typing import Any

import numpy as np
import sapien
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from slotfilm_dist.config import EnvConfig, check
from slotfilm_dist.envs.render_profile import apply_render_profile

# Software rendering of one small picture is fastest in the caller's own thread; Mesa reads this when it starts.
os.environ.setdefault("LP_NUM_THREADS", "0")

CAMERA = "hand_camera"
CAMERA_LINK = "camera_link"


def render_device(backend: str) -> str:
    """ManiSkill's name of the device that renders; `auto` is a GPU where torch finds one, else the CPU.

    Raises:
        ValueError: a GPU is asked for and there is none; ManiSkill would go on in software.
    """
    there = torch.cuda.is_available()
    check(backend != "gpu" or there, "env.render_backend", backend, "torch finds no GPU here; use cpu or auto")
    return ("gpu" if there else "cpu") if backend == "auto" else backend


class WristCamera:
    """The camera on the hand of one built environment.

    Args:
        env: unwrapped ManiSkill environment, made with `sensor_configs(config)`.
        config: camera and render profile.
    """

    def __init__(self, env: Any, config: EnvConfig) -> None:
        self._env = env
        self._sensor = env.scene.sensors[CAMERA]
        self.tan_half_fov = math.tan(math.radians(config.fov_deg) / 2)
        self._culling = apply_render_profile(env, config.render_profile)
        self._direct = not env.gpu_sim_enabled
        if self._direct:
            self._scene: sapien.Scene = env.scene.sub_scenes[0]
            self._camera = self._sensor.camera._render_cameras[0]
            self._link = env.agent.robot.links_map[CAMERA_LINK]._objs[0]

    @staticmethod
    def sensor_configs(config: EnvConfig) -> dict[str, Any]:
        """Settings for ManiSkill's `sensor_configs`."""
        return {
            "shader_pack": "minimal",
            CAMERA: {
                "width": config.image_size,
                "height": config.image_size,
                "fov": math.radians(config.fov_deg),
                "near": config.near_m,
                "far": config.far_m,
            },
        }

    def pose(self) -> Float[Tensor, "envs 7"]:
        """Position and quaternion of the camera, world frame, looking along x with z up."""
        if not self._direct:
            return self._env.agent.robot.links_map[CAMERA_LINK].pose.raw_pose
        pose = self._link.entity_pose
        return torch.from_numpy(np.concatenate((pose.p, pose.q))[None])

    def capture(self) -> UInt8[np.ndarray, "envs height width 3"]:
        """The picture now."""
        for actor in self._env._hidden_objects:
            actor.hide_visual()
        if not self._direct:
            self._env.scene.update_render(update_sensors=True, update_human_render_cameras=False)
            self._sensor.capture()
            return self._sensor.get_obs(rgb=True, depth=False, position=False, segmentation=False)["rgb"].cpu().numpy()
        self._culling.update()
        self._scene.update_render()
        self._camera.take_picture()
        picture = self._camera.get_picture("Color")
        if picture.dtype != np.uint8:
            picture = np.clip(picture * 255, 0, 255).astype(np.uint8)
        return np.ascontiguousarray(picture[None, ..., :3])

    def unoccluded(self, objects: tuple[str, ...]) -> Bool[Tensor, "envs objects"]:
        """Whether any pixel of each object can be seen in the last picture."""
        if not self._direct:
            segmentation = self._sensor.get_obs(rgb=False, depth=False, position=False, segmentation=True)
            labels = segmentation["segmentation"][..., 0]
        else:
            labels = torch.from_numpy(self._camera.get_picture("PositionSegmentation")[None, ..., 3].astype(np.int32))
        ids = [getattr(self._env, name).per_scene_id for name in objects]
        return torch.stack([(labels == i.view(-1, 1, 1)).flatten(1).any(dim=1) for i in ids], dim=1)
