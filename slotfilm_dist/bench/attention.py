"""Folded slot attention against torch's own module with the same weights."""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor, nn

from slotfilm_dist.bench.results import BenchOptions, BenchResult, at_least, at_most
from slotfilm_dist.bench.rounds import interleave
from slotfilm_dist.bench.timing import calls_per_s
from slotfilm_dist.config import RunConfig
from slotfilm_dist.nets.attention import FoldedSlotAttention, PlainSlotAttention

GOAL = 3.0
TOLERANCE = 1e-6
NUM_TOKENS = 64
FOLDED, PLAIN = "folded", "nn.MultiheadAttention"


def run(options: BenchOptions) -> list[BenchResult]:
    """Forward, forward and backward, and the largest difference of outputs and attention."""
    torch.set_num_threads(1)
    folded, plain, inputs = _modules()
    with torch.no_grad():
        pairs = zip(folded(*inputs), plain(*inputs), strict=True)
        difference = max(float((a - b).abs().max()) for a, b in pairs)
    what = "batch 128, 64 tokens of 42 channels, 3 heads, 2 slot queries, same weights, one thread; "
    rows = [
        at_most(
            "attention/largest difference",
            difference,
            TOLERANCE,
            "1",
            f"{what}outputs and mean attention, folded minus torch's",
        )
    ]
    for name, once in (("forward", _forward), ("forward and backward", _both)):
        rounds = interleave(
            {
                FOLDED: partial(calls_per_s, partial(once, folded, inputs), options.scaled(100)),
                PLAIN: partial(calls_per_s, partial(once, plain, inputs), options.scaled(100)),
            },
            options.rounds,
        )
        described = rounds.describe(FOLDED, PLAIN, "calls/s")
        ratio = rounds.ratio(FOLDED, PLAIN).median
        rows.append(at_least(f"attention/{name} against nn.MultiheadAttention", ratio, GOAL, "times", what + described))
    return rows


def _modules() -> tuple[FoldedSlotAttention, PlainSlotAttention, tuple[Tensor, Tensor, Tensor]]:
    """Both modules with the same weights, and queries, tokens and positional code."""
    config = RunConfig()
    dim, heads = config.encoder.feature_dim, config.encoder.num_heads
    generator = torch.Generator().manual_seed(0)
    folded = FoldedSlotAttention(dim, heads, generator)
    plain = PlainSlotAttention(dim, heads)
    plain.load_state_dict(folded.state_dict())
    queries = torch.randn(config.encoder.num_slots, dim, generator=generator).requires_grad_()
    code = (0.05 * torch.randn(NUM_TOKENS, dim, generator=generator)).requires_grad_()
    tokens = torch.randn(config.sac.batch_size, NUM_TOKENS, dim, generator=generator)
    return folded, plain, (queries, tokens, code)


def _forward(module: Callable[..., tuple[Tensor, Tensor]], inputs: tuple[Tensor, Tensor, Tensor]) -> None:
    with torch.no_grad():
        module(*inputs)


def _both(module: nn.Module, inputs: tuple[Tensor, Tensor, Tensor]) -> None:
    """Gradients of parameters, queries and code: what an RL update needs; tokens are frozen."""
    outputs, _ = module(*inputs)
    outputs.sum().backward()
    module.zero_grad(set_to_none=True)
