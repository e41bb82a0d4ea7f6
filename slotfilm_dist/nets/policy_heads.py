"""The networks of Soft Actor-Critic on top of a latent: actor, twin critics, value network (Section 4.4, Table A1)."""

import itertools
import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

LOG_2PI = math.log(2 * math.pi)


class EnsembleMLP(nn.Module):
    """Several multilayer perceptrons of one shape, evaluated together: one batched product a layer.

    Args:
        members: networks in the ensemble.
        sizes: widths from input to output; ReLU between layers.
        layer_norm: LayerNorm before each ReLU.
        generator: source of the initial weights, uniform in +-1/sqrt(fan in) as torch's Linear.
    """

    def __init__(
        self,
        members: int,
        sizes: tuple[int, ...],
        *,
        layer_norm: bool = False,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        self.scales = nn.ParameterList()
        self.shifts = nn.ParameterList()
        for fan_in, fan_out in itertools.pairwise(sizes):
            bound = 1 / math.sqrt(fan_in)
            self.weights.append(nn.Parameter(_uniform((members, fan_in, fan_out), bound, generator)))
            self.biases.append(nn.Parameter(_uniform((members, 1, fan_out), bound, generator)))
        if layer_norm:
            for width in sizes[1:-1]:
                self.scales.append(nn.Parameter(torch.ones(members, 1, width)))
                self.shifts.append(nn.Parameter(torch.zeros(members, 1, width)))

    def forward(
        self, x: Float[Tensor, "batch features"], *, frozen: bool = False
    ) -> Float[Tensor, "members batch out"]:
        """Every member's output; `frozen` lets gradients reach the input only."""
        parameters = [self.weights, self.biases, self.scales, self.shifts]
        weights, biases, scales, shifts = (
            [p.detach() for p in group] if frozen else list(group) for group in parameters
        )
        hidden = x.expand(len(weights[0]), *x.shape)
        for i, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            hidden = torch.baddbmm(bias, hidden, weight)
            if i == len(weights) - 1:
                return hidden
            if scales:
                hidden = F.layer_norm(hidden, hidden.shape[-1:]) * scales[i] + shifts[i]
            hidden = F.relu(hidden)
        raise AssertionError("a network has at least one layer")


class TwinCritic(nn.Module):
    """Q_phi1 and Q_phi2 of a latent and an action."""

    def __init__(
        self,
        latent_dim: int,
        action_dim: int,
        hidden: tuple[int, ...],
        *,
        layer_norm: bool = False,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        sizes = (latent_dim + action_dim, *hidden, 1)
        self.ensemble = EnsembleMLP(2, sizes, layer_norm=layer_norm, generator=generator)

    def forward(
        self, latent: Float[Tensor, "batch latent"], action: Float[Tensor, "batch action"], *, frozen: bool = False
    ) -> Float[Tensor, "2 batch"]:
        """Both soft Q-values; `frozen` lets gradients reach latent and action only."""
        return self.ensemble(torch.cat((latent, action), dim=-1), frozen=frozen).squeeze(-1)


class ValueNet(nn.Module):
    """V_eta of a latent."""

    def __init__(
        self,
        latent_dim: int,
        hidden: tuple[int, ...],
        *,
        layer_norm: bool = False,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.ensemble = EnsembleMLP(1, (latent_dim, *hidden, 1), layer_norm=layer_norm, generator=generator)

    def forward(self, latent: Float[Tensor, "batch latent"]) -> Float[Tensor, " batch"]:
        """The soft state value."""
        return self.ensemble(latent)[0, :, 0]


@dataclass(frozen=True, slots=True)
class PolicySample:
    """A reparameterised action and its log-probability."""

    action: Float[Tensor, "batch action"]
    log_prob: Float[Tensor, " batch"]


class Actor(nn.Module):
    """A Gaussian policy squashed by tanh to [-1, 1].

    Args:
        latent_dim: size of the latent.
        action_dim: size of the action.
        hidden: widths of the hidden layers.
        log_std_range: clamp of the log standard deviation before squashing.
        generator: source of the initial weights.
    """

    def __init__(
        self,
        latent_dim: int,
        action_dim: int,
        hidden: tuple[int, ...],
        *,
        log_std_range: tuple[float, float] = (-5.0, 2.0),
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.action_dim = action_dim
        self.log_std_range = log_std_range
        self.network = EnsembleMLP(1, (latent_dim, *hidden, 2 * action_dim), generator=generator)

    def distribution(
        self, latent: Float[Tensor, "batch latent"]
    ) -> tuple[Float[Tensor, "batch action"], Float[Tensor, "batch action"]]:
        """Mean and log standard deviation before squashing."""
        mean, log_std = self.network(latent)[0].chunk(2, dim=-1)
        return mean, log_std.clamp(*self.log_std_range)

    def forward(self, latent: Float[Tensor, "batch latent"], noise: Float[Tensor, "batch action"]) -> PolicySample:
        """The action for standard normal noise, with its log-probability."""
        mean, log_std = self.distribution(latent)
        unsquashed = mean + log_std.exp() * noise
        return PolicySample(torch.tanh(unsquashed), squashed_log_prob(unsquashed, noise, log_std))

    def explore(
        self, latent: Float[Tensor, "batch latent"], noise: Float[Tensor, "batch action"]
    ) -> Float[Tensor, "batch action"]:
        """The action of training's episodes, for standard normal noise."""
        return self(latent, noise).action

    def mode(self, latent: Float[Tensor, "batch latent"]) -> Float[Tensor, "batch action"]:
        """The deterministic action tanh(mean)."""
        return torch.tanh(self.distribution(latent)[0])


def squashed_log_prob(
    unsquashed: Float[Tensor, "batch action"],
    noise: Float[Tensor, "batch action"],
    log_std: Float[Tensor, "batch action"],
) -> Float[Tensor, " batch"]:
    """Log-density of tanh(unsquashed), summed over actions.

    The Jacobian log(1 - tanh(u)^2) is written 2 (log 2 - u - softplus(-2u)), which does not lose digits at large u.
    """
    gaussian = -0.5 * noise.square() - log_std - 0.5 * LOG_2PI
    jacobian = 2 * (math.log(2) - unsquashed - F.softplus(-2 * unsquashed))
    return (gaussian - jacobian).sum(dim=-1)


def _uniform(shape: tuple[int, ...], bound: float, generator: torch.Generator | None) -> Tensor:
    return (torch.rand(shape, generator=generator) * 2 - 1) * bound
