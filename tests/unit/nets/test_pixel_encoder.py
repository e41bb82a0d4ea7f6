"""The pixel baselines' encoders: published shapes, what reaches the latent, what is published to workers."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from slotfilm_dist.config import EncoderConfig, ObsConfig, RunConfig
from slotfilm_dist.nets.agent import build_encoder
from slotfilm_dist.nets.pixel_encoder import PixelEncoder
from slotfilm_dist.variants import apply_variant

PIXELS = ("cnn", "drq", "drqv2", "cnn_state", "drq_state", "drqv2_state")
MAP = 57
"""Rows and columns of DrQ's last map: 128 -> 63 -> 61 -> 59 -> 57."""


def build(variant: str = "cnn", seed: int = 0) -> PixelEncoder:
    encoder = build_encoder(apply_variant(variant, RunConfig(seed=seed)))
    assert isinstance(encoder, PixelEncoder)
    return encoder


def small(kind: str = "drq", fusion: str = "none", seed: int = 0) -> PixelEncoder:
    return PixelEncoder(EncoderConfig(kind=kind, fusion=fusion, feature_dim=50), ObsConfig(), 32, seed=seed)  # type: ignore[arg-type]


def seen(size: int = 32, batch: int = 3) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    pictures = torch.randint(0, 256, (batch, size, size, 3), dtype=torch.uint8, generator=generator)
    return pictures, torch.randn(batch, 35, generator=generator), torch.ones(batch, 3)


@pytest.mark.parametrize(
    ("variant", "latent_dim", "strides"),
    [
        ("cnn", 42, [2, 2, 2, 2]),
        ("cnn_state", 42 + 35, [2, 2, 2, 2]),
        ("drq", 50, [2, 1, 1, 1]),
        ("drq_state", 50 + 35, [2, 1, 1, 1]),
        ("drqv2", 32 * MAP * MAP, [2, 1, 1, 1]),
        ("drqv2_state", 32 * MAP * MAP + 35, [2, 1, 1, 1]),
    ],
)
def test_layers_are_the_published_ones(variant: str, latent_dim: int, strides: list[int]) -> None:
    encoder = build(variant)
    assert encoder.latent_dim == latent_dim
    assert [layer.stride[0] for layer in encoder.convolutions] == strides
    assert all(layer.kernel_size == (3, 3) and layer.out_channels == 32 for layer in encoder.convolutions)
    assert encoder(*seen(128, 1)).shape == (1, latent_dim)
    assert encoder.visual_kind == "rgb"


def test_drq_ends_in_linear_layernorm_tanh() -> None:
    encoder, (pictures, proprio, goal) = small("drq"), seen()
    hidden = pictures.permute(0, 3, 1, 2) / 255
    for layer in encoder.convolutions:
        hidden = layer(hidden).relu()
    projected = hidden.flatten(1) @ encoder.projection.weight.T + encoder.projection.bias
    normal = (projected - projected.mean(1, keepdim=True)) / (
        projected.var(1, keepdim=True, correction=0) + 1e-5
    ).sqrt()
    assert torch.allclose(encoder(pictures, proprio, goal), normal.tanh(), atol=1e-5)


def test_drqv2_centres_pictures_and_ends_in_its_convolutions() -> None:
    encoder, (pictures, proprio, goal) = small("drqv2"), seen()
    hidden = pictures.permute(0, 3, 1, 2) / 255 - 0.5
    for layer in encoder.convolutions:
        hidden = layer(hidden).relu()
    assert torch.allclose(encoder(pictures, proprio, goal), hidden.flatten(1), atol=1e-6)


def test_cnn_projection_is_linear_and_not_squashed() -> None:
    encoder, (pictures, proprio, goal) = small("cnn"), seen()
    with torch.no_grad():
        encoder.projection.weight.mul_(100)
        scaled = encoder(pictures, proprio, goal)
        encoder.projection.weight.div_(100)
    assert torch.allclose(scaled, 100 * encoder(pictures, proprio, goal), rtol=1e-3, atol=1e-3)
    assert encoder.norm is None


def test_weights_are_orthogonal_and_follow_from_the_seed_alone() -> None:
    torch.manual_seed(5)
    state = torch.get_rng_state()
    encoder = small("drq", seed=1)
    assert torch.equal(torch.get_rng_state(), state)
    rows = encoder.projection.weight
    assert torch.allclose(rows @ rows.T, torch.eye(50), atol=1e-4)
    kernel = encoder.convolutions[1].weight.flatten(1)
    assert torch.allclose(kernel @ kernel.T, 2 * torch.eye(32), atol=1e-4)
    assert torch.equal(rows, small("drq", seed=1).projection.weight)
    assert not torch.equal(rows, small("drq", seed=2).projection.weight)


@pytest.mark.parametrize("kind", ["cnn", "drq", "drqv2"])
def test_state_reaches_the_latent_only_where_it_is_appended(kind: str) -> None:
    pictures, proprio, goal = seen()
    blind, fair = small(kind), small(kind, "concat_late")
    assert torch.equal(blind(pictures, proprio, goal), blind(pictures, proprio + 1, goal))
    fair.set_state_statistics(torch.full((35,), 2.0), torch.full((35,), 4.0))
    latent = fair(pictures, proprio, goal)
    assert torch.equal(latent[:, :-35], blind(pictures, proprio, goal))
    assert torch.allclose(latent[:, -35:], (proprio - 2) / 4)


@pytest.mark.parametrize("kind", ["cnn", "drq", "drqv2"])
def test_goal_is_not_seen(kind: str) -> None:
    pictures, proprio, goal = seen()
    encoder = small(kind, "concat_late")
    assert torch.equal(encoder(pictures, proprio, goal), encoder(pictures, proprio, 0 * goal))


def test_every_weight_learns_in_rl() -> None:
    encoder = small("drq")
    encoder.freeze_backbone()
    encoder(*seen()).square().sum().backward()
    trained = encoder.fusion_parameters()
    assert {id(p) for p in trained} == {id(p) for p in encoder.parameters()}
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in trained)
    assert encoder.backbone_parameters() == encoder.gate_parameters() == encoder.head_parameters() == []


def test_acting_state_carries_convolutions_and_statistics_to_a_worker() -> None:
    learner, worker = small("drq", "concat_late", seed=1), small("drq", "concat_late", seed=2)
    learner.set_state_statistics(torch.full((35,), 1.0), torch.full((35,), 3.0))
    arrays = learner.acting_state()
    assert "convolutions.0.weight" in arrays
    worker.load_acting_state(arrays)
    assert torch.equal(worker(*seen()), learner(*seen()))
    with torch.no_grad():
        learner.convolutions[0].weight.zero_()
    assert np.abs(arrays["convolutions.0.weight"]).sum() > 0


def test_weights_of_another_encoder_are_refused() -> None:
    with pytest.raises(ValueError, match=r"'norm.bias' is in only one of them"):
        small("cnn").load_acting_state(small("drq").acting_state())
    arrays = small("cnn").acting_state() | {"projection.bias": np.zeros(3, np.float32)}
    with pytest.raises(ValueError, match=r"projection.bias is \(3,\), here \(50,\)"):
        small("cnn").load_acting_state(arrays)


@pytest.mark.parametrize("variant", PIXELS)
def test_pixel_variants_share_all_but_what_they_must_change(variant: str) -> None:
    base = RunConfig()
    config = apply_variant(variant, base)
    assert config.pretrain.steps == 0
    assert config.stores_pictures
    assert (config.env, config.obs, config.reward, config.replay) == (base.env, base.obs, base.reward, base.replay)
    if not variant.startswith("drqv2"):
        assert config.schedule == base.schedule
        assert replace(config.sac, augment_views=0) == base.sac


def test_misfit_configs_are_refused() -> None:
    with pytest.raises(
        ValueError, match=r"pretrain.steps = 150000: encoder.kind = 'cnn' is not pre-trained; set it to 0"
    ):
        RunConfig(encoder=EncoderConfig(kind="cnn", fusion="none"))
    with pytest.raises(ValueError, match=r"encoder.fusion = 'film_tanh': encoder.kind = 'drq' takes 'none'"):
        EncoderConfig(kind="drq")
    drq = apply_variant("drq", RunConfig())
    with pytest.raises(ValueError, match=r"algorithm = 'ddpg': .* use --variant drqv2"):
        replace(drq, algorithm="ddpg")
    with pytest.raises(ValueError, match=r"sac.augment_views = 2: .* needs encoder.kind = 'cnn' or 'drq'"):
        replace(RunConfig(), sac=drq.sac)


def test_encoder_is_a_module_in_eval_mode_too() -> None:
    encoder = small("drq")
    assert isinstance(encoder, nn.Module)
    assert torch.equal(encoder.train()(*seen()), encoder.eval()(*seen()))
