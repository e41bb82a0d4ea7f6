"""The task as the agent meets it, on the real simulator."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from slotfilm_dist.config import STATE_FIELD_DIMS, EnvConfig, ObsConfig, RunConfig
from slotfilm_dist.envs.expert import ExpertPolicy
from slotfilm_dist.envs.scene import SceneReader
from slotfilm_dist.envs.tasks import adapt_config
from slotfilm_dist.envs.wrist_env import WristEnv
from slotfilm_dist.variants import apply_variant

pytestmark = pytest.mark.sim


def make(max_steps: int = 400, camera: bool = False, task: str = "PickBanana-v1") -> WristEnv:
    config = adapt_config(RunConfig(env=EnvConfig(task=task, max_steps=max_steps, render_backend="cpu")))
    return WristEnv(config, camera=camera)


def actions(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (count, 1, 7)).astype(np.float32)


def trace(env: WristEnv, seed: int, steps: int = 25) -> list[np.ndarray]:
    """Every number of the start of an episode."""
    numbers = [env.reset([seed]).proprio]
    for action in actions(steps):
        step = env.step(action, [0])
        numbers += [step.final.proprio, step.reward, step.reward_terms, env.scene().object_poses.numpy().copy()]
    return numbers


def same(first: list[np.ndarray], second: list[np.ndarray]) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def test_seed_reproduces_its_episode_also_after_a_grasp_and_in_a_second_environment() -> None:
    env = make()
    first = trace(env, 5)
    expert = ExpertPolicy(env)
    observation = env.reset([8])
    for _ in range(120):
        step = env.step(expert.act(observation, np.empty((1, 0))), [0])
        observation = step.observation
    assert step.grasped[0]
    assert same(trace(env, 5), first)
    assert not same(trace(env, 6), first)
    env.close()
    other = make()
    assert same(trace(other, 5), first)
    other.close()


def test_first_state_of_an_episode_knows_no_contact_of_the_last_one() -> None:
    env = make()
    expert = ExpertPolicy(env)
    observation = env.reset([5])
    for _ in range(120):
        step = env.step(expert.act(observation, np.empty((1, 0))), [0])
        observation = step.observation
    assert step.contact[0]
    observation = env.reset([5])
    assert not env.scene().contact[0]
    assert not env.scene().grasped[0]
    assert observation.proprio[0, -1] == 0
    env.close()


def test_true_last_observation_is_kept_where_the_environment_resets_itself() -> None:
    env = make(max_steps=3)
    reference = make(max_steps=400)
    first = env.reset([5])
    reference.reset([5])
    for action in actions(3):
        step, expected = env.step(action, [6]), reference.step(action, [0])
    assert step.truncated[0]
    assert not step.terminated[0]
    assert np.array_equal(step.final.proprio, expected.final.proprio)
    assert not np.array_equal(step.observation.proprio, step.final.proprio)
    assert np.array_equal(step.observation.proprio, reference.reset([6]).proprio)
    assert not np.array_equal(step.observation.proprio, first.proprio)
    env.close()
    reference.close()


def test_state_vector_is_made_of_its_fields_and_the_reward_of_its_terms() -> None:
    env = make()
    env.reset([5])
    for action in actions(10):
        step = env.step(action, [0])
        scene = env.scene()
        parts = (scene.qpos, scene.qvel, scene.tcp_pose, scene.tcp_twist, scene.goal, scene.grasped[:, None].float())
        assert np.array_equal(step.final.proprio, torch.cat(parts, dim=-1).numpy())
        assert step.final.proprio.shape == (1, 35)
        assert step.reward_terms.sum() == pytest.approx(step.reward[0], abs=1e-6)
        assert 0 <= step.reward[0] <= 1
    env.close()


def test_near_field_is_the_way_to_the_goal_squeezed() -> None:
    fields = ("object_to_goal", "object_to_goal_near")
    obs = replace(RunConfig().obs, state_fields=fields, state_dim=6)
    env = WristEnv(replace(RunConfig(), obs=obs), camera=False)
    proprio = env.reset([5]).proprio
    np.testing.assert_allclose(proprio[:, 3:], np.tanh(proprio[:, :3] / 0.05), rtol=1e-5)
    env.close()


def test_cpu_reader_equals_maniskills_batched_properties_through_a_grasp() -> None:
    env = make()
    expert = ExpertPolicy(env)
    reader = SceneReader(env.base_env, ("banana", "bowl"), "goal_site")
    observation = env.reset([9])
    grasps = set()
    for count in range(110):
        step = env.step(expert.act(observation, np.empty((1, 0))), [0])
        observation = step.observation
        if count % 3:
            continue
        fast, slow = reader.read(), reader._read_gpu()
        for name in ("qpos", "qvel", "tcp_pose", "tcp_twist", "object_poses", "goal"):
            assert torch.allclose(getattr(fast, name), getattr(slow, name).float(), atol=1e-6), name
        assert fast.grasped.equal(slow.grasped)
        assert fast.contact.equal(slow.contact)
        grasps.add(bool(fast.grasped[0]))
    assert grasps == {False, True}
    env.close()


@pytest.mark.parametrize("task", ["PickCube-v1", "StackCube-v1"])
def test_stock_task_runs_with_its_own_reward_and_success(task: str) -> None:
    config = apply_variant("oracle_state", adapt_config(RunConfig(env=EnvConfig(task=task, max_steps=4))))
    env = WristEnv(config, camera=False)
    assert env.reset([3]).proprio.shape == (1, config.obs.state_dim)
    for action in actions(4):
        step = env.step(action, [4])
        assert step.reward_terms.tolist() == [step.reward.tolist()]
        assert 0 <= step.reward[0] <= 1
    assert step.truncated[0]
    env.close()


def test_unknown_controller_is_refused_with_the_known_ones() -> None:
    config = RunConfig(env=EnvConfig(control_mode="pd_ee"))
    with pytest.raises(ValueError, match=r"env\.control_mode = 'pd_ee'.*pd_ee_delta_pose"):
        WristEnv(config, camera=False)


@pytest.mark.parametrize("mode", ["pd_joint_pos", "pd_ee_pose"])
def test_controller_of_absolute_positions_is_refused(mode: str) -> None:
    config = RunConfig(env=EnvConfig(control_mode=mode))
    with pytest.raises(ValueError, match=rf"env\.control_mode = '{mode}': its actions .* take pd_ee_delta_pose"):
        WristEnv(config, camera=False)


def test_every_field_of_the_state_can_be_observed() -> None:
    fields = tuple(name for name in STATE_FIELD_DIMS if name != "object_poses")
    size = sum(STATE_FIELD_DIMS[name] for name in fields)
    env = WristEnv(RunConfig(obs=ObsConfig(state_fields=fields, state_dim=size)), camera=False)
    assert env.reset([1]).proprio.shape == (1, size)
    env.close()


@pytest.mark.render
def test_yellow_pixels_of_the_banana_lie_where_it_is_projected() -> None:
    env = make(camera=True)
    found = 0
    for seed in range(6):
        observation = env.reset([seed])
        assert observation.rgb is not None
        assert observation.rgb.dtype == np.uint8
        red, green, blue = (observation.rgb[0, ..., i].astype(int) for i in range(3))
        rows, columns = np.nonzero((red > blue + 80) & (green > 0.72 * red))
        if not observation.visible[0, 0] or len(rows) < 20:
            continue
        found += 1
        centre = np.array([columns.mean() + 0.5, rows.mean() + 0.5]) / 128
        assert np.linalg.norm(centre - observation.uv[0, 0]) < 0.08
    assert found >= 3
    env.close()


@pytest.mark.render
def test_projection_agrees_with_maniskills_camera_matrices() -> None:
    env = make(camera=True)
    for seed in range(3):
        observation = env.reset([seed])
        parameters = env.base_env.scene.sensors["hand_camera"].get_params()
        point = env.scene().object_poses[0, :, :3]
        local = point @ parameters["extrinsic_cv"][0, :, :3].T + parameters["extrinsic_cv"][0, :, 3]
        pixels = local @ parameters["intrinsic_cv"][0].T
        expected = (pixels[:, :2] / pixels[:, 2:] / 128).numpy()
        seen = observation.visible[0]
        assert np.allclose(observation.uv[0][seen], expected[seen], atol=1e-4)
        for action in actions(3, seed):
            env.step(action, [0])
    env.close()


def test_pictures_need_no_other_config_than_state() -> None:
    config = replace(RunConfig(), env=EnvConfig(max_steps=5))
    env = WristEnv(config, camera=False)
    observation = env.reset([1])
    assert observation.rgb is None
    assert not observation.visible.any()
    env.close()
