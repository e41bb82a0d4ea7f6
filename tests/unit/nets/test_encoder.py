"""The whole encoder: its size, its variants, what is frozen and what crosses to a worker."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from slotfilm_dist.config import EncoderConfig, ObsConfig
from slotfilm_dist.nets.encoder import SlotFusionEncoder

FUSIONS = ("film_tanh", "film_clamp", "concat_proj", "concat_late", "none", "state_only")


def build(*, seed: int = 0, image_size: int = 64, frozen: bool = True, **fields: Any) -> SlotFusionEncoder:
    encoder = SlotFusionEncoder(EncoderConfig(backbone="random", **fields), ObsConfig(), image_size, seed=seed)
    if frozen:
        encoder.freeze_backbone()
    return encoder


def pictures(batch: int = 3, size: int = 64) -> Tensor:
    generator = torch.Generator().manual_seed(4)
    return torch.randint(0, 256, (batch, size, size, 3), dtype=torch.uint8, generator=generator)


def states(batch: int = 3) -> Tensor:
    return torch.randn(batch, 35, generator=torch.Generator().manual_seed(5))


def no_goal(batch: int = 3) -> Tensor:
    return torch.zeros(batch, 3)


def wake_film(encoder: SlotFusionEncoder) -> None:
    """Move FiLM away from the identity."""
    assert encoder.fusion is not None
    with torch.no_grad():
        encoder.fusion.film.weight.normal_(generator=torch.Generator().manual_seed(6))


@pytest.mark.parametrize(("goal", "expected"), [(False, 2_829_390), (True, 2_829_392)])
def test_encoder_has_the_parameters_of_the_paper(goal: bool, expected: int) -> None:
    encoder = build(image_size=128, goal=goal)
    assert sum(p.numel() for p in encoder.parameters()) == expected


@pytest.mark.parametrize("fusion", FUSIONS)
def test_parameter_groups_hold_every_parameter_once(fusion: str) -> None:
    encoder = build(fusion=fusion, goal=fusion != "state_only")
    groups = (
        encoder.fusion_parameters(),
        encoder.gate_parameters(),
        encoder.backbone_parameters(),
        encoder.head_parameters(),
    )
    grouped = [id(p) for group in groups for p in group]
    assert len(grouped) == len(set(grouped))
    assert set(grouped) == {id(p) for p in encoder.parameters()}


@pytest.mark.parametrize(
    ("fusion", "latent_dim"),
    [("film_tanh", 42), ("film_clamp", 42), ("concat_proj", 42), ("concat_late", 77), ("none", 42), ("state_only", 35)],
)
def test_latent_has_the_size_that_follows_from_the_fusion(fusion: str, latent_dim: int) -> None:
    encoder = build(fusion=fusion)
    latent = encoder(encoder.to_visual(pictures()), states(), no_goal())
    assert latent.shape == (3, encoder.latent_dim) == (3, latent_dim)


@pytest.mark.parametrize("fusion", ["film_tanh", "film_clamp"])
def test_film_is_the_exact_identity_at_first(fusion: str) -> None:
    encoder = build(fusion=fusion)
    visual = encoder.to_visual(pictures())
    assert encoder.fusion is not None
    assert encoder.fusion.is_identity()
    assert torch.equal(encoder(visual, states(), no_goal()), build(fusion="none")(visual, states(), no_goal()))


def test_film_scales_and_shifts_as_the_paper_writes_it() -> None:
    for fusion in ("film_tanh", "film_clamp"):
        encoder = build(fusion=fusion)
        wake_film(encoder)
        assert encoder.fusion is not None
        assert not encoder.fusion.is_identity()
        visual = encoder.to_visual(pictures())
        pooled = encoder.perceive(visual).slots.mean(1)
        gamma, beta = encoder.fusion.film(encoder.fusion.state_projection(states())).chunk(2, 1)
        assert gamma.abs().max() > 1
        bounded = gamma.tanh() if fusion == "film_tanh" else gamma.clip(-1, 1)
        torch.testing.assert_close(
            encoder(visual, states(), no_goal()), (1 + bounded) * pooled + beta, atol=1e-5, rtol=1e-5
        )


def test_state_reaches_every_latent_but_that_without_state() -> None:
    for fusion in FUSIONS:
        encoder = build(fusion=fusion)
        if fusion.startswith("film"):
            wake_film(encoder)
        visual = encoder.to_visual(pictures())
        same = torch.equal(encoder(visual, states(), no_goal()), encoder(visual, 2 * states(), no_goal()))
        assert same == (fusion == "none")


def test_tokens_and_pictures_give_the_same_latent() -> None:
    encoder = build()
    from_pictures = encoder(pictures(), states(), no_goal())
    assert torch.equal(encoder(encoder.tokens(pictures()), states(), no_goal()), from_pictures)
    halves = encoder.to_visual(pictures())
    assert halves.dtype == torch.float16
    torch.testing.assert_close(encoder(halves, states(), no_goal()), from_pictures, atol=2e-3, rtol=0)


def test_replay_keeps_tokens_only_of_a_frozen_backbone() -> None:
    assert build().visual_kind == "tokens"
    unfrozen = build(frozen=False)
    assert unfrozen.visual_kind == "rgb"
    assert torch.equal(unfrozen.to_visual(pictures()), pictures())
    blind = build(fusion="state_only")
    assert blind.visual_kind == "none"
    assert blind.to_visual(pictures()).shape == (3, 0)


def test_frozen_backbone_in_bfloat16_gives_nearly_the_same_tokens() -> None:
    exact, half = build().eval(), build(frozen_precision="bfloat16").eval()
    wanted, given = exact.tokens(pictures()), half.tokens(pictures())
    assert given.dtype == torch.float32
    assert 0 < (given - wanted).norm() / wanted.norm() < 0.02
    assert half.backbone_hash() == exact.backbone_hash()


def test_only_a_frozen_backbone_works_in_bfloat16() -> None:
    exact, half = build(frozen=False).eval(), build(frozen=False, frozen_precision="bfloat16").eval()
    assert torch.equal(half.tokens(pictures()), exact.tokens(pictures()))


def test_training_mode_never_reaches_a_frozen_batchnorm() -> None:
    encoder = build()
    before = encoder.backbone_hash()
    encoder.train()
    latent = encoder(pictures(), states(), no_goal())
    latent.sum().backward()
    assert encoder.backbone_hash() == before
    assert all(p.grad is None and not p.requires_grad for p in encoder.backbone_parameters())
    assert encoder.training

    unfrozen = build(frozen=False).train()
    unfrozen(pictures(), states(), no_goal()).sum().backward()
    assert unfrozen.backbone_hash() != before
    assert all(p.grad is not None for p in unfrozen.backbone_parameters())


@pytest.mark.parametrize("part", ["perception.projection.bias", "perception.backbone.trunk.bn1.running_var"])
def test_backbone_hash_covers_all_that_makes_tokens_and_no_more(part: str) -> None:
    encoder = build()
    before = encoder.backbone_hash()
    encoder.state_dict()["perception.slots"].add_(1)
    encoder.state_dict()["proprio_mean"].add_(1)
    assert encoder.backbone_hash() == before
    encoder.state_dict()[part].add_(1e-3)
    assert encoder.backbone_hash() != before


def test_critic_gradient_reaches_fusion_but_no_head() -> None:
    encoder = build(goal=True)
    wake_film(encoder)
    goal = torch.tensor([[0.3, 0.6, 1.0]]).expand(3, -1)
    encoder(encoder.to_visual(pictures()), states(), goal).square().sum().backward()
    for parameter in (*encoder.fusion_parameters(), *encoder.gate_parameters()):
        assert parameter.grad is not None
        assert parameter.grad.any()
    assert all(p.grad is None for p in encoder.head_parameters())


def test_goal_out_of_view_changes_nothing_even_if_its_position_is_not_finite() -> None:
    with_goal, without = build(goal=True), build()
    visual = without.to_visual(pictures())
    goal = torch.tensor([[torch.nan, torch.inf, 0.0]]).expand(3, -1)
    plain = without(visual, states(), no_goal())
    assert torch.equal(with_goal(visual, states(), goal), plain)
    assert not torch.equal(with_goal(visual, states(), torch.tensor([[0.5, 0.5, 1.0]]).expand(3, -1)), plain)


def test_goal_query_is_the_token_under_the_goal() -> None:
    encoder = build(goal=True)
    perception = encoder.perception
    assert perception is not None
    tokens = encoder.tokens(pictures())
    row, col = 2, 1
    uv = torch.tensor([[(col + 0.5) / 4, (row + 0.5) / 4]]).expand(3, -1)
    direct = perception.attention.one_query_each(tokens[:, 4 * row + col], tokens, perception.code())
    torch.testing.assert_close(perception.goal_feature(tokens, uv), direct, atol=1e-5, rtol=1e-5)


def test_positional_code_tells_rows_from_columns() -> None:
    perception = build().perception
    assert perception is not None
    code = perception.code().view(4, 4, 42) / perception.pos_scale
    torch.testing.assert_close(code[2, 3], torch.cat((perception.row_code[2], perception.col_code[3])))


@pytest.mark.parametrize(("vis_head", "num_slots", "num_logits"), [("pooled", 4, 2), ("matched", 4, 4)])
def test_perception_has_one_position_per_slot(vis_head: str, num_slots: int, num_logits: int) -> None:
    encoder = build(vis_head=vis_head, num_slots=num_slots)
    seen = encoder.perceive(encoder.to_visual(pictures()))
    assert seen.uv.shape == (3, num_slots, 2)
    assert 0 < seen.uv.min() <= seen.uv.max() < 1
    assert seen.visible_logits.shape == (3, num_logits)
    torch.testing.assert_close(seen.attention.sum(2), torch.ones(3, num_slots))


@pytest.mark.parametrize("fusion", FUSIONS)
def test_acting_state_makes_a_worker_act_as_the_learner(fusion: str) -> None:
    learner, worker = (build(fusion=fusion, goal=fusion != "state_only") for _ in range(2))
    with torch.no_grad():
        for parameter in (*learner.fusion_parameters(), *learner.gate_parameters()):
            parameter.add_(0.1)
    learner.set_state_statistics(torch.full((35,), 0.5), torch.full((35,), 2.0))
    arrays = learner.acting_state()
    worker.load_acting_state(arrays)
    visual, goal = learner.to_visual(pictures()), torch.tensor([[0.3, 0.6, 1.0]]).expand(3, -1)
    expected = learner(visual, states(), goal)
    assert torch.equal(worker(visual, states(), goal), expected)
    assert sum(array.nbytes for array in arrays.values()) < 60_000
    for array in arrays.values():
        array[...] = 0
    assert torch.equal(learner(visual, states(), goal), expected)


def test_acting_state_of_an_unfrozen_encoder_brings_its_backbone() -> None:
    learner, worker = build(seed=1, frozen=False).eval(), build(seed=2, frozen=False).eval()
    worker.load_acting_state(learner.acting_state())
    assert worker.backbone_hash() == learner.backbone_hash()
    assert torch.equal(worker(pictures(), states(), no_goal()), learner(pictures(), states(), no_goal()))


def test_acting_state_of_another_encoder_is_refused() -> None:
    with pytest.raises(ValueError, match="gate_logits"):
        build().load_acting_state(build(goal=True).acting_state())
    with pytest.raises(ValueError, match=r"perception\.slots"):
        build().load_acting_state(build(num_slots=3).acting_state())


def test_state_statistics_standardise_and_spare_constant_dimensions() -> None:
    encoder = build(fusion="state_only")
    mean, std = torch.arange(35.0), torch.full((35,), 4.0)
    std[3] = 0.0
    encoder.set_state_statistics(mean, std)
    latent = encoder(torch.empty(1, 0), (mean + 2.0).unsqueeze(0), no_goal(1))[0]
    expected = torch.full((35,), 0.5)
    expected[3] = 2.0
    assert torch.equal(latent, expected)


def test_weights_follow_the_seed_and_leave_the_global_generator_alone() -> None:
    before = torch.get_rng_state()
    first, again, other = (build(seed=seed).state_dict() for seed in (0, 0, 1))
    assert torch.equal(torch.get_rng_state(), before)
    assert all(np.array_equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["perception.slots"], other["perception.slots"])
