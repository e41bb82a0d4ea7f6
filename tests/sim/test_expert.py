"""The scripted expert proves that the task can be solved."""

import pytest

from slotfilm_dist.config import RunConfig
from slotfilm_dist.envs.expert import ExpertPolicy
from slotfilm_dist.envs.wrist_env import WristEnv
from slotfilm_dist.evaluation.rollouts import play_episodes

pytestmark = pytest.mark.sim


def test_expert_solves_nine_of_ten_episodes_that_run_their_full_length() -> None:
    env = WristEnv(RunConfig(), camera=False)
    episodes = list(play_episodes(env, ExpertPolicy(env), range(30_000_000, 30_000_010)))
    env.close()
    assert sum(episode.success_at_end for episode in episodes) >= 9
    assert {episode.length for episode in episodes} == {400}
    assert all(episode.success_once >= episode.success_at_end for episode in episodes)
