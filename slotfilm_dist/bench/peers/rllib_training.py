"""RLlib's SAC with its own convolutions on pictures, on our task, in a process of its own with a Ray of its own."""

# pyright: reportMissingImports=false
# Some of these packages are in the peers' environment only.

import time
from collections.abc import Callable, Mapping

import ray
import torch
from ray.rllib.algorithms.sac import SACConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig

from slotfilm_dist.bench.agent import bench_config
from slotfilm_dist.bench.peers.picture_env import PictureEnv
from slotfilm_dist.bench.serving import serve

FILTERS: list[tuple[int, int | tuple[int, int], int | tuple[int, int]]] = [(32, 3, 2)] * 4
"""Four convolutions of 32 channels and stride 2, the size of this project's own CNN baseline."""


def build(*, stored: int) -> Mapping[str, Callable[..., float]]:
    """`measure`: env steps a second, each with an update, over at least so many steps."""
    torch.set_num_threads(1)
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    sac = bench_config().sac
    config = (
        SACConfig()
        .environment(PictureEnv, env_config={"state": False})
        .env_runners(num_env_runners=0, rollout_fragment_length=1)
        .learners(num_learners=0)
        .training(
            train_batch_size_per_learner=sac.batch_size,
            num_steps_sampled_before_learning_starts=stored,
            training_intensity=None,
            replay_buffer_config={"type": "EpisodeReplayBuffer", "capacity": 2000},
            n_step=1,
        )
        .rl_module(model_config=DefaultModelConfig(conv_filters=FILTERS, head_fcnet_hiddens=list(sac.hidden)))
        .reporting(min_sample_timesteps_per_iteration=1, min_time_s_per_iteration=0)
    )
    algorithm = config.build_algo()

    while (sampled := _sampled(algorithm.train())) < stored + 2:
        continue

    def measure(num_steps: int) -> float:
        nonlocal sampled
        first, began = sampled, time.perf_counter()
        while sampled < first + num_steps:
            sampled = _sampled(algorithm.train())
        return (sampled - first) / (time.perf_counter() - began)

    return {"measure": measure}


def _sampled(result: dict) -> int:
    return int(result["num_env_steps_sampled_lifetime"])


if __name__ == "__main__":
    serve(build)
