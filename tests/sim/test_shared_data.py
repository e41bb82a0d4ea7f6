"""Data that were collected once give every reward config what its own environment would have given."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from slotfilm_dist.config import RewardConfig, RewardWeights, RunConfig
from slotfilm_dist.envs.expert import ExpertPolicy
from slotfilm_dist.envs.reward import num_reward_inputs
from slotfilm_dist.envs.wrist_env import WristEnv
from slotfilm_dist.learning.learner import Learner, dataset_hash, dataset_schema
from slotfilm_dist.messages import TransitionBlock
from slotfilm_dist.presets import smoke
from slotfilm_dist.replay.dataset import open_dataset
from slotfilm_dist.replay.dataset_writer import FrameDatasetWriter
from slotfilm_dist.rollout import RolloutLoop
from slotfilm_dist.variants import apply_variant

pytestmark = pytest.mark.sim

STEPS = 150
"""Long enough for the expert to reach, grasp, carry and hold."""
OTHER_REWARDS = {
    "steeper": RewardConfig(alpha=5.0, varpi=10.0, weights=RewardWeights(static=0.0)),
    "other forms": RewardConfig(
        near_form="inverse", pg_form="exp", place_gate="none", static_norm="max", static_joints="all", normalize="none"
    ),
}


def config_of(reward: RewardConfig) -> RunConfig:
    base = smoke()
    return replace(apply_variant("state_only", replace(base, env=replace(base.env, max_steps=STEPS))), reward=reward)


def played(env: WristEnv) -> Iterator[TransitionBlock]:
    """An episode of the expert, whose actions follow from the simulator's state and not from the reward."""
    env.reset([0])
    loop = RolloutLoop(env, ExpertPolicy(env), np.random.SeedSequence(5))
    while not (block := loop.collect(40)).episodes:
        yield block
    yield block


def column(blocks: list[TransitionBlock], name: str) -> np.ndarray:
    return np.concatenate([getattr(block, name) for block in blocks])


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[TransitionBlock]]:
    """What an environment with the default reward gave, on disk and as it was."""
    config, folder = config_of(RewardConfig()), tmp_path_factory.mktemp("shared") / "data"
    env = WristEnv(config, camera=False)
    blocks = list(played(env))
    env.close()
    schema = dataset_schema(config, env.action_dim, num_reward_inputs(env.reward_term_names))
    with FrameDatasetWriter(folder, schema, dataset_hash(config)) as writer:
        for block in blocks:
            writer.append(block)
        writer.finish()
    return folder, blocks


def stored(folder: Path, config: RunConfig) -> list[TransitionBlock]:
    """What replay gets of the data in a run with this config."""
    return list(Learner(config, 7, torch.device("cpu")).stored_blocks(open_dataset(folder, dataset_hash(config))))


def test_reward_that_collected_the_data_comes_back_bit_for_bit(data: tuple[Path, list[TransitionBlock]]) -> None:
    folder, blocks = data
    assert set(column(blocks, "reward_inputs")[column(blocks, "is_step"), 2]) == {0, 1}
    assert blocks[-1].episodes[0].placed_at_end
    loaded = column(stored(folder, config_of(RewardConfig())), "reward")
    assert loaded.dtype == np.float32
    assert np.array_equal(loaded, column(blocks, "reward"))


@pytest.mark.parametrize("name", OTHER_REWARDS)
def test_another_reward_is_what_its_own_environment_would_have_given(
    name: str, data: tuple[Path, list[TransitionBlock]]
) -> None:
    folder, blocks = data
    config = config_of(OTHER_REWARDS[name])
    env = WristEnv(config, camera=False)
    own = list(played(env))
    env.close()
    loaded = stored(folder, config)
    for each in ("reward", "proprio", "action", "is_step", "terminated", "truncated"):
        assert np.array_equal(column(loaded, each), column(own, each)), each
    assert np.mean(column(own, "reward") != column(blocks, "reward")) > 0.9
