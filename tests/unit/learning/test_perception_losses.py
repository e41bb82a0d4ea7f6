"""The pre-training losses against cases worked out by hand."""

import math

import pytest
import torch

from slotfilm_dist.config import PretrainConfig
from slotfilm_dist.learning.perception_losses import (
    attention_loss,
    attention_share,
    position_loss,
    pretrain_losses,
    visibility_loss,
)
from slotfilm_dist.nets.perception import Perception

NAN = math.nan
BOTH = torch.tensor([[True, True]])


def test_position_loss_takes_the_cheaper_of_two_matchings() -> None:
    predicted = torch.tensor([[[0.9, 0.9], [0.1, 0.2]]])
    uv = torch.tensor([[[0.1, 0.1], [0.9, 0.7]]])
    loss, matching = position_loss(predicted, uv, BOTH)
    assert matching.tolist() == [[1, 0]]
    assert loss.item() == pytest.approx((0.1**2 + 0.2**2) / 2)


def test_position_loss_is_the_same_whatever_the_order_of_the_slots() -> None:
    generator = torch.Generator().manual_seed(0)
    predicted, uv = torch.rand(6, 4, 2, generator=generator), torch.rand(6, 2, 2, generator=generator)
    visible = torch.rand(6, 2, generator=generator) < 0.7
    loss, matching = position_loss(predicted, uv, visible)
    order = torch.tensor([2, 0, 3, 1])
    shuffled_loss, shuffled = position_loss(predicted[:, order], uv, visible)
    assert shuffled_loss.item() == pytest.approx(loss.item())
    assert torch.equal(order[shuffled][visible], matching[visible])


def test_surplus_slots_may_take_an_object_but_never_two() -> None:
    predicted = torch.tensor([[[0.0, 0.0], [0.5, 0.5], [1.0, 1.0]]])
    uv = torch.tensor([[[0.5, 0.5], [0.5, 0.4]]])
    loss, matching = position_loss(predicted, uv, BOTH)
    assert matching.tolist() == [[1, 0]]
    assert loss.item() == pytest.approx((0.0 + 0.25 + 0.16) / 2)


def test_position_loss_divides_by_the_visible_objects_of_the_batch() -> None:
    predicted = torch.zeros(3, 2, 2, requires_grad=True)
    uv = torch.tensor([[[0.3, 0.0], [0.0, 0.6]], [[0.5, 0.0], [NAN, NAN]], [[NAN, 0.0], [math.inf, 0.0]]])
    visible = torch.tensor([[True, True], [True, False], [False, False]])
    loss, _ = position_loss(predicted, uv, visible)
    assert loss.item() == pytest.approx((0.09 + 0.36 + 0.25) / 3)
    loss.backward()
    assert predicted.grad is not None
    assert torch.isfinite(predicted.grad).all()
    assert not predicted.grad[2].any()


def test_batch_without_a_visible_object_has_no_position_and_no_attention_loss() -> None:
    hidden, uv = torch.zeros(2, 2, dtype=torch.bool), torch.full((2, 2, 2), NAN)
    assert position_loss(torch.zeros(2, 2, 2), uv, hidden)[0].item() == 0.0
    assert attention_loss(torch.full((2, 2, 4), 0.25), uv, hidden, "sum_clamped").item() == 0.0


def test_visibility_loss_reads_matched_slots_or_one_logit_per_object() -> None:
    visible = torch.tensor([[True, False]])
    per_object = visibility_loss(torch.tensor([[2.0, -1.0]]), visible, None)
    assert per_object.item() == pytest.approx((math.log1p(math.exp(-2)) + math.log1p(math.exp(-1))) / 2)
    per_slot = visibility_loss(torch.tensor([[9.0, -1.0, 2.0]]), visible, torch.tensor([[2, 1]]))
    assert per_slot.item() == pytest.approx(per_object.item())


@pytest.mark.parametrize(("reduce", "expected"), [("sum", 1.3), ("sum_clamped", 1.0), ("mean", 0.65)])
def test_attention_share_is_read_at_the_token_under_the_object(reduce: str, expected: float) -> None:
    attention = torch.zeros(1, 2, 64)
    row, col = 6, 3
    attention[0, :, 8 * row + col] = torch.tensor([0.9, 0.4])
    uv = torch.tensor([[[(col + 0.99) / 8, (row + 0.01) / 8], [0.0, 0.0]]])
    share = attention_share(attention, uv, reduce)
    torch.testing.assert_close(share, torch.tensor([[expected, 0.0]]))


def test_positions_on_the_border_belong_to_the_last_token() -> None:
    attention = torch.zeros(1, 1, 64)
    attention[0, 0, 63] = 1.0
    share = attention_share(attention, torch.tensor([[[1.0, 1.0], [1.7, 1.2]]]), "sum")
    assert share.tolist() == [[1.0, 1.0]]


def test_attention_loss_is_the_mean_log_over_visible_objects_only() -> None:
    attention = torch.full((2, 2, 64), 1 / 64)
    uv = torch.full((2, 2, 2), 0.5)
    visible = torch.tensor([[True, False], [False, False]])
    assert attention_loss(attention, uv, visible, "sum_clamped").item() == pytest.approx(math.log(32))


def test_total_weighs_its_parts_and_pixels_scale_only_the_position() -> None:
    perception = Perception(
        slots=torch.zeros(1, 2, 42),
        attention=torch.full((1, 2, 64), 1 / 64),
        uv=torch.tensor([[[0.2, 0.2], [0.8, 0.8]]]),
        visible_logits=torch.zeros(1, 2),
    )
    uv = torch.tensor([[[0.2, 0.3], [0.8, 0.8]]])
    for units, position in (("unit", 0.005), ("pixels", 0.005 * 128**2)):
        config = PretrainConfig(uv_units=units, lambda_pos=2.0, lambda_vis=3.0, lambda_attn=5.0)
        losses = pretrain_losses(perception, uv, BOTH, config, image_size=128, matched_visibility=False)
        assert losses.position.item() == pytest.approx(position, rel=1e-4)
        total = 2 * position + 3 * math.log(2) + 5 * math.log(32)
        assert losses.total.item() == pytest.approx(total, rel=1e-4)
