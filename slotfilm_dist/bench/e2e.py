"""Training from end to end at one update a step, rendering on: against Stable-Baselines3 and RLlib."""

from dataclasses import replace

import torch

from slotfilm_dist.bench.agent import bench_config
from slotfilm_dist.bench.contender import Contender, ContenderError, missing
from slotfilm_dist.bench.results import BenchOptions, BenchResult, at_least, for_information
from slotfilm_dist.bench.rounds import interleave
from slotfilm_dist.bench.timing import calls_per_s
from slotfilm_dist.machine import has_bfloat16
from slotfilm_dist.nets.agent import build_encoder

STORED = 200
"""Steps collected before the first update."""
WHAT = (
    "env steps/s of PickBanana-v1 with the wrist camera's 128 x 128 picture (render profile wrist for both), one SAC "
    "update of batch 128 and hidden 256 x 256 a step, one thread each; "
)
PEERS = (
    ("Stable-Baselines3 SAC", "peers.sb3_training", 1, 200.0, "our encoder on pictures, backbone frozen"),
    ("RLlib SAC", "peers.rllib_training", 3, 5.0, "its own CNN, four convolutions of 32 channels, without the state"),
)
"""Name, script, steps a round, goal, and what it runs."""


def run(options: BenchOptions) -> list[BenchResult]:
    """Our loop in one process against each peer's, and its largest part alone."""
    rows = [_tokens(options)] if has_bfloat16() else []
    for peer, module, steps, goal, text in PEERS:
        name = f"e2e/against {peer}"
        try:
            with (
                Contender(module, {"stored": STORED}, peer=True) as theirs,
                Contender("own_training", {"stored": STORED}) as ours,
            ):
                rounds = interleave(
                    {
                        "ours": lambda child=ours: child.ask(num_steps=options.scaled(128)),
                        peer: lambda child=theirs, n=steps: child.ask(num_steps=n),
                    },
                    options.rounds,
                )
        except ContenderError as error:
            rows.append(missing(name, goal, "times", error))
            continue
        own = f"ours on stored tokens, its frozen backbone in {'bfloat16' if has_bfloat16() else 'float32'}"
        how = f"{WHAT}{own}, {peer} in float32 with {text}: {rounds.describe('ours', peer, 'steps/s')}"
        rows.append(at_least(name, rounds.ratio("ours", peer).median, goal, "times", how))
    return rows


@torch.inference_mode()
def _tokens(options: BenchOptions) -> BenchResult:
    """What the frozen backbone costs a step: bfloat16 against float32."""
    torch.set_num_threads(1)
    base = bench_config()
    picture = torch.randint(0, 256, (1, base.env.image_size, base.env.image_size, 3), dtype=torch.uint8)
    calls = {}
    for precision in ("bfloat16", "float32"):
        config = replace(base, encoder=replace(base.encoder, frozen_precision=precision))
        encoder = build_encoder(config, fetch_weights=False)
        encoder.freeze_backbone()
        encoder.eval()
        calls[precision] = lambda network=encoder: calls_per_s(lambda: network.to_visual(picture), options.scaled(50))
    rounds = interleave(calls, options.rounds)
    ratio = rounds.ratio("bfloat16", "float32")
    how = f"tokens of one picture, one thread: {rounds.describe('bfloat16', 'float32', 'pictures/s')}"
    return for_information("e2e/tokens of a picture in bfloat16 against float32", ratio.median, "times", how)
