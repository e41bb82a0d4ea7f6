"""Soft Actor-Critic with a value network (Section 4.4) as pure functions of tensors."""

from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def bootstrap_mask(
    terminated: Bool[Tensor, " batch"],
    truncated: Bool[Tensor, " batch"],
    mode: Literal["on_truncation", "always", "never"],
) -> Float[Tensor, " batch"]:
    """1 where the value of the next state counts.

    A time limit is no property of the state, so `on_truncation` bootstraps through it; the paper writes only "done".
    """
    if mode == "always":
        return torch.ones_like(terminated, dtype=torch.float32)
    ended = terminated if mode == "on_truncation" else terminated | truncated
    return (~ended).float()


def critic_target(
    reward: Float[Tensor, " batch"],
    mask: Float[Tensor, " batch"],
    next_value: Float[Tensor, " batch"],
    gamma: float,
) -> Float[Tensor, " batch"]:
    """The soft Bellman backup (Equation 5): y = r + gamma (1 - done) V_target(z')."""
    return reward + gamma * mask * next_value


def critic_loss(q: Float[Tensor, "2 batch"], target: Float[Tensor, " batch"]) -> Float[Tensor, ""]:
    """Half the squared error of each critic, added (Equation 6)."""
    return 0.5 * (q - target).square().mean(dim=-1).sum()


def value_loss(
    value: Float[Tensor, " batch"],
    min_q: Float[Tensor, " batch"],
    log_prob: Float[Tensor, " batch"],
    temperature: Float[Tensor, ""],
) -> Float[Tensor, ""]:
    """Half the squared error to min_i Q_i(z, a) - alpha log pi(a | z) with a fresh action (Equation 7)."""
    return 0.5 * (value - (min_q - temperature * log_prob)).square().mean()


def actor_loss(
    min_q: Float[Tensor, " batch"], log_prob: Float[Tensor, " batch"], temperature: Float[Tensor, ""]
) -> Float[Tensor, ""]:
    """alpha log pi(a | z) - min_i Q_i(z, a) with a reparameterised action (Equation 8)."""
    return (temperature * log_prob - min_q).mean()


def temperature_loss(
    log_temperature: Float[Tensor, ""], log_prob: Float[Tensor, " batch"], target_entropy: float
) -> Float[Tensor, ""]:
    """Drives the policy's entropy to its target (the automatic temperature; not in the paper)."""
    return -(log_temperature.exp() * (log_prob + target_entropy).mean())


@torch.no_grad()
def polyak(target: list[Tensor], online: list[Tensor], tau: float) -> None:
    """target = tau online + (1 - tau) target, in place (Equation 9)."""
    torch._foreach_lerp_(target, online, tau)  # pyright: ignore[reportPrivateImportUsage]
