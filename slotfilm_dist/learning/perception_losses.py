"""The three losses of slot pre-training (Section 4.3).

Position and attention are masked by visibility and divided by the number of visible objects in the batch, so that
frames in which little is to be seen do not count for less per object; visibility itself is judged for every object.
Objects out of view may carry any position, also one that is not finite.
"""

import functools
import itertools
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from slotfilm_dist.config import PretrainConfig
from slotfilm_dist.nets.perception import Perception

_SMALLEST_SHARE = 1e-8


def best_matching(
    uv_predicted: Float[Tensor, "batch slots 2"],
    uv: Float[Tensor, "batch objects 2"],
    visible: Bool[Tensor, "batch objects"],
) -> tuple[Float[Tensor, " batch"], Int[Tensor, "batch objects"]]:
    """Least sum of squared errors over one-to-one assignments of objects to slots (L_pos, Section 4.3).

    Returns:
        Each sample's least sum over its visible objects, and the slot of each object in that assignment.
    """
    num_slots, num_objects = uv_predicted.shape[1], uv.shape[1]
    assert num_slots >= num_objects, "every object needs a slot of its own"
    target = torch.where(visible.unsqueeze(2), uv, 0.5)
    error = (target.unsqueeze(2) - uv_predicted.unsqueeze(1)).square().sum(3) * visible.unsqueeze(2)
    assignments = _assignments(num_slots, num_objects, uv.device)
    sums = error[:, torch.arange(num_objects, device=uv.device), assignments].sum(2)
    least, best = sums.min(dim=1)
    return least, assignments[best]


@functools.cache
def _assignments(num_slots: int, num_objects: int, device: torch.device) -> Int[Tensor, "assignments objects"]:
    """Every way to give each object a slot of its own; kept, for a CUDA graph cannot bring it to the GPU."""
    return torch.tensor(list(itertools.permutations(range(num_slots), num_objects)), device=device)


def position_loss(
    uv_predicted: Float[Tensor, "batch slots 2"],
    uv: Float[Tensor, "batch objects 2"],
    visible: Bool[Tensor, "batch objects"],
) -> tuple[Float[Tensor, ""], Int[Tensor, "batch objects"]]:
    """Best-of-N position error per visible object (L_pos, Section 4.3), in squared units of `uv`, and the matching."""
    least, matching = best_matching(uv_predicted, uv, visible)
    return least.sum() / _num_visible(visible), matching


def visibility_loss(
    logits: Float[Tensor, "batch logits"],
    visible: Bool[Tensor, "batch objects"],
    matching: Int[Tensor, "batch objects"] | None,
) -> Float[Tensor, ""]:
    """Mean binary cross-entropy of being in view (L_vis, Section 4.3), in nats.

    Args:
        logits: one per object, or one per slot where a matching is given.
        visible: the label.
        matching: slot of each object, to read its logit there; None for one logit per object.
    """
    of_objects = logits if matching is None else logits.gather(1, matching)
    return F.binary_cross_entropy_with_logits(of_objects, visible.to(logits.dtype))


def attention_share(
    attention: Float[Tensor, "batch slots tokens"], uv: Float[Tensor, "batch objects 2"], reduce: str
) -> Float[Tensor, "batch objects"]:
    """Attention p on the token at each object's position (L_attn's p, Section 4.3).

    Args:
        attention: each slot's weights; they add up to one over tokens.
        uv: positions in image units; outside [0, 1] the nearest border token counts.
        reduce: over slots: `sum` as printed, which can exceed one, `sum_clamped` to at most one, or `mean`.
    """
    size = round(attention.shape[2] ** 0.5)
    cells = (uv.nan_to_num(0.5) * size).floor().clamp(0, size - 1).long()
    index = (cells[:, :, 1] * size + cells[:, :, 0]).unsqueeze(1).expand(-1, attention.shape[1], -1)
    at_objects = attention.gather(2, index)
    if reduce == "mean":
        return at_objects.mean(1)
    total = at_objects.sum(1)
    return total.clamp(max=1.0) if reduce == "sum_clamped" else total


def attention_loss(
    attention: Float[Tensor, "batch slots tokens"],
    uv: Float[Tensor, "batch objects 2"],
    visible: Bool[Tensor, "batch objects"],
    reduce: str,
) -> Float[Tensor, ""]:
    """Minus the log of the attention on each visible object (L_attn, Section 4.3), in nats per visible object."""
    share = attention_share(attention, uv, reduce).clamp(min=_SMALLEST_SHARE)
    return -(share.log() * visible).sum() / _num_visible(visible)


@dataclass(frozen=True, kw_only=True, slots=True)
class PretrainLosses:
    """The parts of the pre-training loss, unweighted, and their weighted sum."""

    total: Float[Tensor, ""]
    position: Float[Tensor, ""]
    visibility: Float[Tensor, ""]
    attention: Float[Tensor, ""]


def pretrain_losses(
    perception: Perception,
    uv: Float[Tensor, "batch objects 2"],
    visible: Bool[Tensor, "batch objects"],
    config: PretrainConfig,
    *,
    image_size: int,
    matched_visibility: bool,
) -> PretrainLosses:
    """L_pre = lambda_pos L_pos + lambda_vis L_vis + lambda_attn L_attn (Section 4.3).

    Args:
        perception: the network's view of a batch.
        uv: objects' positions in image units.
        visible: which objects are in view.
        config: weights and readings of the three losses.
        image_size: pixels of a picture's side, for `pretrain.uv_units = pixels`.
        matched_visibility: the visibility head gives one logit per slot (`encoder.vis_head = matched`).
    """
    unit = image_size if config.uv_units == "pixels" else 1
    position, matching = position_loss(perception.uv * unit, uv * unit, visible)
    visibility = visibility_loss(perception.visible_logits, visible, matching if matched_visibility else None)
    attention = attention_loss(perception.attention, uv, visible, config.attn_reduce)
    total = config.lambda_pos * position + config.lambda_vis * visibility + config.lambda_attn * attention
    return PretrainLosses(total=total, position=position, visibility=visibility, attention=attention)


def _num_visible(visible: Bool[Tensor, "batch objects"]) -> Float[Tensor, ""]:
    """Visible objects in the batch, at least one, so that an empty batch has loss zero."""
    return visible.sum().clamp(min=1).float()
