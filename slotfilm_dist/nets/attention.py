"""Slot cross-attention (Section 4.1.2), computed without ever forming the tokens' keys and values.

The logit of query i and token j in one head is (W_q q_i + b_q) . (W_k x_j + b_k) / sqrt(d). The slot queries are
parameters and the same for the whole batch, so W_k can be multiplied into them once: with a_i = W_k^T (W_q q_i + b_q)
the logit is a_i . x_j plus a term that all tokens share, which a softmax over tokens does not see. Likewise the values
enter linearly and their weights add up to one, so the tokens are averaged first and projected afterwards, by one
matrix that holds W_v and the output projection. Two more identities save work: a constant positional code is added to
logits and averages instead of to every token, and the mean over slots is taken of the weights instead of the outputs.
"""

import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from slotfilm_dist.nets.initialization import seeded_linear

_SMALL = 1e-8


class FoldedSlotAttention(nn.Module):
    """Multi-head cross-attention of few queries over many tokens: `PlainSlotAttention`, several times faster.

    Parameters have the names and layout of `nn.MultiheadAttention`; state dicts of the two are interchangeable.
    """

    def __init__(
        self, dim: int, num_heads: int, generator: torch.Generator, normalize: Literal["tokens", "slots"] = "tokens"
    ) -> None:
        super().__init__()
        self.dim, self.num_heads, self.normalize = dim, num_heads, normalize
        weight = torch.empty(3 * dim, dim)
        self.in_proj_weight = nn.Parameter(nn.init.xavier_uniform_(weight, generator=generator))
        self.in_proj_bias = nn.Parameter(torch.zeros(3 * dim))
        self.out_proj = seeded_linear(dim, dim, generator)
        nn.init.zeros_(self.out_proj.bias)

    def forward(
        self,
        queries: Float[Tensor, "queries dim"],
        tokens: Float[Tensor, "batch tokens dim"],
        code: Float[Tensor, "tokens dim"],
    ) -> tuple[Float[Tensor, "batch queries dim"], Float[Tensor, "batch queries tokens"]]:
        """Each query's output and its attention, averaged over heads, for tokens to which `code` is added."""
        weights = self._shared_weights(queries, tokens, code).unflatten(1, (self.num_heads, -1))
        means = _weighted_means(weights.flatten(1, 2), tokens, code).unflatten(1, (self.num_heads, -1))
        matrix, bias = self._value_map()
        outputs = means.transpose(1, 2).flatten(2) @ matrix + bias
        return outputs, weights.mean(1)

    def pooled(
        self,
        queries: Float[Tensor, "queries dim"],
        tokens: Float[Tensor, "batch tokens dim"],
        code: Float[Tensor, "tokens dim"],
    ) -> Float[Tensor, "batch dim"]:
        """The outputs' mean over queries, exactly; cheaper than forming each output."""
        weights = self._shared_weights(queries, tokens, code).unflatten(1, (self.num_heads, -1)).mean(2)
        matrix, bias = self._value_map()
        return torch.addmm(bias, _weighted_means(weights, tokens, code).flatten(1), matrix)

    def one_query_each(
        self,
        queries: Float[Tensor, "batch dim"],
        tokens: Float[Tensor, "batch tokens dim"],
        code: Float[Tensor, "tokens dim"],
    ) -> Float[Tensor, "batch dim"]:
        """Output of a query of its own for each sample, always with a softmax over tokens: it competes with none."""
        maps = torch.einsum("bhe,hed->bhd", self._project_queries(queries), self._key_weight())
        weights = (torch.bmm(maps, tokens.transpose(1, 2)) + maps @ code.t()).softmax(-1)
        matrix, bias = self._value_map()
        return torch.addmm(bias, _weighted_means(weights, tokens, code).flatten(1), matrix)

    def _shared_weights(
        self,
        queries: Float[Tensor, "queries dim"],
        tokens: Float[Tensor, "batch tokens dim"],
        code: Float[Tensor, "tokens dim"],
    ) -> Float[Tensor, "batch rows tokens"]:
        """Attention of every head and query over the tokens; each row adds up to one."""
        projected = self._project_queries(queries)
        maps = torch.einsum("qhe,hed->hqd", projected, self._key_weight()).flatten(0, 1)
        offset = maps @ code.t()
        if self.normalize == "slots":
            key_bias = self.in_proj_bias[self.dim : 2 * self.dim].view(self.num_heads, -1)
            offset = offset + torch.einsum("qhe,he->hq", projected, key_bias).reshape(-1, 1)
        batch = len(tokens)
        logits = torch.baddbmm(offset.expand(batch, -1, -1), maps.expand(batch, -1, -1), tokens.transpose(1, 2))
        if self.normalize == "tokens":
            return logits.softmax(-1)
        shares = logits.unflatten(1, (self.num_heads, -1)).softmax(2).flatten(1, 2) + _SMALL
        return shares / shares.sum(-1, keepdim=True)

    def _project_queries(self, queries: Float[Tensor, "queries dim"]) -> Float[Tensor, "queries heads head_dim"]:
        """Projected queries, split into heads and divided by the square root of the head's size."""
        projected = torch.addmm(self.in_proj_bias[: self.dim], queries, self.in_proj_weight[: self.dim].t())
        return projected.unflatten(1, (self.num_heads, -1)) / math.sqrt(self.dim // self.num_heads)

    def _key_weight(self) -> Float[Tensor, "heads head_dim dim"]:
        return self.in_proj_weight[self.dim : 2 * self.dim].unflatten(0, (self.num_heads, -1))

    def _value_map(self) -> tuple[Float[Tensor, "stacked dim"], Float[Tensor, " dim"]]:
        """Matrix and bias that take every head's averaged token to the output."""
        value = self.in_proj_weight[2 * self.dim :].unflatten(0, (self.num_heads, -1))
        out = self.out_proj.weight.unflatten(1, (self.num_heads, -1))
        matrix = torch.einsum("hed,ohe->hdo", value, out).flatten(0, 1)
        return matrix, torch.mv(self.out_proj.weight, self.in_proj_bias[2 * self.dim :]) + self.out_proj.bias


class PlainSlotAttention(nn.MultiheadAttention):
    """The same attention by torch's own module: the reference for tests and benchmarks."""

    def __init__(self, dim: int, num_heads: int) -> None:
        super().__init__(dim, num_heads, batch_first=True)

    def forward(  # type: ignore[override]  # the interface of FoldedSlotAttention, not of its base
        self,
        queries: Float[Tensor, "queries dim"],
        tokens: Float[Tensor, "batch tokens dim"],
        code: Float[Tensor, "tokens dim"],
    ) -> tuple[Float[Tensor, "batch queries dim"], Float[Tensor, "batch queries tokens"]]:
        """Each query's output and its attention, averaged over heads."""
        keys = tokens + code
        outputs, attention = super().forward(queries.expand(len(tokens), -1, -1), keys, keys)
        assert attention is not None, "asked for by default"
        return outputs, attention


def _weighted_means(
    weights: Float[Tensor, "batch rows tokens"],
    tokens: Float[Tensor, "batch tokens dim"],
    code: Float[Tensor, "tokens dim"],
) -> Float[Tensor, "batch rows dim"]:
    """Averages of tokens + code under each row of weights."""
    return torch.bmm(weights, tokens) + (weights.flatten(0, 1) @ code).view(len(tokens), -1, code.shape[1])
