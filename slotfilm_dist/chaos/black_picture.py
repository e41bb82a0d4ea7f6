"""A renderer that loses its device: the picture is all black."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from slotfilm_dist.chaos.faulty_env import make_faulty_env
from slotfilm_dist.chaos.outcome import Observation
from slotfilm_dist.chaos.switches import Switches
from slotfilm_dist.envs.toy import make_toy_env
from slotfilm_dist.local import LocalBackend
from slotfilm_dist.presets import smoke

STEPS, BLACK = 160, 3


def black_picture(folder: Path, rng: np.random.Generator) -> Observation:
    """Some black pictures while the random policy collects."""
    base = smoke()
    config = replace(base, runtime=replace(base.runtime, mode="local", block_steps=16))
    switches = Switches(folder / "black")
    make_env = partial(make_faulty_env, folder=folder / "black", make_env=make_toy_env)
    backend = LocalBackend(config, make_env)
    blocks = []
    for block in backend.random_blocks(STEPS, 0):
        blocks.append(block)
        if len(blocks) <= BLACK:
            switches.arm("black_picture")
    backend.close()
    black = sum(int((~block.visual.reshape(block.num_rows, -1).any(axis=1)).sum()) for block in blocks)
    cut = sum(not block.truncated.any() and block.num_steps < 16 for block in blocks[:-1])
    return Observation(
        observed="the steps were left out and their episodes cut short",
        figure=f"{black} of {sum(b.num_rows for b in blocks)} stored pictures black; {cut} of {BLACK} episodes cut",
        holds=black == 0 and cut == BLACK,
    )
