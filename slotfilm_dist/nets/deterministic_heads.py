"""DrQ-v2's actor and critics (Yarats et al. 2021, Section 3.1), each with a trunk of its own on the convolutions."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from slotfilm_dist.nets.initialization import orthogonal_linear
from slotfilm_dist.nets.policy_heads import EnsembleMLP

LARGEST_ACTION = 1 - 1e-6
"""Noisy actions are clamped to this, as in the released code."""


class Trunk(nn.Module):
    """Linear, LayerNorm and tanh on the picture's part of the latent; the state's part passes by.

    Args:
        visual_dim: size of the picture's part, which comes first.
        state_dim: size of the state's part; 0 in the published algorithm.
        feature_dim: what the picture's part becomes.
        generator: source of the initial weights.
    """

    def __init__(self, visual_dim: int, state_dim: int, feature_dim: int, generator: torch.Generator | None) -> None:
        super().__init__()
        self.visual_dim = visual_dim
        self.out_dim = feature_dim + state_dim
        self.projection = orthogonal_linear(visual_dim, feature_dim, generator)
        self.norm = nn.LayerNorm(feature_dim)

    def forward(self, latent: Float[Tensor, "batch latent"]) -> Float[Tensor, "batch features"]:
        """Features of the picture, then the state."""
        visual = torch.tanh(self.norm(self.projection(latent[:, : self.visual_dim])))
        return torch.cat((visual, latent[:, self.visual_dim :]), dim=1)


class DeterministicActor(nn.Module):
    """An action tanh(mu) for every latent, and one with noise to explore.

    Args:
        visual_dim: size of the latent's part that comes from the picture.
        state_dim: size of the latent's part that is the state.
        action_dim: size of the action.
        feature_dim: width of the trunk.
        hidden: widths of the hidden layers.
        generator: source of the initial weights.
    """

    noise_std: Tensor
    """Deviation of the noise now; a buffer, so that workers get it with the weights."""

    def __init__(
        self,
        visual_dim: int,
        state_dim: int,
        action_dim: int,
        *,
        feature_dim: int,
        hidden: tuple[int, ...],
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.action_dim = action_dim
        self.trunk = Trunk(visual_dim, state_dim, feature_dim, generator)
        self.network = EnsembleMLP(1, (self.trunk.out_dim, *hidden, action_dim), generator=generator)
        _make_orthogonal(self.network, generator)
        self.register_buffer("noise_std", torch.ones(()))

    def mode(self, latent: Float[Tensor, "batch latent"]) -> Float[Tensor, "batch action"]:
        """The deterministic action."""
        return torch.tanh(self.network(self.trunk(latent))[0])

    def forward(
        self, latent: Float[Tensor, "batch latent"], noise: Float[Tensor, "batch action"], clip: float | None = None
    ) -> Float[Tensor, "batch action"]:
        """The action with noise on it, clamped to the range of actions; the gradient ignores the clamp.

        Args:
            latent: what is seen.
            noise: standard normal.
            clip: largest noise after scaling it by `noise_std`; None for any.
        """
        scaled = noise * self.noise_std
        if clip is not None:
            scaled = scaled.clamp(-clip, clip)
        action = self.mode(latent) + scaled
        # In this order the sum is exactly the clamped action.
        return action - action.detach() + action.clamp(-LARGEST_ACTION, LARGEST_ACTION).detach()

    def explore(
        self, latent: Float[Tensor, "batch latent"], noise: Float[Tensor, "batch action"]
    ) -> Float[Tensor, "batch action"]:
        """The action of training's episodes: its noise is not clipped, as in the released code."""
        return self(latent, noise)


class TrunkTwinCritic(nn.Module):
    """Q_theta1 and Q_theta2 on one trunk."""

    def __init__(
        self,
        visual_dim: int,
        state_dim: int,
        action_dim: int,
        *,
        feature_dim: int,
        hidden: tuple[int, ...],
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.trunk = Trunk(visual_dim, state_dim, feature_dim, generator)
        self.ensemble = EnsembleMLP(2, (self.trunk.out_dim + action_dim, *hidden, 1), generator=generator)
        _make_orthogonal(self.ensemble, generator)

    def forward(
        self, latent: Float[Tensor, "batch latent"], action: Float[Tensor, "batch action"], *, frozen: bool = False
    ) -> Float[Tensor, "2 batch"]:
        """Both Q-values; `frozen` lets gradients reach the action only."""
        with torch.set_grad_enabled(torch.is_grad_enabled() and not frozen):
            features = self.trunk(latent)
        return self.ensemble(torch.cat((features, action), dim=1), frozen=frozen).squeeze(-1)


@torch.no_grad()
def _make_orthogonal(network: EnsembleMLP, generator: torch.Generator | None) -> None:
    for weight in network.weights:
        for member in weight:
            nn.init.orthogonal_(member, generator=generator)
    for bias in network.biases:
        bias.zero_()
