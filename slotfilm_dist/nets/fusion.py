"""How the robot's state enters the visual latent: FiLM (Section 4.2) and its ablations (Section 7.1)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from slotfilm_dist.config import Fusion
from slotfilm_dist.nets.initialization import seeded_linear


class StateFusion(nn.Module):
    """Combines pooled slot features with the state; the FiLM forms are the exact identity at initialisation.

    film_tanh    (1 + tanh(gamma)) * z + beta, the paper's form
    film_clamp   (1 + clamp(gamma, -1, 1)) * z + beta
    concat_proj  a linear map of [z, state]; it commutes with the mean over slots, so it is applied after pooling
    concat_late  [z, state] itself
    none         z
    """

    def __init__(self, fusion: Fusion, dim: int, state_dim: int, generator: torch.Generator) -> None:
        super().__init__()
        assert fusion != "state_only", "without a picture there is nothing to fuse"
        self.fusion: Fusion = fusion
        self.latent_dim = dim + state_dim if fusion == "concat_late" else dim
        if fusion in ("film_tanh", "film_clamp"):
            self.state_projection = seeded_linear(state_dim, dim, generator)
            self.film = nn.Linear(dim, 2 * dim, device="meta").to_empty(device="cpu")
            nn.init.zeros_(self.film.weight)
            nn.init.zeros_(self.film.bias)
        elif fusion == "concat_proj":
            self.concat_projection = seeded_linear(dim + state_dim, dim, generator)

    def forward(
        self, pooled: Float[Tensor, "batch dim"], state: Float[Tensor, "batch proprio"]
    ) -> Float[Tensor, "batch latent"]:
        """The latent that actor and critics read."""
        match self.fusion:
            case "none":
                return pooled
            case "concat_late":
                return torch.cat((pooled, state), dim=1)
            case "concat_proj":
                return self.concat_projection(torch.cat((pooled, state), dim=1))
            case _:
                gain, shift = self.modulation(state)
                return torch.addcmul(pooled + shift, gain, pooled)

    @property
    def has_film(self) -> bool:
        """Whether the state modulates the latent."""
        return hasattr(self, "film")

    def modulation(
        self, state: Float[Tensor, "batch proprio"]
    ) -> tuple[Float[Tensor, "batch dim"], Float[Tensor, "batch dim"]]:
        """Bounded gamma, and beta, of the FiLM forms (Section 4.2 and its clamped ablation, Section 7.1)."""
        gamma, beta = self.film(self.state_projection(state)).chunk(2, dim=1)
        return (gamma.tanh() if self.fusion == "film_tanh" else gamma.clamp(-1.0, 1.0)), beta

    def is_identity(self) -> bool:
        """Whether the state changes nothing yet: every FiLM weight is zero, or there is no FiLM."""
        return not self.has_film or not any(bool(p.any()) for p in self.film.parameters())
