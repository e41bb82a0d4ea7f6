"""Stable-Baselines3's SAC with our encoder on pictures, on our task, in a process of its own."""

# pyright: reportMissingImports=false
# Some of these packages are in the peers' environment only.

from collections.abc import Callable, Mapping

import torch

from slotfilm_dist.bench.peers.picture_env import PictureEnv
from slotfilm_dist.bench.peers.sb3_agent import sb3_sac
from slotfilm_dist.bench.serving import serve
from slotfilm_dist.bench.timing import calls_per_s


def build(*, stored: int) -> Mapping[str, Callable[..., float]]:
    """`measure`: env steps a second, each with an update."""
    torch.set_num_threads(1)
    agent = sb3_sac(PictureEnv(), learning_starts=stored)
    agent.learn(stored)

    def measure(num_steps: int) -> float:
        return num_steps * calls_per_s(lambda: agent.learn(num_steps, reset_num_timesteps=False), 1)

    return {"measure": measure}


if __name__ == "__main__":
    serve(build)
