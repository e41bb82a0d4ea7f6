"""Updates of the learner: on tokens, on pictures, by TorchRL and by Stable-Baselines3; where the time goes."""

import time

import numpy as np
import torch
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from slotfilm_dist.bench.agent import bench_config, learner_for
from slotfilm_dist.bench.contender import Contender, ContenderError, missing
from slotfilm_dist.bench.results import BenchOptions, BenchResult, at_least, for_information
from slotfilm_dist.bench.rounds import Rounds, interleave
from slotfilm_dist.bench.timing import calls_per_s
from slotfilm_dist.bench.transitions import image_batch, token_batch
from slotfilm_dist.learning.learner import Learner
from slotfilm_dist.messages import SampleBatch

GOAL_IMAGES, GOAL_TORCHRL, GOAL_SB3 = 100.0, 2.0, 100.0
WHAT = "one SAC update, batch 128, hidden 256 x 256, CPU, one thread each; "
GEMM = 512
"""Side of the square matrices whose product gives the processor's rate."""
MATMULS = {"aten::bmm", "aten::baddbmm", "aten::mm", "aten::addmm", "aten::mv", "aten::convolution"}


def run(options: BenchOptions) -> list[BenchResult]:
    """Tokens against pictures, TorchRL and Stable-Baselines3; profile and floor."""
    torch.set_num_threads(1)
    config, rng = bench_config(), np.random.default_rng(0)
    learner = learner_for(config)
    batch = token_batch(rng, config.sac.batch_size, config)
    count = options.scaled(60)

    def ours() -> float:
        return calls_per_s(lambda: learner.update(batch), count)

    images, pictures = learner_for(config), image_batch(rng, config.sac.batch_size, config)
    rounds = interleave(
        {"tokens": ours, "pictures": lambda: calls_per_s(lambda: images.update(pictures), 1)}, options.rounds
    )
    how = f"{WHAT}the same learner on stored tokens and on stored pictures (frozen backbone in every update): "
    rows = [_row("tokens against our own images", rounds, "tokens", "pictures", GOAL_IMAGES, how)]
    peers = (
        (
            "TorchRL SACLoss",
            "peers.torchrl_sac",
            count,
            GOAL_TORCHRL,
            "same encoder on tokens, value network, one Adam",
        ),
        ("Stable-Baselines3 SAC", "peers.sb3_sac", 1, GOAL_SB3, "our encoder on pictures, backbone frozen"),
    )
    for peer, module, updates, goal, text in peers:
        try:
            with Contender(module, {}, peer=True) as child:
                rounds = interleave(
                    {"ours": ours, peer: lambda c=child, n=updates: c.ask(num_updates=n)}, options.rounds
                )
            rows.append(_row(f"against {peer}", rounds, "ours", peer, goal, f"{WHAT}{peer} with {text}: "))
        except ContenderError as error:
            rows.append(missing(f"learner/against {peer}", goal, "times", error))
    return [*rows, *_floor(learner, batch, count, options.rounds), *_profile(learner, batch, count)]


def _row(name: str, rounds: Rounds, ours: str, theirs: str, goal: float, how: str) -> BenchResult:
    described = rounds.describe(ours, theirs, "updates/s")
    return at_least(f"learner/{name}", rounds.ratio(ours, theirs).median, goal, "times", how + described)


def _floor(learner: Learner, batch: SampleBatch, count: int, num_rounds: int) -> list[BenchResult]:
    """Time of an update over the time that its matrix products would take at the processor's own rate."""
    with FlopCounterMode(display=False) as counter:
        learner.update(batch)
    gflop = counter.get_total_flops() / 1e9
    square = torch.randn(GEMM, GEMM)
    product_gflop = 2 * GEMM**3 / 1e9
    rounds = interleave(
        {
            "update": lambda: gflop * calls_per_s(lambda: learner.update(batch), count),
            "product": lambda: product_gflop * calls_per_s(lambda: square @ square, count),
        },
        num_rounds,
    )
    ratio, rate = rounds.ratio("product", "update"), rounds.rate("product")
    how = (
        f"{WHAT}{gflop:.3f} GFLOP in matrix products, by torch's counter; at the rate of a {GEMM} x {GEMM} product in "
        f"the same rounds, {rate} GFLOP/s, they take {gflop / rate.median * 1000:.2f} ms; an update takes {ratio} "
        "times that"
    )
    milliseconds = gflop / rounds.rate("update").median * 1000
    return [
        for_information("learner/time over arithmetic floor", ratio.median, "times", how),
        for_information("learner/update", milliseconds, "ms", f"{WHAT}median of the same rounds"),
    ]


def _profile(learner: Learner, batch: SampleBatch, count: int) -> list[BenchResult]:
    """Shares of the update's time, by torch's profiler."""
    with profile(activities=[ProfilerActivity.CPU]) as profiler:
        began = time.perf_counter()
        for _ in range(count):
            learner.update(batch)
        wall_us = (time.perf_counter() - began) * 1e6
    events = {event.key: event.self_cpu_time_total for event in profiler.key_averages()}
    products = sum(value for key, value in events.items() if key in MATMULS)
    optimiser = sum(value for key, value in events.items() if "Adam" in key or "adam" in key)
    kernels = sum(value for key, value in events.items() if key.startswith("aten::")) - products
    how = f"{WHAT}self time by torch's profiler over {count} updates, as a share of the profiled wall time"
    shares = {"matrix products": products, "optimisers": optimiser, "other tensor operations": kernels}
    return [
        for_information(f"learner/share of {name}", value / wall_us, "share", how) for name, value in shares.items()
    ]
