"""How well a perception network understands labelled frames (Section 5.2, Figure 3)."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from slotfilm_dist.learning.auroc import auroc
from slotfilm_dist.learning.perception_losses import attention_loss, attention_share, best_matching, visibility_loss
from slotfilm_dist.nets.perception import Perception


@dataclass(frozen=True, kw_only=True, slots=True)
class PerceptionQuality:
    """Errors over a set of frames. A figure that the frames leave undefined is NaN."""

    position_error_px: float
    """Mean distance of predicted and true position over visible objects under the best matching, in pixels."""
    baseline_error_px: float
    """The same, matched the same way, for a prediction that ignores the picture."""
    attention_nll: float
    """Minus the log of the attention on each visible object, summed over slots and clamped to one, in nats."""
    attention_share: float
    """Mean attention on the visible objects' tokens, summed over slots and clamped to one."""
    visibility_bce: float
    """Binary cross-entropy of visibility, in nats."""
    visibility_auroc: float
    """AUROC of visibility, averaged over the objects that are in view in some frames but not in all."""

    def metrics(self) -> dict[str, float]:
        """The figures that are declared as metrics of pre-training, without those that are undefined."""
        values = {
            "pretrain_position_error_px": self.position_error_px,
            "pretrain_baseline_error_px": self.baseline_error_px,
            "pretrain_visibility_auroc": self.visibility_auroc,
            "pretrain_attention_share": self.attention_share,
        }
        return {name: value for name, value in values.items() if math.isfinite(value)}


def strongest_slots(attention: Float[np.ndarray, "frames slots tokens"], count: int) -> list[int]:
    """The slots with the highest mean peak of attention, in their own order (Figure 14)."""
    peaks = attention.max(axis=2).mean(axis=0)
    return sorted(np.argsort(-peaks, kind="stable")[:count].tolist())


def only_slots(perception: Perception, slots: list[int], *, matched_visibility: bool) -> Perception:
    """What these slots alone see."""
    return Perception(
        slots=perception.slots[:, slots],
        attention=perception.attention[:, slots],
        uv=perception.uv[:, slots],
        visible_logits=perception.visible_logits[:, slots] if matched_visibility else perception.visible_logits,
    )


@torch.no_grad()
def perception_quality(
    perception: Perception,
    uv: Float[Tensor, "batch objects 2"],
    visible: Bool[Tensor, "batch objects"],
    baseline_uv: Float[Tensor, "objects 2"],
    *,
    image_size: int,
    matched_visibility: bool,
) -> PerceptionQuality:
    """Compare what the network sees with the labels: all its slots, of which none should be surplus.

    A surplus slot would be chosen with the labels, as a guess at random is the nearer the more there are of it; leave
    the `strongest_slots`, one an object, which needs no label (Section 7.3).

    Args:
        perception: of the frames.
        uv: true positions in image units.
        visible: which objects are in view.
        baseline_uv: the prediction that ignores the picture, in image units.
        image_size: pixels of a picture's side.
        matched_visibility: the visibility head gives one logit per slot.
    """
    _, matching = best_matching(perception.uv, uv, visible)
    matched = matching if matched_visibility else None
    logits = perception.visible_logits if matched is None else perception.visible_logits.gather(1, matched)
    share = attention_share(perception.attention, uv, "sum_clamped")[visible]
    return PerceptionQuality(
        position_error_px=image_size * _mean_distance(perception.uv, uv, visible),
        baseline_error_px=image_size * _mean_distance(baseline_uv.expand(len(uv), -1, -1), uv, visible),
        attention_nll=float(attention_loss(perception.attention, uv, visible, "sum_clamped")),
        attention_share=float(share.mean()),
        visibility_bce=float(visibility_loss(perception.visible_logits, visible, matched)),
        visibility_auroc=_mean_auroc(logits.cpu().numpy(), visible.cpu().numpy()),
    )


def _mean_distance(
    predicted: Float[Tensor, "batch predictions 2"],
    uv: Float[Tensor, "batch objects 2"],
    visible: Bool[Tensor, "batch objects"],
) -> float:
    """Mean distance over visible objects under the best matching, in image units; NaN if none is visible."""
    _, matching = best_matching(predicted, uv, visible)
    at_objects = predicted.gather(1, matching.unsqueeze(2).expand(-1, -1, 2))
    return float((at_objects - uv).norm(dim=2)[visible].mean())


def _mean_auroc(scores: Float[np.ndarray, "batch objects"], labels: Bool[np.ndarray, "batch objects"]) -> float:
    values = [auroc(scores[:, k], labels[:, k]) for k in range(labels.shape[1])]
    defined = [value for value in values if math.isfinite(value)]
    return sum(defined) / len(defined) if defined else math.nan
