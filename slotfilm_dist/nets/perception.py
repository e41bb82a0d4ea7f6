"""From a picture to slots: backbone, tokens, slot attention and the heads of pre-training (Sections 4.1 and 4.3)."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from slotfilm_dist.config import EncoderConfig
from slotfilm_dist.machine import takes_bfloat16
from slotfilm_dist.nets.attention import FoldedSlotAttention
from slotfilm_dist.nets.backbone import FEATURE_CHANNELS, STRIDE, Backbone
from slotfilm_dist.nets.initialization import seeded_head, seeded_linear, seeded_normal


@dataclass(frozen=True, kw_only=True, slots=True)
class Perception:
    """What the network sees in a batch of pictures."""

    slots: Float[Tensor, "batch slots dim"]
    """Features gathered by each slot."""
    attention: Float[Tensor, "batch slots tokens"]
    """Where each slot looks, averaged over heads."""
    uv: Float[Tensor, "batch slots 2"]
    """Position that each slot predicts, in image units in [0, 1]."""
    visible_logits: Float[Tensor, "batch logits"]
    """Logits of being in view: one per object (`encoder.vis_head = pooled`) or one per slot (`matched`)."""


class PerceptionNetwork(nn.Module):
    """Backbone, 1x1 projection to tokens, slot attention, UV and visibility heads.

    The learned positional code is a row vector beside a column vector, each half of the channels wide.
    """

    def __init__(self, config: EncoderConfig, num_objects: int, image_size: int, generator: torch.Generator) -> None:
        super().__init__()
        dim, hidden = config.feature_dim, config.head_hidden
        self.image_size, self.grid_size = image_size, image_size // STRIDE
        self.pos_scale, self.matched_visibility = config.pos_scale, config.vis_head == "matched"
        self.frozen = False
        """Backbone and projection never change again, and BatchNorm stays in eval mode."""
        self._half = takes_bfloat16(config.frozen_precision)
        self.backbone = Backbone(generator)
        self.projection = seeded_linear(FEATURE_CHANNELS, dim, generator)
        self.row_code = seeded_normal(self.grid_size, dim // 2, generator=generator)
        self.col_code = seeded_normal(self.grid_size, dim // 2, generator=generator)
        self.slots = seeded_normal(config.num_slots, dim, generator=generator)
        self.attention = FoldedSlotAttention(dim, config.num_heads, generator, config.slot_normalize)
        self.uv_head = seeded_head(dim, hidden, 2, generator)
        self.vis_head = seeded_head(dim, hidden, 1 if self.matched_visibility else num_objects, generator)

    def tokens(self, rgb: UInt8[Tensor, "batch height width 3"]) -> Float[Tensor, "batch tokens dim"]:
        """The projected feature map, before the positional code: all that a frozen backbone contributes."""
        return self.projection(self.frozen_features(rgb) if self.frozen else self.backbone(rgb))

    def frozen_features(self, rgb: UInt8[Tensor, "batch height width 3"]) -> Float[Tensor, "batch tokens channels"]:
        """What a backbone that does not change makes of pictures, in `encoder.frozen_precision`."""
        if not self._half or rgb.is_cuda:
            return self.backbone(rgb)
        with torch.autocast("cpu", torch.bfloat16, cache_enabled=False):
            return self.backbone(rgb).float()

    def code(self) -> Float[Tensor, "tokens dim"]:
        """The scaled positional code lambda P of every token."""
        size = self.grid_size
        rows = self.row_code.unsqueeze(1).expand(size, size, -1)
        cols = self.col_code.unsqueeze(0).expand(size, size, -1)
        return self.pos_scale * torch.cat((rows, cols), dim=2).flatten(0, 1)

    def forward(self, tokens: Float[Tensor, "batch tokens dim"]) -> Perception:
        """Slots, attention and the heads' predictions."""
        slots, attention = self.attention(self.slots, tokens, self.code())
        visible = self.vis_head(slots).squeeze(2) if self.matched_visibility else self.vis_head(slots.mean(1))
        return Perception(slots=slots, attention=attention, uv=self.uv_head(slots).sigmoid(), visible_logits=visible)

    def pooled(self, tokens: Float[Tensor, "batch tokens dim"]) -> Float[Tensor, "batch dim"]:
        """Mean of the slots, whatever their order (Section 4.1.3)."""
        return self.attention.pooled(self.slots, tokens, self.code())

    def goal_feature(
        self, tokens: Float[Tensor, "batch tokens dim"], uv: Float[Tensor, "batch 2"]
    ) -> Float[Tensor, "batch dim"]:
        """Output of a query that is the feature map's value at the goal, interpolated bilinearly (Section 4.1.1).

        A position outside the picture, or one that is not finite, is taken to the border.
        """
        feature_map = tokens.transpose(1, 2).unflatten(2, (self.grid_size, self.grid_size))
        where = (2.0 * uv - 1.0).view(-1, 1, 1, 2)
        query = F.grid_sample(feature_map, where, padding_mode="border", align_corners=False).flatten(1)
        return self.attention.one_query_each(query, tokens, self.code())

    def freeze_backbone(self) -> None:
        """Fix backbone and projection for good."""
        self.frozen = True
        self.backbone.eval().requires_grad_(False)
        self.projection.requires_grad_(False)

    def train(self, mode: bool = True) -> "PerceptionNetwork":
        """Switch the mode of everything that is not frozen."""
        super().train(mode)
        if self.frozen:
            self.backbone.eval()
        return self

    def backbone_parameters(self) -> list[nn.Parameter]:
        """Backbone and 1x1 projection."""
        return [*self.backbone.parameters(), *self.projection.parameters()]

    def slot_parameters(self) -> list[nn.Parameter]:
        """Slots, positional code and attention."""
        return [self.slots, self.row_code, self.col_code, *self.attention.parameters()]

    def head_parameters(self) -> list[nn.Parameter]:
        """UV and visibility heads."""
        return [*self.uv_head.parameters(), *self.vis_head.parameters()]
