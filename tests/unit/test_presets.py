"""Presets: the paper's numbers, and budgets that fit what they promise."""

import pytest

from slotfilm_dist.config import RunConfig
from slotfilm_dist.presets import PRESETS, paper, preset_named


def test_paper_preset_has_the_papers_numbers() -> None:
    config = paper()
    assert config == RunConfig()
    assert (config.lr.actor, config.lr.critic_value, config.lr.fusion, config.lr.goal_gate) == (1e-4, 1e-3, 1e-4, 3e-5)
    assert (config.sac.gamma, config.sac.tau, config.sac.batch_size, config.sac.reward_scale) == (0.99, 0.005, 128, 10)
    assert (config.schedule.total_steps, config.schedule.random_steps) == (1_200_000, 100_000)
    assert (config.pretrain.steps, config.replay.capacity, config.env.max_steps) == (150_000, 1_000_000, 400)
    assert (config.reward.alpha, config.reward.varpi, config.reward.delta_m) == (10, 5, 0.025)
    assert (config.encoder.feature_dim, config.encoder.num_heads, config.encoder.pos_scale) == (42, 3, 0.05)


@pytest.mark.parametrize("name", list(PRESETS))
def test_preset_collects_enough_to_hold_episodes_out_and_then_trains(name: str) -> None:
    config = PRESETS[name]()
    assert config.schedule.random_steps >= 2 * config.env.max_steps
    assert config.schedule.total_steps > config.schedule.random_steps
    assert config.replay.capacity >= config.schedule.random_steps
    assert (PRESETS[name].__doc__ or "").strip()


def test_unknown_preset_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(ValueError, match="preset = 'quik': no such preset; did you mean 'quick'"):
        preset_named("quik")
    with pytest.raises(ValueError, match="known: smoke, quick"):
        preset_named("zzzz")
