"""The state-guided slot encoder: perception, optional goal, state fusion (Section 4; 2,829,390 parameters)."""

import torch
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor, nn

from slotfilm_dist.config import EncoderConfig, ObsConfig
from slotfilm_dist.nets.backbone import load_initial_weights, weights_hash
from slotfilm_dist.nets.fusion import StateFusion
from slotfilm_dist.nets.hand_over import HandedOver
from slotfilm_dist.nets.interface import VisualKind
from slotfilm_dist.nets.perception import Perception, PerceptionNetwork

_BACKBONE_PREFIXES = ("perception.backbone.", "perception.projection.")
_HEAD_PREFIXES = ("perception.uv_head.", "perception.vis_head.")


class SlotFusionEncoder(HandedOver):
    """Latent of pictures (or their tokens), state and goal; see `interface.Encoder`.

    Args:
        encoder: what is built.
        obs: size of the state and number of objects.
        image_size: height and width of the pictures in pixels, a multiple of 16.
        seed: of every weight that is drawn.
        fetch_weights: fill the backbone as `encoder.backbone` asks; False where a checkpoint fills it right after.

    Raises:
        ValueError: the backbone's weights cannot be had.
    """

    def __init__(
        self,
        encoder: EncoderConfig,
        obs: ObsConfig,
        image_size: int,
        *,
        seed: int = 0,
        fetch_weights: bool = True,
    ) -> None:
        super().__init__(obs.state_dim)
        generator = torch.Generator().manual_seed(seed)
        self.config = encoder
        self.perception: PerceptionNetwork | None = None
        self.fusion: StateFusion | None = None
        self.gate_logits: nn.Parameter | None = None
        if encoder.uses_image:
            self.perception = PerceptionNetwork(encoder, obs.num_objects, image_size, generator)
            self.fusion = StateFusion(encoder.fusion, encoder.feature_dim, obs.state_dim, generator)
            if encoder.goal:
                self.gate_logits = nn.Parameter(torch.zeros(2))
            if fetch_weights:
                load_initial_weights(self.perception.backbone, encoder)
        self._latent_dim = self.fusion.latent_dim if self.fusion else obs.state_dim

    @property
    def visual_kind(self) -> VisualKind:
        """Tokens once the backbone is frozen, pictures while it can change, nothing without a camera."""
        if self.perception is None:
            return "none"
        return "tokens" if self.perception.frozen else "rgb"

    @property
    def latent_dim(self) -> int:
        """Size of the latent, which follows from the fusion."""
        return self._latent_dim

    def tokens(self, rgb: UInt8[Tensor, "batch height width 3"]) -> Float[Tensor, "batch tokens dim"]:
        """The projected feature map, before the positional code."""
        return self._seeing().tokens(rgb)

    @torch.no_grad()
    def to_visual(self, rgb: UInt8[Tensor, "batch height width 3"]) -> Shaped[Tensor, "batch *visual"]:
        """What replay keeps of pictures: tokens float16, the pictures themselves, or an empty [batch, 0]."""
        match self.visual_kind:
            case "tokens":
                return self.tokens(rgb).half()
            case "rgb":
                return rgb
            case "none":
                return rgb.new_empty((len(rgb), 0))

    def perceive(self, tokens: Float[Tensor, "batch tokens dim"]) -> Perception:
        """Slots, attention, positions and visibility."""
        return self._seeing()(tokens.float())

    def forward(
        self,
        visual: Shaped[Tensor, "batch *visual"],
        proprio: Float[Tensor, "batch proprio"],
        goal: Float[Tensor, "batch 3"],
    ) -> Float[Tensor, "batch latent"]:
        """The latent that actor and critics read.

        Args:
            visual: tokens [batch, 64, 42] as `tokens` makes them, or uint8 pictures [batch, height, width, 3].
            proprio: the state, in its own units.
            goal: its projection u, v in image units and 1 if in view, else 0; ignored without `encoder.goal`.
        """
        state = self.standardise(proprio)
        if self.perception is None or self.fusion is None:
            return state
        tokens = self.tokens(visual) if visual.dtype == torch.uint8 else visual.float()
        pooled = self.perception.pooled(tokens)
        if self.gate_logits is not None:
            pooled = self._gated(pooled, tokens, goal, self.perception, self.gate_logits)
        return self.fusion(pooled, state)

    def _gated(
        self,
        pooled: Float[Tensor, "batch dim"],
        tokens: Float[Tensor, "batch tokens dim"],
        goal: Float[Tensor, "batch 3"],
        perception: PerceptionNetwork,
        gate_logits: Float[Tensor, "2"],
    ) -> Float[Tensor, "batch dim"]:
        """Slots and goal mixed by the softmax gate of Section 4.1.3; slots alone while the goal is out of view."""
        in_view = goal[:, 2:] > 0.5
        bias = torch.where(in_view, 0.0, self.config.goal_out_of_view_bias)
        shares = (gate_logits + torch.cat((torch.zeros_like(bias), bias), dim=1)).softmax(1)
        return shares[:, :1] * pooled + shares[:, 1:] * perception.goal_feature(tokens, goal[:, :2])

    def freeze_backbone(self) -> None:
        """Fix backbone and projection; from now on the encoder works on tokens and BatchNorm stays in eval mode."""
        if self.perception is not None:
            self.perception.freeze_backbone()

    def fusion_parameters(self) -> list[nn.Parameter]:
        """Slots, positional code, attention and state fusion: what RL fine-tunes."""
        if self.perception is None or self.fusion is None:
            return []
        return [*self.perception.slot_parameters(), *self.fusion.parameters()]

    def gate_parameters(self) -> list[nn.Parameter]:
        """The goal gate's two logits."""
        return [] if self.gate_logits is None else [self.gate_logits]

    def backbone_parameters(self) -> list[nn.Parameter]:
        """Backbone and 1x1 projection."""
        return [] if self.perception is None else self.perception.backbone_parameters()

    def head_parameters(self) -> list[nn.Parameter]:
        """UV and visibility heads."""
        return [] if self.perception is None else self.perception.head_parameters()

    @torch.no_grad()
    def diagnostics(self, proprio: Float[Tensor, "batch proprio"]) -> dict[str, Float[Tensor, ""]]:
        """How strongly the state modulates the latent, and the goal's share in it, for states in their own units."""
        found: dict[str, Tensor] = {}
        if self.fusion is not None and self.fusion.has_film:
            gain, shift = self.fusion.modulation(self.standardise(proprio))
            found |= {"learner_film_gain": gain.abs().mean(), "learner_film_shift": shift.abs().mean()}
        if self.gate_logits is not None:
            found["learner_goal_gate"] = self.gate_logits.softmax(0)[1]
        return found

    def backbone_hash(self) -> str:
        """Hash of everything that determines the tokens: backbone, its BatchNorm statistics and the projection."""
        state = self.state_dict()
        made_by = [(name, value) for name, value in state.items() if name.startswith(_BACKBONE_PREFIXES)]
        return weights_hash(made_by) if made_by else ""

    def _acting_tensors(self) -> dict[str, Tensor]:
        """Fusion, gate and state statistics; the backbone unless frozen; the heads never act."""
        unused = _HEAD_PREFIXES + (_BACKBONE_PREFIXES if self.visual_kind == "tokens" else ())
        return {name: value for name, value in self.state_dict().items() if not name.startswith(unused)}

    def _seeing(self) -> PerceptionNetwork:
        assert self.perception is not None, "encoder.fusion = 'state_only' has no camera"
        return self.perception
