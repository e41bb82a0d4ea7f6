"""Layers initialised from a generator that is passed down, so that no global random state is read or changed."""

import math

import torch
from torch import Tensor, nn


def seeded_linear(in_features: int, out_features: int, generator: torch.Generator) -> nn.Linear:
    """A linear layer with torch's default distribution, drawn from `generator`."""
    layer = nn.Linear(in_features, out_features, device="meta").to_empty(device="cpu")
    bound = 1.0 / math.sqrt(in_features)
    nn.init.uniform_(layer.weight, -bound, bound, generator=generator)
    nn.init.uniform_(layer.bias, -bound, bound, generator=generator)
    return layer


def seeded_head(in_features: int, hidden: int, out_features: int, generator: torch.Generator) -> nn.Sequential:
    """A head with one hidden ReLU layer."""
    return nn.Sequential(
        seeded_linear(in_features, hidden, generator), nn.ReLU(), seeded_linear(hidden, out_features, generator)
    )


def seeded_normal(*shape: int, generator: torch.Generator) -> nn.Parameter:
    """A parameter of standard normal numbers."""
    values: Tensor = torch.empty(shape)
    return nn.Parameter(nn.init.normal_(values, generator=generator))


def orthogonal_linear(in_features: int, out_features: int, generator: torch.Generator | None) -> nn.Linear:
    """A linear layer with orthogonal weights and zero biases."""
    layer = nn.Linear(in_features, out_features, device="meta").to_empty(device="cpu")
    nn.init.orthogonal_(layer.weight, generator=generator)
    nn.init.zeros_(layer.bias)
    return layer


def orthogonal_conv(
    in_channels: int, out_channels: int, kernel: int, stride: int, generator: torch.Generator | None
) -> nn.Conv2d:
    """A convolution in front of a ReLU, without padding: orthogonal weights with gain sqrt(2), zero biases."""
    layer = nn.Conv2d(in_channels, out_channels, kernel, stride, device="meta").to_empty(device="cpu")
    nn.init.orthogonal_(layer.weight, math.sqrt(2), generator=generator)
    assert layer.bias is not None
    nn.init.zeros_(layer.bias)
    return layer
