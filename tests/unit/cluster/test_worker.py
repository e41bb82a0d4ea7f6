"""A worker's loop without Ray: what it collects at random."""

from dataclasses import replace

import pytest

from slotfilm_dist.cluster.worker import WorkerLoop
from slotfilm_dist.envs.toy import make_toy_env
from slotfilm_dist.presets import smoke
from slotfilm_dist.variants import apply_variant


@pytest.mark.parametrize(("asked", "length"), [(8, 8), (0, 40), (60, 40)])
def test_random_episodes_are_as_long_as_the_schedule_says(asked: int, length: int) -> None:
    config = apply_variant("state_only", smoke())
    config = replace(config, schedule=replace(config.schedule, random_episode_steps=asked))
    loop = WorkerLoop(config, 0, make_toy_env)
    loop.collect_randomly(0, 0)
    lengths: list[int] = []
    while len(lengths) < 3:
        lengths += [episode.length for block in loop.take_random_blocks(10.0) for episode in block.episodes]
    assert loop.stop(10.0)
    assert set(lengths) == {length}


def test_random_data_that_go_on_repeat_nothing_though_another_run_began_them() -> None:
    config = apply_variant("state_only", smoke())

    def seeds(already: int) -> list[int]:
        loop = WorkerLoop(config, 0, make_toy_env)
        loop.collect_randomly(100_000, already)
        found: list[int] = []
        while len(found) < 3:
            found += [episode.seed for block in loop.take_random_blocks(10.0) for episode in block.episodes]
        assert loop.stop(10.0)
        return found[:3]

    assert seeds(0) == seeds(0)
    assert not {*seeds(0)} & {*seeds(120)}
