"""The direct controller against ManiSkill's own."""

import gymnasium as gym
import numpy as np
import pytest
import torch

import slotfilm_dist.envs.pick_banana  # noqa: F401  registers the task

pytestmark = pytest.mark.sim

TOLERANCE_M = 1e-4
"""Both solve the same inverse kinematics, in single and in double precision."""


def test_direct_controller_moves_the_arm_as_maniskills_own() -> None:
    envs = [
        gym.make("PickBanana-v1", robot_uids=robot, obs_mode="none", render_backend="none").unwrapped
        for robot in ("panda_wristcam_direct", "panda_wristcam")
    ]
    for env in envs:
        env.reset(seed=4)
    generator = np.random.default_rng(0)
    travelled = 0.0
    start = envs[0].agent.tcp.pose.p.clone()
    for _ in range(40):
        action = torch.from_numpy(generator.uniform(-1, 1, (1, 7)).astype(np.float32))
        for env in envs:
            env.step(action)
        positions = [env.agent.tcp.pose.p for env in envs]
        assert torch.linalg.vector_norm(positions[0] - positions[1]) < TOLERANCE_M
        assert torch.allclose(envs[0].agent.robot.get_qpos(), envs[1].agent.robot.get_qpos(), atol=1e-3)
        travelled = max(travelled, float(torch.linalg.vector_norm(positions[0] - start)))
    assert travelled > 0.03
    for env in envs:
        env.close()


def test_action_that_is_not_finite_is_refused() -> None:
    env = gym.make("PickBanana-v1", obs_mode="none", render_backend="none").unwrapped
    env.reset(seed=1)
    with pytest.raises(ValueError, match="must be finite"):
        env.agent.set_action(torch.full((1, 7), float("nan")))
    env.close()
