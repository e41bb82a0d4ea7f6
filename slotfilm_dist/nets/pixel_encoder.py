"""Convolutional encoders of the pixel baselines (Section 5.1, Appendix A.5): a plain CNN, DrQ-v1's and DrQ-v2's.

All have four 3 x 3 convolutions of 32 filters with ReLU and see one picture, without padding; what follows differs:

kind    strides     after the convolutions               picture scaled to  source
cnn     2, 2, 2, 2  linear projection                    [0, 1]             Section 5.1: "a four-layer CNN with ReLU
                                                                            activations and linear projection"
drq     2, 1, 1, 1  linear to 50, LayerNorm, tanh        [0, 1]             Kostrikov et al. 2020, appendix on the
                                                                            network architecture
drqv2   2, 1, 1, 1  nothing: actor and critic bring a    [-0.5, 0.5]        Yarats et al. 2021, Section 3.1, "Image
                    trunk each, `deterministic_heads`                       encoder"

Weights are orthogonal, with gain sqrt(2) in front of a ReLU, and biases zero, as both DrQ papers' code has it.

Departures from the published encoders:
- One picture instead of three stacked ones, and no action repeat: replay and the other agents of this study have one
  ("minor adaptations for the ManiSkill3 observation space", Section 5.1).
- 128 x 128 pixels instead of 84 x 84, so the last map of drq and drqv2 is 57 x 57 instead of 35 x 35.
- DrQ-v1's actor and target critic have projections of their own. Here one latent serves actor, critics and value
  network, "only the visual encoder and input representation differ across methods" (Section 5.1), and the critics'
  gradient alone trains it.
- The study's own text names neither strides nor widths of its CNN: they are chosen here. The projection is as wide as
  the slots' latent, so that actor and critics have exactly the proposed agent's sizes.
- `concat_late` appends the state to the latent, which no publication does: it makes the baselines' input that of the
  proposed agent.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor, nn

from slotfilm_dist.config import EncoderConfig, ObsConfig
from slotfilm_dist.nets.hand_over import HandedOver
from slotfilm_dist.nets.initialization import orthogonal_conv, orthogonal_linear
from slotfilm_dist.nets.interface import VisualKind

_KERNEL = 3
_STRIDES = {"cnn": (2, 2, 2, 2), "drq": (2, 1, 1, 1), "drqv2": (2, 1, 1, 1)}


class PixelEncoder(HandedOver):
    """Latent of pictures and, with `encoder.fusion = concat_late`, of the state; see `interface.Encoder`.

    Args:
        encoder: what is built.
        obs: size of the state.
        image_size: height and width of the pictures in pixels.
        seed: of every weight.
    """

    def __init__(self, encoder: EncoderConfig, obs: ObsConfig, image_size: int, *, seed: int = 0) -> None:
        super().__init__(obs.state_dim)
        assert encoder.learns_from_pixels, "the slots have an encoder of their own"
        generator = torch.Generator().manual_seed(seed)
        self.config = encoder
        self.convolutions = nn.ModuleList(
            orthogonal_conv(encoder.conv_channels if i else 3, encoder.conv_channels, _KERNEL, stride, generator)
            for i, stride in enumerate(_STRIDES[encoder.kind])
        )
        size = image_size
        for stride in _STRIDES[encoder.kind]:
            size = (size - _KERNEL) // stride + 1
        flat = encoder.conv_channels * size * size
        self.projection: nn.Linear | None = None
        if encoder.kind != "drqv2":
            self.projection = orthogonal_linear(flat, encoder.feature_dim, generator)
        self.norm = nn.LayerNorm(encoder.feature_dim) if encoder.kind == "drq" else None
        self.visual_dim = flat if self.projection is None else encoder.feature_dim
        """Size of the latent's part that comes from the picture."""
        self.state_dim = obs.state_dim if encoder.uses_state else 0
        """Size of the latent's part that is the state."""

    @property
    def visual_kind(self) -> VisualKind:
        """Pictures: what sees them never stops learning."""
        return "rgb"

    @property
    def latent_dim(self) -> int:
        """Size of the latent."""
        return self.visual_dim + self.state_dim

    def to_visual(self, rgb: UInt8[Tensor, "batch height width 3"]) -> UInt8[Tensor, "batch height width 3"]:
        """The pictures themselves."""
        return rgb

    def forward(
        self,
        visual: Shaped[Tensor, "batch height width 3"],
        proprio: Float[Tensor, "batch proprio"],
        goal: Float[Tensor, "batch 3"],
    ) -> Float[Tensor, "batch latent"]:
        """The latent that actor and critics read.

        Args:
            visual: pictures in [0, 255], uint8 or, once shifted by parts of a pixel, float32.
            proprio: the state, in its own units; left out unless `encoder.fusion = concat_late`.
            goal: not seen by these baselines.
        """
        hidden = visual.permute(0, 3, 1, 2).float() / 255.0
        if self.config.kind == "drqv2":
            hidden = hidden - 0.5
        for convolution in self.convolutions:
            hidden = F.relu(convolution(hidden))
        latent = hidden.flatten(1)
        if self.projection is not None:
            latent = self.projection(latent)
        if self.norm is not None:
            latent = torch.tanh(self.norm(latent))
        if self.state_dim == 0:
            return latent
        return torch.cat((latent, self.standardise(proprio)), dim=1)

    def freeze_backbone(self) -> None:
        """Nothing: no part of it is fixed in RL."""

    def fusion_parameters(self) -> list[nn.Parameter]:
        """Every weight: the whole encoder learns in RL."""
        return list(self.parameters())

    def gate_parameters(self) -> list[nn.Parameter]:
        """None: there is no goal query."""
        return []

    def backbone_parameters(self) -> list[nn.Parameter]:
        """None: nothing was trained before."""
        return []

    def head_parameters(self) -> list[nn.Parameter]:
        """None: there is no pre-training."""
        return []

    def diagnostics(self, proprio: Float[Tensor, "batch proprio"]) -> dict[str, Float[Tensor, ""]]:
        """None: there is no modulation."""
        return {}

    def backbone_hash(self) -> str:
        """Empty: replay holds pictures, which belong to no weights."""
        return ""
