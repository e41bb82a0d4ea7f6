"""Our task as a plain gymnasium environment, for libraries that want one: the same simulator, renderer and reward."""

# pyright: reportMissingImports=false
# Some of these packages are in the peers' environment only.

from typing import Any

import gymnasium as gym
import numpy as np

from slotfilm_dist.bench.agent import bench_config
from slotfilm_dist.bench.transitions import ACTION_DIM
from slotfilm_dist.envs.wrist_env import WristEnv
from slotfilm_dist.messages import Observation


class PictureEnv(gym.Env):
    """PickBanana-v1 with the wrist camera.

    Args:
        options: `state` (default true) adds the state vector to the observation, else it is the picture alone, as
            floats in [0, 1].
    """

    def __init__(self, options: Any = None) -> None:
        config = bench_config()
        self._with_state = (options or {}).get("state", True)
        size = config.env.image_size
        picture = gym.spaces.Box(0, 255, (size, size, 3), np.uint8)
        state = gym.spaces.Box(-np.inf, np.inf, (config.obs.state_dim,), np.float32)
        scaled = gym.spaces.Box(0.0, 1.0, (size, size, 3), np.float32)
        self.observation_space = gym.spaces.Dict({"rgb": picture, "state": state}) if self._with_state else scaled
        self.action_space = gym.spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)
        self._env = WristEnv(config, camera=True)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        """Start an episode."""
        return self._observed(self._env.reset([seed or 0])), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict]:
        """One control step; the environment has reset itself where an episode ended."""
        result = self._env.step(np.asarray(action, np.float32)[None], [1])
        ended, cut = bool(result.terminated[0]), bool(result.truncated[0])
        return self._observed(result.final), float(result.reward[0]), ended, cut, {}

    def _observed(self, observation: Observation) -> Any:
        assert observation.rgb is not None
        picture = observation.rgb[0]
        if self._with_state:
            return {"rgb": picture, "state": observation.proprio[0]}
        return picture.astype(np.float32) / 255
