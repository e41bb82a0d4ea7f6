"""Our whole loop in one process: environment with pictures, policy, replay and one update a step."""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import torch

from slotfilm_dist.bench.agent import bench_config, learner_for
from slotfilm_dist.bench.serving import serve
from slotfilm_dist.envs.wrist_env import WristEnv
from slotfilm_dist.policy import AgentPolicy
from slotfilm_dist.replay.shard import ReplayShard
from slotfilm_dist.rollout import RolloutLoop


def build(*, stored: int) -> Mapping[str, Callable[..., float]]:
    """`measure`: env steps a second, each with an update.

    Args:
        stored: steps collected before.
    """
    torch.set_num_threads(1)
    base = bench_config()
    config = replace(base, encoder=replace(base.encoder, frozen_precision="auto"))
    learner = learner_for(config)
    seed = np.random.SeedSequence(0)
    policy = AgentPolicy(learner.encoder, learner.rl.actor, seed)
    loop = RolloutLoop(WristEnv(config, camera=True), policy, seed)
    shard = ReplayShard(learner.schema(), config.replay.capacity, 0)
    while shard.num_steps() < stored:
        shard.insert(loop.collect(config.runtime.block_steps))

    def measure(num_steps: int) -> float:
        done, began = 0, time.perf_counter()
        while done < num_steps:
            block = loop.collect(min(config.runtime.block_steps, num_steps - done))
            shard.insert(block)
            done += block.num_steps
            for _ in range(block.num_steps):
                learner.update(shard.sample(1, config.sac.batch_size)[0])
        return done / (time.perf_counter() - began)

    return {"measure": measure}


if __name__ == "__main__":
    serve(build)
