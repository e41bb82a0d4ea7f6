"""ManiSkill's PickCube-v1 as its documentation starts with it, in a process of its own, with random actions."""

# pyright: reportMissingImports=false
# Some of these packages are in the peers' environment only.

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from slotfilm_dist.bench.serving import serve
from slotfilm_dist.bench.timing import calls_per_s


def build(*, camera: bool, wrist_only: bool = False, image_size: int = 128) -> Mapping[str, Callable[..., float]]:
    """`measure`: environment steps a second.

    Args:
        camera: observe pictures, else the state.
        wrist_only: without the task's second camera, beside the one on the wrist.
        image_size: height and width of the pictures.
    """
    import gymnasium as gym
    import mani_skill.envs  # noqa: F401  registers the tasks
    import torch

    torch.set_num_threads(1)
    pictures: dict[str, Any] = {"sensor_configs": {"width": image_size, "height": image_size}} if camera else {}
    env: Any = gym.make(
        "PickCube-v1",
        robot_uids="panda_wristcam",
        obs_mode="rgb" if camera else "state",
        control_mode="pd_ee_delta_pose",
        sim_backend="physx_cpu",
        render_backend="cpu" if camera else "none",
        max_episode_steps=1_000_000,
        **pictures,
    )
    env.reset(seed=0)
    if wrist_only:
        env.unwrapped.scene.sensors.pop("base_camera")
    rng = np.random.default_rng(0)
    size = env.action_space.shape[-1]
    return {
        "measure": lambda num_steps: calls_per_s(
            lambda: env.step(rng.uniform(-1, 1, size).astype(np.float32)), num_steps
        )
    }


if __name__ == "__main__":
    serve(build)
