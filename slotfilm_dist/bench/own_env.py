"""Our environment in a process of its own, stepped with random actions."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from slotfilm_dist.bench.serving import serve
from slotfilm_dist.bench.timing import calls_per_s
from slotfilm_dist.config import EnvConfig, RunConfig


def build(*, camera: bool, profile: str, image_size: int = 128) -> Mapping[str, Callable[..., float]]:
    """`measure`: environment steps a second."""
    import torch

    from slotfilm_dist.envs.wrist_env import WristEnv

    torch.set_num_threads(1)
    base = RunConfig()
    env_config: EnvConfig = replace(base.env, render_profile=profile, image_size=image_size)  # type: ignore[arg-type]
    env = WristEnv(replace(base, env=env_config), camera=camera)
    env.reset([0])
    rng = np.random.default_rng(0)

    def step() -> None:
        env.step(rng.uniform(-1, 1, (1, env.action_dim)).astype(np.float32), [1])

    return {"measure": lambda num_steps: calls_per_s(step, num_steps)}


if __name__ == "__main__":
    serve(build)
