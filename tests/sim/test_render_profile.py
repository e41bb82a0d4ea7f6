import inspect

import gymnasium as gym
import mani_skill.envs  # noqa: F401  registers ManiSkill's tasks
import numpy as np
import pytest
import sapien
import torch

from slotfilm_dist.envs.render_comparison import compare_profiles
from slotfilm_dist.envs.render_profile import HOUSING_LINK, WRIST_CAMERA, apply_render_profile

pytestmark = [pytest.mark.sim, pytest.mark.render]

DOWN = (0.0, 0.4, 0.0, -2.0, 0.0, 2.4, -0.8, 0.04, 0.04)
"""Gripper over the table, looking down."""
TO_BASE = (0.0, 0.4, 0.0, -2.0, 0.0, 1.2, -0.8, 0.04, 0.04)
"""Gripper turned towards the robot's own base."""
TO_HORIZON = (0.0, 0.4, 0.0, -2.0, 0.0, 3.6, -0.8, 0.04, 0.04)
"""Gripper turned away from the robot."""


@pytest.fixture(scope="module")
def env():
    made = gym.make(
        "PickCube-v1",
        robot_uids="panda_wristcam",
        obs_mode="none",
        render_backend="cpu",
        sensor_configs={"shader_pack": "minimal"},
    )
    made.reset(seed=0)
    yield made.unwrapped
    made.close()


def look(env, qpos):
    env.agent.robot.set_qpos(torch.tensor([qpos]))


def picture(env):
    camera = env.scene.sensors[WRIST_CAMERA].camera._render_cameras[0]
    env.scene.sub_scenes[0].update_render()
    camera.take_picture()
    return camera.get_picture("Color").copy(), camera.get_picture("PositionSegmentation")[..., 3].copy()


def drawn_triangles(env) -> int:
    bodies = env.scene.sub_scenes[0].render_system.render_bodies
    meshes = [shape for body in bodies for shape in body.render_shapes]
    return sum(
        len(part.triangles)
        for shape in meshes
        if isinstance(shape, sapien.render.RenderShapeTriangleMesh)
        for part in shape.parts
    )


def body(env, link):
    entity = env.agent.robot.links_map[link]._objs[0].entity
    return entity.find_component_by_type(sapien.render.RenderBodyComponent)


def test_random_poses_give_the_same_pictures_to_the_last_bit():
    comparison = compare_profiles(num_poses=12, seed=5)
    for difference in (comparison.housing_dropped, comparison.wrist):
        assert difference.max_abs == 0
        assert difference.share_of_pixels == 0
        assert difference.share_of_labels == 0
    assert 0 < comparison.arm_in_view < 1
    assert 0 < comparison.far_floor_in_view < 1


@pytest.mark.parametrize("qpos", [DOWN, TO_BASE, TO_HORIZON])
def test_wrist_profile_repeats_the_whole_scenes_picture(env, qpos):
    apply_render_profile(env, "full").update()
    look(env, qpos)
    colour, label = picture(env)
    culling = apply_render_profile(env, "wrist")
    culling.update()
    slim_colour, slim_label = picture(env)
    np.testing.assert_array_equal(slim_colour, colour)
    np.testing.assert_array_equal(slim_label, label)
    assert len(np.unique(colour)) > 20


def test_only_what_may_be_seen_is_drawn(env):
    culling = apply_render_profile(env, "wrist")
    look(env, DOWN)
    culling.update()
    assert culling.num_moving_drawn == 0
    assert not culling.far_floor_drawn
    assert drawn_triangles(env) < 4000
    look(env, TO_HORIZON)
    culling.update()
    assert culling.far_floor_drawn
    assert culling.num_moving_drawn == 0
    look(env, TO_BASE)
    culling.update()
    assert culling.num_moving_drawn > 0


def test_links_that_move_with_the_camera_stay_out_and_fingers_stay_in(env):
    culling = apply_render_profile(env, "wrist")
    for qpos in (DOWN, TO_BASE, TO_HORIZON):
        look(env, qpos)
        culling.update()
        assert not any(body(env, link).is_enabled for link in (HOUSING_LINK, "panda_hand", "panda_link7"))
        assert body(env, "panda_leftfinger").is_enabled
        assert body(env, "panda_rightfinger").is_enabled


def test_hand_is_drawn_by_a_camera_wide_enough_to_see_it(env):
    camera = env.scene.sensors[WRIST_CAMERA].camera._render_cameras[0]
    usual = camera.fovy
    camera.set_fovy(2.9, compute_x=True)
    apply_render_profile(env, "wrist")
    drawn = body(env, "panda_hand").is_enabled
    camera.set_fovy(usual, compute_x=True)
    assert drawn


def test_full_profile_brings_everything_back(env):
    apply_render_profile(env, "full").update()
    before = drawn_triangles(env)
    look(env, DOWN)
    for _ in range(2):
        apply_render_profile(env, "wrist").update()
    apply_render_profile(env, "full").update()
    assert drawn_triangles(env) == before > 500_000


def test_unknown_profile_is_named(env):
    with pytest.raises(ValueError, match=r"env\.render_profile = 'thin': must be wrist or full"):
        inspect.unwrap(apply_render_profile)(env, "thin")


def test_no_poses_is_refused():
    with pytest.raises(ValueError, match="num_poses = 0"):
        compare_profiles(num_poses=0, seed=0)
