"""The frozen agent's features of labelled frames: what the policy reads, and the part of it that comes from the eye."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, UInt8

from slotfilm_dist.evaluation.labelled_frames import LabelledFrames
from slotfilm_dist.nets.agent import AgentActor, AgentEncoder
from slotfilm_dist.nets.deterministic_heads import DeterministicActor
from slotfilm_dist.nets.encoder import SlotFusionEncoder

_BATCH = 64


@dataclass(frozen=True, kw_only=True, slots=True)
class Latents:
    """Features of frames, in the frames' order."""

    policy_input: Float32[np.ndarray, "frames latent"]
    """What the actor reads: the latent after fusion with the state; for DrQ-v2 the output of the actor's trunk."""
    visual: Float32[np.ndarray, "frames features"] | None
    """The same before the state comes in: pooled slots, or a pixel encoder's features; None without a camera."""


@torch.inference_mode()
def latents_of(
    encoder: AgentEncoder,
    frames: LabelledFrames,
    rgb: UInt8[np.ndarray, "frames height width 3"],
    actor: AgentActor | None = None,
) -> Latents:
    """Features of the frames with these pictures in place of their own.

    Args:
        encoder: frozen.
        frames: state and goal.
        rgb: the frames' pictures, corrupted or not.
        actor: only DrQ-v2's matters: its encoder ends in 100,000 values, which its trunk projects to 50.
    """
    device = next(encoder.buffers()).device
    inputs: list[np.ndarray] = []
    features: list[np.ndarray] = []
    for start in range(0, len(rgb), _BATCH):
        part = slice(start, start + _BATCH)
        pictures, proprio, goal = (
            torch.from_numpy(np.array(x[part])).to(device) for x in (rgb, frames.proprio, frames.goal)
        )
        visual = encoder.to_visual(pictures)
        latent = encoder(visual, proprio, goal)
        if isinstance(actor, DeterministicActor):
            latent = actor.trunk(latent)
            features.append(latent[:, : actor.trunk.projection.out_features].cpu().numpy())
        elif not isinstance(encoder, SlotFusionEncoder):
            features.append(latent[:, : encoder.visual_dim].cpu().numpy())
        elif encoder.perception is not None:
            tokens = encoder.tokens(visual) if visual.dtype == torch.uint8 else visual.float()
            features.append(encoder.perception.pooled(tokens).cpu().numpy())
        inputs.append(latent.cpu().numpy())
    return Latents(policy_input=np.concatenate(inputs), visual=np.concatenate(features) if features else None)
