"""Builds the encoder and the actor that a config asks for, the same in the learner, a worker and a measurement."""

import torch

from slotfilm_dist.config import RunConfig
from slotfilm_dist.nets.deterministic_heads import DeterministicActor
from slotfilm_dist.nets.encoder import SlotFusionEncoder
from slotfilm_dist.nets.pixel_encoder import PixelEncoder
from slotfilm_dist.nets.policy_heads import Actor
from slotfilm_dist.seeds import Role, role_number

AgentEncoder = SlotFusionEncoder | PixelEncoder
AgentActor = Actor | DeterministicActor


def build_encoder(config: RunConfig, *, fetch_weights: bool = True) -> AgentEncoder:
    """The encoder of a run, with the weights that its seed draws.

    Args:
        config: the run.
        fetch_weights: fill a backbone as `encoder.backbone` asks; False where a checkpoint fills it right after.

    Raises:
        ValueError: the backbone's weights cannot be had.
    """
    seed = role_number(config.seed, Role.ENCODER)
    if config.encoder.learns_from_pixels:
        return PixelEncoder(config.encoder, config.obs, config.env.image_size, seed=seed)
    return SlotFusionEncoder(config.encoder, config.obs, config.env.image_size, seed=seed, fetch_weights=fetch_weights)


def build_actor(
    config: RunConfig, encoder: AgentEncoder, action_dim: int, generator: torch.Generator | None = None
) -> AgentActor:
    """The actor of a run on its encoder.

    Args:
        config: the run.
        encoder: whose latent it reads.
        action_dim: size of the action.
        generator: source of the initial weights.
    """
    if config.algorithm == "ddpg":
        assert isinstance(encoder, PixelEncoder), "the config allows DrQ-v2's encoder only"
        return DeterministicActor(
            encoder.visual_dim,
            encoder.state_dim,
            action_dim,
            feature_dim=config.encoder.feature_dim,
            hidden=config.ddpg.hidden,
            generator=generator,
        )
    sac = config.sac
    return Actor(
        encoder.latent_dim,
        action_dim,
        sac.hidden,
        log_std_range=(sac.log_std_min, sac.log_std_max),
        generator=generator,
    )
