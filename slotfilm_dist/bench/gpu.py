"""What only a GPU host can reach: the rows that one can fill, and which rows another machine leaves empty."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from slotfilm_dist.bench.agent import bench_config, learner_for
from slotfilm_dist.bench.results import BenchOptions, BenchResult, at_least, at_most, not_measured
from slotfilm_dist.bench.rounds import Spread
from slotfilm_dist.bench.transitions import token_batch
from slotfilm_dist.config import RunConfig
from slotfilm_dist.policy import AgentPolicy

GOAL_UPDATES, GOAL_PRETRAIN_MIN, GOAL_STEPS, GOAL_PAPER_MIN, GOAL_LATENCY_MS = 2000.0, 10.0, 800.0, 30.0, 0.5
NO_GPU = "torch finds no CUDA GPU here; run `slotfilm bench gpu` on a host with one"


def run(options: BenchOptions) -> list[BenchResult]:
    """Token updates and latency on the GPU; the long runs are named with the command that measures them."""
    rows = [
        not_measured(
            "gpu/pre-training of 150k steps", GOAL_PRETRAIN_MIN, "min", "`slotfilm train paper` reports it as it goes"
        ),
        not_measured(
            "gpu/env steps with 14 workers rendering", GOAL_STEPS, "steps/s", "`slotfilm train cluster` reports it"
        ),
        not_measured("gpu/paper preset end to end", GOAL_PAPER_MIN, "min", "`slotfilm train paper` reports it"),
    ]
    if not torch.cuda.is_available():
        return [
            not_measured("gpu/token updates", GOAL_UPDATES, "updates/s", NO_GPU),
            not_measured("gpu/batch-1 latency", GOAL_LATENCY_MS, "ms", NO_GPU),
            *rows,
        ]
    config = bench_config()
    return [_updates(config, options), _latency(config, options), *rows]


def _updates(config: RunConfig, options: BenchOptions) -> BenchResult:
    learner, count = learner_for(config, "cuda"), options.scaled(500)
    batch = token_batch(np.random.default_rng(0), config.sac.batch_size, config)
    rates = [_rate(learner.update, batch, count) for _ in range(options.rounds + 1)][1:]
    spread = Spread(median=float(np.median(rates)), low=min(rates), high=max(rates))
    how = f"one SAC update, batch {config.sac.batch_size} on tokens from pageable memory: {spread} updates/s"
    return at_least("gpu/token updates", spread.median, GOAL_UPDATES, "updates/s", how)


def _latency(config: RunConfig, options: BenchOptions) -> BenchResult:
    learner, count = learner_for(config, "cuda"), options.scaled(200)
    policy = AgentPolicy(learner.encoder, learner.rl.actor, np.random.SeedSequence(0), deterministic=True)
    size = config.env.image_size
    picture = torch.zeros((1, size, size, 3), dtype=torch.uint8, device="cuda")
    state, goal = torch.zeros((1, config.obs.state_dim), device="cuda"), torch.zeros((1, 3), device="cuda")

    @torch.inference_mode()
    def act(_: object) -> None:
        policy.actor.mode(policy.encoder(policy.encoder.to_visual(picture), state, goal))

    times = [1000 / _rate(act, None, count) for _ in range(options.rounds + 1)][1:]
    spread = Spread(median=float(np.median(times)), low=min(times), high=max(times))
    how = f"picture on the GPU to action, backbone included, batch 1, no graph capture: {spread} ms (the paper: 2.57)"
    return at_most("gpu/batch-1 latency", spread.median, GOAL_LATENCY_MS, "ms", how)


def _rate(call: Callable[[Any], object], argument: Any, count: int) -> float:
    """Calls a second, the GPU's work included."""
    began = time.perf_counter()
    for _ in range(count):
        call(argument)
    torch.cuda.synchronize()
    return count / (time.perf_counter() - began)
