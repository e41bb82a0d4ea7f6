"""Folded slot attention against torch's own multi-head attention."""

import math

import pytest
import torch
from torch import Tensor

from slotfilm_dist.nets.attention import FoldedSlotAttention, PlainSlotAttention

DIM, HEADS, TOKENS, BATCH = 42, 3, 64, 5


def pair(dtype: torch.dtype = torch.float32) -> tuple[FoldedSlotAttention, PlainSlotAttention]:
    """Both forms with the same parameters, none of them zero."""
    folded = FoldedSlotAttention(DIM, HEADS, torch.Generator().manual_seed(0)).to(dtype)
    plain = PlainSlotAttention(DIM, HEADS).to(dtype)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in folded.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=generator, dtype=dtype))
    plain.load_state_dict(folded.state_dict())
    return folded, plain


def inputs(num_slots: int = 2, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(2)
    queries = torch.randn(num_slots, DIM, generator=generator, dtype=dtype)
    tokens = torch.randn(BATCH, TOKENS, DIM, generator=generator, dtype=dtype)
    code = 0.05 * torch.randn(TOKENS, DIM, generator=generator, dtype=dtype)
    return queries.requires_grad_(), tokens.requires_grad_(), code.requires_grad_()


def test_attention_has_the_parameters_of_the_paper() -> None:
    folded, _ = pair()
    assert sum(p.numel() for p in folded.parameters()) == 7_224


@pytest.mark.parametrize("num_slots", [1, 2, 4])
def test_folded_attention_equals_plain_attention(num_slots: int) -> None:
    folded, plain = pair(torch.float64)
    ours, our_attention = folded(*inputs(num_slots, torch.float64))
    theirs, their_attention = plain(*inputs(num_slots, torch.float64))
    torch.testing.assert_close(ours, theirs, atol=1e-9, rtol=0)
    torch.testing.assert_close(our_attention, their_attention, atol=1e-9, rtol=0)


def test_folded_attention_has_the_gradients_of_plain_attention() -> None:
    folded, plain = pair(torch.float64)
    grads = []
    for module in (folded, plain):
        arguments = inputs(dtype=torch.float64)
        outputs, attention = module(*arguments)
        loss = outputs.sin().sum() + attention.square().sum()
        grads.append(torch.autograd.grad(loss, [*arguments, *module.parameters()]))
    for ours, theirs in zip(*grads, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-6, rtol=0)
    assert all(bool(g.any()) for g in grads[0][:3])


def test_pooled_output_is_the_mean_over_slots_with_its_gradients() -> None:
    folded, _ = pair(torch.float64)
    results = []
    for pool in (lambda q, x, c: folded.pooled(q, x, c), lambda q, x, c: folded(q, x, c)[0].mean(1)):
        arguments = inputs(4, torch.float64)
        pooled = pool(*arguments)
        grads = torch.autograd.grad(pooled.sin().sum(), [*arguments, *folded.parameters()])
        results.append((pooled, *grads))
    for ours, theirs in zip(*results, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-9, rtol=0)


def test_query_of_each_sample_attends_as_in_plain_attention() -> None:
    folded, plain = pair(torch.float64)
    _, tokens, code = inputs(dtype=torch.float64)
    queries = torch.randn(BATCH, DIM, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    ours = folded.one_query_each(queries, tokens, code)
    for sample in range(BATCH):
        theirs, _ = plain(queries[sample : sample + 1], tokens[sample : sample + 1], code)
        torch.testing.assert_close(ours[sample], theirs[0, 0], atol=1e-9, rtol=0)


def test_slots_that_compete_share_every_token_and_keep_the_key_bias() -> None:
    folded, _ = pair(torch.float64)
    folded.normalize = "slots"
    queries, tokens, code = inputs(3, torch.float64)
    outputs, attention = folded(queries, tokens, code)

    seen = tokens + code
    q, k, v = (
        (x @ weight.t() + bias).unflatten(-1, (HEADS, -1)).movedim(-2, -3)
        for x, weight, bias in zip(
            (queries.expand(BATCH, -1, -1), seen, seen),
            folded.in_proj_weight.chunk(3),
            folded.in_proj_bias.chunk(3),
            strict=True,
        )
    )
    shares = (q @ k.transpose(-1, -2) / math.sqrt(DIM // HEADS)).softmax(2) + 1e-8
    weights = shares / shares.sum(-1, keepdim=True)
    expected = folded.out_proj((weights @ v).movedim(1, 2).flatten(2))
    torch.testing.assert_close(outputs, expected, atol=1e-9, rtol=0)
    torch.testing.assert_close(attention, weights.mean(1), atol=1e-9, rtol=0)
