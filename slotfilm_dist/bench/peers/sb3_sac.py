"""Updates of Stable-Baselines3's SAC with our encoder on pictures, in a process of its own."""

# pyright: reportMissingImports=false
# Some of these packages are in the peers' environment only.

from collections.abc import Callable, Mapping

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.logger import configure

from slotfilm_dist.bench.agent import bench_config
from slotfilm_dist.bench.peers.sb3_agent import sb3_sac, spaces
from slotfilm_dist.bench.serving import serve
from slotfilm_dist.bench.timing import calls_per_s

FILLED = 200


class NoiseEnv(gym.Env):
    """Random pictures and states, to fill the buffer without a simulator."""

    def __init__(self) -> None:
        self._parts, self.action_space = spaces(bench_config())
        self.observation_space = self._parts
        self._rng = np.random.default_rng(0)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        return self._observe(), 0.0, False, False, {}

    def _observe(self) -> dict[str, np.ndarray]:
        size, state = self._parts["rgb"].shape, self._parts["state"].shape
        return {
            "rgb": self._rng.integers(0, 256, size, np.uint8),
            "state": self._rng.normal(size=state).astype(np.float32),
        }


def build() -> Mapping[str, Callable[..., float]]:
    """`measure`: updates a second."""
    torch.set_num_threads(1)
    agent = sb3_sac(NoiseEnv(), learning_starts=FILLED + 1)
    agent.learn(FILLED)
    agent.set_logger(configure(None, []))
    batch_size = bench_config().sac.batch_size
    return {"measure": lambda num_updates: calls_per_s(lambda: agent.train(1, batch_size), num_updates)}


if __name__ == "__main__":
    serve(build)
