"""Pre-training: images a second against a plain loop, and what half precision and a frozen backbone bring."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import nn

from slotfilm_dist.bench.agent import bench_config
from slotfilm_dist.bench.results import BenchOptions, BenchResult, at_least, for_information
from slotfilm_dist.bench.rounds import interleave
from slotfilm_dist.bench.timing import calls_per_s
from slotfilm_dist.config import RunConfig
from slotfilm_dist.learning.frames import PretrainFrames
from slotfilm_dist.learning.perception_losses import pretrain_losses
from slotfilm_dist.learning.pretrain import Pretrainer
from slotfilm_dist.machine import has_bfloat16
from slotfilm_dist.nets.agent import build_encoder
from slotfilm_dist.nets.encoder import SlotFusionEncoder

GOAL = 1.3
BATCH = 32
NUM_FRAMES = 256
WHAT = f"one gradient step of the slot pre-training, batch {BATCH}, 128 x 128 pictures, CPU, one thread, as images/s: "


def run(options: BenchOptions) -> list[BenchResult]:
    """Ours as the presets run it, in float32, and with the backbone frozen and its features kept; the plain loop."""
    torch.set_num_threads(1)
    base = bench_config()
    config = replace(base, pretrain=replace(base.pretrain, batch_size=BATCH))
    frames = _frames(config)

    def trainer(**fields: Any) -> Pretrainer:
        changed = replace(config, pretrain=replace(config.pretrain, **fields))
        return Pretrainer(_slots(changed), frames, changed.pretrain, seed=0)

    steps: dict[str, tuple[Callable[[], object], int]] = {
        "ours": (trainer(precision="auto").step, 2),
        "float32": (trainer(precision="float32").step, 2),
        "plain loop": (_plain_step(config, frames), 2),
        "frozen backbone": (trainer(train_backbone="none").step, 40),
    }
    rounds = interleave(
        {
            name: lambda call=call, count=count: BATCH * calls_per_s(call, options.scaled(count))
            for name, (call, count) in steps.items()
        },
        options.rounds,
    )

    def ratio(ours: str, theirs: str, text: str) -> tuple[float, str]:
        return rounds.ratio(ours, theirs).median, f"{WHAT}{text}; {rounds.describe(ours, theirs, 'images/s')}"

    precision = "bfloat16" if has_bfloat16() else "float32, for this processor has no bfloat16"
    plain = "the same model, loss and Adam in float32, torch's own channels-first layout and per-tensor loop"
    against_plain = ratio("ours", "plain loop", f"pretrain.precision = auto ({precision}) against {plain}")
    informing = {
        "in float32, against a plain loop": ratio("float32", "plain loop", f"against {plain}"),
        "pretrain.precision auto against float32": ratio("ours", "float32", precision),
        "frozen backbone against the whole network in float32": ratio(
            "frozen backbone", "float32", "pretrain.train_backbone = none, after its features were computed once"
        ),
    }
    return [
        at_least("pretrain/against a plain loop", against_plain[0], GOAL, "times", against_plain[1]),
        *(for_information(f"pretrain/{name}", value, "times", how) for name, (value, how) in informing.items()),
    ]


def _frames(config: RunConfig) -> PretrainFrames:
    rng, size = np.random.default_rng(0), config.env.image_size
    return PretrainFrames(
        rgb=rng.integers(0, 256, (NUM_FRAMES, size, size, 3), np.uint8),
        uv=rng.random((NUM_FRAMES, config.obs.num_objects, 2), np.float32),
        visible=np.ones((NUM_FRAMES, config.obs.num_objects), bool),
        episode=np.arange(NUM_FRAMES) // 32,
    )


def _slots(config: RunConfig) -> SlotFusionEncoder:
    encoder = build_encoder(config)
    assert isinstance(encoder, SlotFusionEncoder), "the proposed agent's"
    return encoder


def _plain_step(config: RunConfig, frames: PretrainFrames) -> Callable[[], object]:
    """One step as one would first write it: pictures to channels-first floats, loss, Adam with its defaults."""
    encoder = _slots(config)
    network = encoder.perception
    assert network is not None, "the proposed agent has a camera"
    trunk: nn.Module = network.backbone.trunk.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    encoder.train()
    optimiser = torch.optim.Adam(network.parameters(), lr=config.pretrain.lr, foreach=False)
    rng = np.random.default_rng(0)
    mean, std = (torch.tensor(x).view(1, 3, 1, 1) for x in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))

    def step() -> float:
        chosen = rng.choice(NUM_FRAMES, BATCH)
        pictures = torch.from_numpy(frames.rgb[chosen]).permute(0, 3, 1, 2).contiguous().float() / 255
        features = trunk((pictures - mean) / std).flatten(2).transpose(1, 2)
        losses = pretrain_losses(
            network(network.projection(features)),
            torch.from_numpy(frames.uv[chosen]),
            torch.from_numpy(frames.visible[chosen]),
            config.pretrain,
            image_size=config.env.image_size,
            matched_visibility=network.matched_visibility,
        )
        optimiser.zero_grad()
        losses.total.backward()
        optimiser.step()
        return losses.total.item()

    return step
