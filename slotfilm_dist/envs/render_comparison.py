"""Whether the render profile `wrist` changes pictures, and how much faster it is than `full`."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import sapien
import torch
from jaxtyping import Int

from slotfilm_dist.envs.pick_banana import START_QPOS
from slotfilm_dist.envs.render_profile import HOUSING_LINK, WRIST_CAMERA, apply_render_profile

_POSE_SPREAD_RAD = np.array([0.6, 0.5, 0.6, 0.6, 0.8, 0.8, 1.0])
"""Standard deviation of the arm's joints about their start: the gripper's whole workspace, tilted every way."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PictureDifference:
    """How pictures differ from those of the whole scene, over all poses; colours are 0 to 255."""

    max_abs: int
    mean_abs: float
    share_of_pixels: float
    """Share of the pixels with any difference."""
    share_of_labels: float
    """Share of the pixels whose object label differs."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ProfileComparison:
    """Measured over random poses of the robot and the objects; times are medians over poses, taken in turn."""

    num_poses: int
    housing_dropped: PictureDifference
    """Without the camera's housing only."""
    wrist: PictureDifference
    """With the whole profile `wrist`."""
    arm_in_view: float
    """Share of the poses in which a link that the profile sometimes leaves out was drawn."""
    far_floor_in_view: float
    """Share of the poses in which the far floor was drawn."""
    full_ms: float
    housing_dropped_ms: float
    wrist_ms: float
    speed_ratio: float
    """Median over poses of the time of `full` over that of `wrist`."""


def compare_profiles(num_poses: int, seed: int, render_backend: str = "cpu") -> ProfileComparison:
    """Take the same pictures of PickBanana with the whole scene, without the housing and with the profile `wrist`.

    Args:
        num_poses: random poses, 1 or more.
        seed: of the poses.
        render_backend: ManiSkill's name of the device that renders.

    Raises:
        ValueError: `num_poses` is less than 1.
    """
    if num_poses < 1:
        raise ValueError(f"num_poses = {num_poses}: must be 1 or more")
    whole, slim = (_Studio(render_backend) for _ in range(2))
    try:
        return _compare(whole, slim, num_poses, np.random.default_rng(seed))
    finally:
        whole.close()
        slim.close()


@dataclass(frozen=True, kw_only=True, slots=True)
class _Picture:
    colour: Int[np.ndarray, "height width 3"]
    label: Int[np.ndarray, "height width"]
    wall_s: float


class _Studio:
    """One environment whose robot and objects are posed at will, photographed with its wrist camera."""

    def __init__(self, render_backend: str) -> None:
        self._made = gym.make(
            "PickBanana-v1",
            obs_mode="none",
            sim_backend="physx_cpu",
            render_backend=render_backend,
            sensor_configs={"shader_pack": "minimal"},
        )
        self._made.reset(seed=0)
        env: Any = self._made.unwrapped
        self.env = env
        self._scene: sapien.Scene = env.scene.sub_scenes[0]
        self._camera = env.scene.sensors[WRIST_CAMERA].camera._render_cameras[0]
        housing = env.agent.robot.links_map[HOUSING_LINK]._objs[0].entity
        self.housing = housing.find_component_by_type(sapien.render.RenderBodyComponent)
        env.goal_site.hide_visual()

    def close(self) -> None:
        """Release the simulator."""
        self._made.close()

    def pose(self, rng: np.random.Generator) -> None:
        """Put the arm somewhere in the workspace, within its joints' limits, and the objects somewhere on the table."""
        limits = self.env.agent.robot.get_qlimits()[0].numpy()
        arm = np.asarray(START_QPOS)[:7] + rng.normal(0, _POSE_SPREAD_RAD)
        qpos = np.clip(np.append(arm, rng.uniform(0, 0.04, 2)), limits[:, 0], limits[:, 1])
        self.env.agent.robot.set_qpos(torch.as_tensor(qpos[None], dtype=torch.float32))
        for actor in (self.env.banana, self.env.bowl):
            turn = rng.uniform(-np.pi, np.pi) / 2
            place = (*rng.uniform(-0.25, 0.25, 2), 0.03)
            actor.set_pose(sapien.Pose(place, (np.cos(turn), 0, 0, np.sin(turn))))

    def photograph(self, prepare: Callable[[], None]) -> _Picture:
        """The second of two pictures, so that a change of the scene before them is not timed."""
        self._take(prepare)
        start = time.perf_counter()
        colour = self._take(prepare)
        wall_s = time.perf_counter() - start
        label = self._camera.get_picture("PositionSegmentation")[..., 3]
        return _Picture(colour=colour[..., :3].astype(np.int64), label=label.astype(np.int64), wall_s=wall_s)

    def _take(self, prepare: Callable[[], None]) -> np.ndarray:
        prepare()
        self._scene.update_render()
        self._camera.take_picture()
        return self._camera.get_picture("Color")


def _compare(whole: _Studio, slim: _Studio, num_poses: int, rng: np.random.Generator) -> ProfileComparison:
    full, without_housing, wrist = [], [], []
    num_arm, num_far_floor = 0, 0
    culling = apply_render_profile(slim.env, "wrist")
    for _ in range(num_poses):
        pose_seed = int(rng.integers(2**31))
        for studio in (whole, slim):
            studio.pose(np.random.default_rng(pose_seed))
        whole.housing.enable()
        full.append(whole.photograph(lambda: None))
        whole.housing.disable()
        without_housing.append(whole.photograph(lambda: None))
        wrist.append(slim.photograph(culling.update))
        num_arm += culling.num_moving_drawn > 0
        num_far_floor += culling.far_floor_drawn
    times = np.array([[p.wall_s for p in pictures] for pictures in (full, without_housing, wrist)]) * 1000
    return ProfileComparison(
        num_poses=num_poses,
        housing_dropped=_difference(full, without_housing),
        wrist=_difference(full, wrist),
        arm_in_view=num_arm / num_poses,
        far_floor_in_view=num_far_floor / num_poses,
        full_ms=float(np.median(times[0])),
        housing_dropped_ms=float(np.median(times[1])),
        wrist_ms=float(np.median(times[2])),
        speed_ratio=float(np.median(times[0] / times[2])),
    )


def _difference(whole: list[_Picture], slim: list[_Picture]) -> PictureDifference:
    colours = np.stack([np.abs(a.colour - b.colour) for a, b in zip(whole, slim, strict=True)])
    labels = np.stack([a.label != b.label for a, b in zip(whole, slim, strict=True)])
    return PictureDifference(
        max_abs=int(colours.max()),
        mean_abs=float(colours.mean()),
        share_of_pixels=float((colours.max(axis=-1) > 0).mean()),
        share_of_labels=float(labels.mean()),
    )
