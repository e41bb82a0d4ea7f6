"""The paper's agent for measurements: its sizes, random initial weights, one thread unless said otherwise."""

from dataclasses import replace

import torch

from slotfilm_dist.bench.transitions import ACTION_DIM
from slotfilm_dist.config import RunConfig
from slotfilm_dist.learning.learner import Learner
from slotfilm_dist.presets import paper


def bench_config() -> RunConfig:
    """The paper's numbers; speed does not depend on the backbone's weights, so none are fetched."""
    base = paper()
    return replace(base, encoder=replace(base.encoder, backbone="random"))


def learner_for(config: RunConfig, device: str = "cpu") -> Learner:
    """A learner that is ready to update."""
    learner = Learner(config, ACTION_DIM, torch.device(device))
    learner.begin_rl(None)
    return learner
