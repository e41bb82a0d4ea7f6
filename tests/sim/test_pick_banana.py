"""PickBanana-v1 as a ManiSkill task like any other."""

import gymnasium as gym
import pytest
import torch
from mani_skill.utils.registration import REGISTERED_ENVS
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv

import slotfilm_dist.envs.pick_banana  # noqa: F401  registers the task

pytestmark = pytest.mark.sim


def test_task_is_registered_and_runs_400_steps_in_maniskills_vector_environment() -> None:
    assert "PickBanana-v1" in REGISTERED_ENVS
    assert gym.spec("PickBanana-v1") is not None
    env = ManiSkillVectorEnv(gym.make("PickBanana-v1", num_envs=1, obs_mode="state", render_backend="none"))
    env.reset(seed=1)
    assert env.action_space.shape[-1] == 7
    action = torch.zeros(1, 7)
    for step in range(1, 401):
        _, reward, terminated, truncated, infos = env.step(action)
        assert not terminated.any()
        assert bool(truncated.any()) == (step == 400)
        assert 0 <= float(reward) <= 1
    assert "final_observation" in infos
    env.close()


@pytest.mark.render
def test_pictures_come_through_gymnasium_without_the_objects_poses() -> None:
    env = gym.make("PickBanana-v1", obs_mode="rgb", render_backend="cpu")
    observation, _ = env.reset(seed=1)
    rgb = observation["sensor_data"]["hand_camera"]["rgb"]
    assert rgb.shape == (1, 128, 128, 3)
    assert rgb.dtype == torch.uint8
    assert "banana_pose" not in observation["extra"]
    assert env.unwrapped.goal_site in env.unwrapped._hidden_objects
    green = (rgb[..., 1].int() > rgb[..., 0].int() + 80) & (rgb[..., 1].int() > rgb[..., 2].int() + 80)
    assert not green.any()
    env.close()


def test_observation_after_a_reset_to_a_given_state_is_of_that_state() -> None:
    env = gym.make("PickBanana-v1", obs_mode="state", render_backend="none")
    wanted, _ = env.reset(seed=1)
    states = env.unwrapped.get_state_dict()
    other, _ = env.reset(seed=2)
    assert not torch.allclose(other, wanted)
    again, _ = env.reset(options={"reset_to_env_states": {"env_states": states}})
    assert torch.allclose(again, wanted, atol=1e-5)
    env.close()
