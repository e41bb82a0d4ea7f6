"""What the rest of the system asks of an encoder, whatever is inside it."""

from collections.abc import Mapping
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor, nn

VisualKind = Literal["tokens", "rgb", "none"]
"""What replay keeps of a picture: a frozen backbone's tokens, the picture itself, or nothing."""


@runtime_checkable
class Encoder(Protocol):
    """Turns an observation into the latent of actor and critics; a `nn.Module`.

    Worker and learner use it like this:

        visual = encoder.to_visual(rgb)                    # once per frame; replay keeps it
        latent = encoder(visual, proprio, goal)            # as often as wanted
        arrays = encoder.acting_state()                    # learner, for a WeightSnapshot
        worker_encoder.load_acting_state(arrays)           # worker
    """

    @property
    def visual_kind(self) -> VisualKind:
        """What `to_visual` returns and `forward` takes."""
        ...

    @property
    def latent_dim(self) -> int:
        """Size of the latent."""
        ...

    def to_visual(self, rgb: UInt8[Tensor, "batch height width 3"]) -> Shaped[Tensor, "batch *visual"]:
        """What replay keeps of pictures: tokens float16, the pictures, or an empty [batch, 0]; without gradient."""
        ...

    def __call__(
        self,
        visual: Shaped[Tensor, "batch *visual"],
        proprio: Float[Tensor, "batch proprio"],
        goal: Float[Tensor, "batch 3"],
    ) -> Float[Tensor, "batch latent"]:
        """The latent; `goal` is its projection u, v in image units and 1 if in view, else 0."""
        ...

    def fusion_parameters(self) -> list[nn.Parameter]:
        """Trained in RL with `lr.fusion`."""
        ...

    def gate_parameters(self) -> list[nn.Parameter]:
        """Trained in RL with `lr.goal_gate`; empty without a goal."""
        ...

    def backbone_parameters(self) -> list[nn.Parameter]:
        """Trained in RL with `lr.backbone`, if at all."""
        ...

    def head_parameters(self) -> list[nn.Parameter]:
        """Heads that only pre-training's losses reach."""
        ...

    def diagnostics(self, proprio: Float[Tensor, "batch proprio"]) -> dict[str, Float[Tensor, ""]]:
        """What is worth watching inside it, by the metrics' names."""
        ...

    def backbone_hash(self) -> str:
        """Names the weights that made the tokens; empty where there are none."""
        ...

    def acting_state(self) -> dict[str, np.ndarray]:
        """Copies of what RL changes and acting needs."""
        ...

    def load_acting_state(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over an `acting_state`; raises ``ValueError`` if names or shapes differ."""
        ...
