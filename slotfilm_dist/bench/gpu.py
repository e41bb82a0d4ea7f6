"""What only a GPU host can reach: the rows that one can fill, and which rows another machine leaves empty."""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import torch

from slotfilm_dist.bench.agent import bench_config, learner_for
from slotfilm_dist.bench.results import BenchOptions, BenchResult, at_least, at_most, not_measured
from slotfilm_dist.bench.rounds import Spread
from slotfilm_dist.bench.transitions import ACTION_DIM, token_batch
from slotfilm_dist.config import RunConfig
from slotfilm_dist.learning.frames import PretrainFrames
from slotfilm_dist.learning.learner import Learner
from slotfilm_dist.learning.pretrain import Pretrainer
from slotfilm_dist.nets.capture import SizedCaptures
from slotfilm_dist.nets.encoder import SlotFusionEncoder

GOAL_UPDATES, GOAL_PRETRAIN_MIN, GOAL_STEPS, GOAL_PAPER_MIN, GOAL_LATENCY_MS = 2000.0, 10.0, 800.0, 30.0, 0.5
NUM_FRAMES = 8_000
NO_GPU = "torch finds no CUDA GPU here; run `slotfilm bench gpu` on a host with one"


def run(options: BenchOptions) -> list[BenchResult]:
    """Token updates, pre-training and latency on the GPU; for whole runs the command that measures them."""
    rows = [
        not_measured(
            "gpu/env steps with 14 workers rendering", GOAL_STEPS, "steps/s", "`slotfilm train cluster` reports it"
        ),
        not_measured("gpu/paper preset end to end", GOAL_PAPER_MIN, "min", "`slotfilm train paper` reports it"),
    ]
    if not torch.cuda.is_available():
        return [
            not_measured("gpu/token updates", GOAL_UPDATES, "updates/s", NO_GPU),
            not_measured("gpu/pre-training of 150k steps", GOAL_PRETRAIN_MIN, "min", NO_GPU),
            not_measured("gpu/batch-1 latency", GOAL_LATENCY_MS, "ms", NO_GPU),
            *rows,
        ]
    config = bench_config()
    return [
        _updates(config, options, compiled=True),
        _updates(config, options, compiled=False),
        _pretraining(config, options),
        _latency(config, options),
        *rows,
    ]


def _updates(config: RunConfig, options: BenchOptions, *, compiled: bool) -> BenchResult:
    learner = learner_for(replace(config, runtime=replace(config.runtime, compiled=compiled)), "cuda")
    rng, count = np.random.default_rng(0), options.scaled(2000)
    batches = [token_batch(rng, config.sac.batch_size, config) for _ in range(8)]

    def make_updates() -> None:
        for i in range(count):
            learner.update(batches[i % len(batches)])
        learner.settle()

    spread = _spread([count / _seconds(make_updates) for _ in range(options.rounds + 1)][1:])
    form = "compiled and recorded as a CUDA graph" if compiled else "recorded as a CUDA graph"
    how = f"one SAC update, batch {config.sac.batch_size} on tokens from pageable memory, {form}: {spread} updates/s"
    name = "gpu/token updates" + ("" if compiled else ", not compiled")
    return at_least(name, spread.median, GOAL_UPDATES, "updates/s", how)


def _pretraining(config: RunConfig, options: BenchOptions) -> BenchResult:
    rng, size, objects = np.random.default_rng(0), config.env.image_size, config.obs.num_objects
    frames = PretrainFrames(
        rgb=rng.integers(0, 256, (NUM_FRAMES, size, size, 3), np.uint8),
        uv=rng.random((NUM_FRAMES, objects, 2), np.float32),
        visible=np.ones((NUM_FRAMES, objects), bool),
        episode=np.arange(NUM_FRAMES) // 100,
    )
    learner, count = Learner(config, ACTION_DIM, torch.device("cpu")), options.scaled(300)
    assert isinstance(learner.encoder, SlotFusionEncoder), "the proposed agent's"
    half = replace(config.pretrain, precision="bfloat16")
    trainer = Pretrainer(learner.encoder, frames, half, seed=0, device="cuda")

    def take_steps() -> None:
        for _ in range(count):
            trainer.begin_step()
        trainer.losses()

    minutes = [150_000 * _seconds(take_steps) / count / 60 for _ in range(options.rounds + 1)][1:]
    how = f"150,000 steps of {half.batch_size} pictures, whole network, bfloat16, at the rate of {count} steps: "
    spread = _spread(minutes)
    return at_most("gpu/pre-training of 150k steps", spread.median, GOAL_PRETRAIN_MIN, "min", f"{how}{spread} min")


def _latency(config: RunConfig, options: BenchOptions) -> BenchResult:
    learner, count = learner_for(config, "cuda"), options.scaled(200)
    encoder, actor, size = learner.encoder, learner.rl.actor, config.env.image_size

    @torch.no_grad()
    def see_and_act(batch: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
        return (actor.mode(encoder(encoder.to_visual(batch["rgb"]), batch["proprio"], batch["goal"])),)

    call = SizedCaptures(see_and_act, torch.device("cuda"))
    arrays = {
        "rgb": np.zeros((1, size, size, 3), np.uint8),
        "proprio": np.zeros((1, config.obs.state_dim), np.float32),
        "goal": np.zeros((1, 3), np.float32),
    }

    def act() -> None:
        for _ in range(count):
            call(arrays)

    spread = _spread([1000 * _seconds(act) / count for _ in range(options.rounds + 1)][1:])
    how = f"picture in memory to action in memory, backbone included, batch 1, a CUDA graph: {spread} ms (paper: 2.57)"
    return at_most("gpu/batch-1 latency", spread.median, GOAL_LATENCY_MS, "ms", how)


def _seconds(call: Callable[[], object]) -> float:
    """Time of a call, the GPU's work included."""
    began = time.perf_counter()
    call()
    torch.cuda.synchronize()
    return time.perf_counter() - began


def _spread(values: list[float]) -> Spread:
    return Spread(median=float(np.median(values)), low=min(values), high=max(values))
