"""The random policy's data on the toy environment, on disk, as a learner begins with."""

from pathlib import Path

import numpy as np

from slotfilm_dist.config import RunConfig
from slotfilm_dist.envs.toy import ToyEnv
from slotfilm_dist.learning.learner import dataset_hash, dataset_schema
from slotfilm_dist.policy import RandomPolicy
from slotfilm_dist.replay.dataset_writer import FrameDatasetWriter
from slotfilm_dist.rollout import RolloutLoop


def write_toy_data(config: RunConfig, folder: Path) -> Path:
    """`schedule.random_steps` steps in a new folder; gives its path."""
    env = ToyEnv(config, camera=config.encoder.uses_image)
    policy = RandomPolicy(env.action_dim, np.random.SeedSequence(0))
    loop = RolloutLoop(env, policy, np.random.SeedSequence(1))
    path = folder / f"data-{dataset_hash(config)}"
    with FrameDatasetWriter(path, dataset_schema(config, env.action_dim), dataset_hash(config)) as writer:
        while writer.num_steps < config.schedule.random_steps:
            writer.append(loop.collect(20))
        writer.finish()
    return path
