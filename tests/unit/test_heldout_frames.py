"""What names a file of held-out frames: all that they depend on, and nothing else."""

from dataclasses import replace

import pytest

from slotfilm_dist.commands.heldout_frames import FrameRequest, frames_file
from slotfilm_dist.config import RunConfig
from slotfilm_dist.variants import apply_variant

REQUEST = FrameRequest(source="random", first_seed=10_000_000, episodes=2, steps=0)


def file_of(config: RunConfig) -> str:
    return frames_file(config, REQUEST, "random")


@pytest.mark.parametrize("field", ["goal_visible", "terminate_on_success"])
def test_frames_are_named_by_the_targets_radius_where_it_is_seen_or_ends_episodes(field: str) -> None:
    plain = RunConfig()
    wide = replace(plain, reward=replace(plain.reward, delta_m=0.05))
    assert file_of(wide) == file_of(plain)
    env = replace(plain.env, **{field: True})
    assert file_of(replace(wide, env=env)) != file_of(replace(plain, env=env))


def test_variants_share_frames_and_requests_do_not() -> None:
    assert file_of(apply_variant("varpi_10", RunConfig())) == file_of(RunConfig())
    assert frames_file(RunConfig(), replace(REQUEST, first_seed=7), "random") != file_of(RunConfig())
    whole = replace(REQUEST, steps=RunConfig().env.max_steps)
    assert frames_file(RunConfig(), whole, "random") == file_of(RunConfig())
