"""What the probes read of each kind of agent."""

import dataclasses

import numpy as np
import pytest
import torch

from slotfilm_dist.config import RunConfig
from slotfilm_dist.evaluation.labelled_frames import LabelledFrames
from slotfilm_dist.evaluation.latents import Latents, latents_of
from slotfilm_dist.nets.agent import build_actor, build_encoder
from slotfilm_dist.presets import smoke
from slotfilm_dist.variants import apply_variant


def make_frames(count: int = 70) -> LabelledFrames:
    rng = np.random.default_rng(0)
    return LabelledFrames(
        rgb=rng.integers(0, 256, (count, 32, 32, 3), dtype=np.uint8),
        proprio=rng.normal(size=(count, 35)).astype(np.float32),
        goal=np.zeros((count, 3), np.float32),
        uv=np.zeros((count, 2, 2), np.float32),
        visible=np.ones((count, 2), bool),
        contact=np.zeros(count, bool),
        distance_m=np.zeros(count, np.float32),
        object_m=np.zeros((count, 3), np.float32),
        episode=np.zeros(count, np.int32),
        step=np.arange(count, dtype=np.int32),
    )


def latents(variant: str, frames: LabelledFrames, rgb: np.ndarray | None = None) -> Latents:
    base = smoke()
    config: RunConfig = apply_variant(
        variant, dataclasses.replace(base, env=dataclasses.replace(base.env, image_size=32))
    )
    encoder = build_encoder(config)
    if not config.sac.end_to_end:
        encoder.freeze_backbone()
    encoder.eval()
    actor = build_actor(config, encoder, 7, torch.Generator().manual_seed(0))
    return latents_of(encoder, frames, frames.rgb if rgb is None else rgb, actor)


@pytest.mark.parametrize(
    ("variant", "policy_input", "visual"),
    [
        ("slotfilm", 42, 42),
        ("concat_late", 77, 42),
        ("no_state", 42, 42),
        ("end_to_end", 42, 42),
        ("cnn", 42, 42),
        ("cnn_state", 77, 42),
        ("drqv2_state", 85, 50),
        ("state_only", 35, None),
    ],
)
def test_sizes_of_both_latents(variant: str, policy_input: int, visual: int | None) -> None:
    seen = latents(variant, make_frames())
    assert seen.policy_input.shape == (70, policy_input)
    assert (seen.visual is None) if visual is None else (seen.visual is not None and seen.visual.shape == (70, visual))


def test_late_concatenation_is_the_visual_part_beside_the_state() -> None:
    seen = latents("concat_late", frames := make_frames())
    assert seen.visual is not None
    assert np.allclose(seen.policy_input, np.concatenate((seen.visual, frames.proprio), axis=1), atol=1e-5)


def test_only_the_state_agent_does_not_notice_other_pictures() -> None:
    frames = make_frames()
    other = 255 - frames.rgb
    assert (latents("state_only", frames).policy_input == latents("state_only", frames, other).policy_input).all()
    clean, changed = latents("slotfilm", frames), latents("slotfilm", frames, other)
    assert clean.visual is not None
    assert changed.visual is not None
    assert np.abs(clean.visual - changed.visual).max() > 1e-4
