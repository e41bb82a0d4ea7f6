"""Stable-Baselines3's SAC with our encoder as its features extractor, as a user would plug it in: on pictures."""

# pyright: reportMissingImports=false
# Some of these packages are in the peers' environment only.

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from slotfilm_dist.bench.agent import bench_config, learner_for
from slotfilm_dist.bench.transitions import ACTION_DIM
from slotfilm_dist.config import RunConfig


class SlotFeatures(BaseFeaturesExtractor):
    """Pictures and state to our latent; the backbone is frozen as in ours, so no gradient goes through it."""

    def __init__(self, observation_space: gym.spaces.Dict) -> None:
        encoder = learner_for(bench_config()).encoder
        super().__init__(observation_space, encoder.latent_dim)
        self.encoder = encoder

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """The latent, [batch, latent]; Stable-Baselines3 gives pictures as floats, channels first or last."""
        pictures = observations["rgb"]
        if pictures.shape[1] == 3:
            pictures = pictures.permute(0, 2, 3, 1)
        state = observations["state"]
        return self.encoder(pictures.to(torch.uint8), state, torch.zeros(len(state), 3))


def spaces(config: RunConfig) -> tuple[gym.spaces.Dict, gym.spaces.Box]:
    """Observation and action of the task as gymnasium describes them."""
    size = config.env.image_size
    observation = gym.spaces.Dict(
        {
            "rgb": gym.spaces.Box(0, 255, (size, size, 3), np.uint8),
            "state": gym.spaces.Box(-np.inf, np.inf, (config.obs.state_dim,), np.float32),
        }
    )
    return observation, gym.spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)


def sb3_sac(env: Any, *, learning_starts: int) -> SAC:
    """SAC with our batch and network sizes and one update a step."""
    config = bench_config()
    return SAC(
        "MultiInputPolicy",
        env,
        batch_size=config.sac.batch_size,
        buffer_size=600,
        learning_starts=learning_starts,
        train_freq=1,
        gradient_steps=1,
        ent_coef=0.1,
        policy_kwargs={
            "features_extractor_class": SlotFeatures,
            "net_arch": list(config.sac.hidden),
            "normalize_images": False,
        },
        device="cpu",
    )
