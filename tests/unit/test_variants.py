"""Variants: each a difference from the proposed agent that can be seen and built."""

from dataclasses import replace

import pytest

from slotfilm_dist.config import RunConfig
from slotfilm_dist.config_files import changed_fields, from_dict, to_dict
from slotfilm_dist.presets import PRESETS
from slotfilm_dist.variants import SECTIONS, VARIANTS, apply_variant, describe_variant


@pytest.mark.parametrize("preset", list(PRESETS))
@pytest.mark.parametrize("name", list(VARIANTS))
def test_every_variant_of_every_preset_is_a_valid_config(name: str, preset: str) -> None:
    config = apply_variant(name, PRESETS[preset]())
    assert config.variant == name
    assert from_dict(RunConfig, to_dict(config)) == config


def test_variants_differ_from_the_proposed_agent_and_from_each_other() -> None:
    changes = {name: str(changed_fields(RunConfig(), VARIANTS[name](RunConfig()))) for name in VARIANTS}
    assert changes["slotfilm"] == "{}"
    assert len(set(changes.values())) == len(VARIANTS)


@pytest.mark.parametrize(
    ("name", "field", "value"),
    [
        ("film_clamp", "encoder.fusion", "film_clamp"),
        ("no_state", "encoder.fusion", "none"),
        ("state_only", "encoder.fusion", "state_only"),
        ("no_static", "reward.weights.static", 0.0),
        ("varpi_10", "reward.varpi", 10.0),
        ("reward_scale_15", "sac.reward_scale", 15.0),
        ("slots_4", "encoder.num_slots", 4),
        ("end_to_end", "sac.end_to_end", True),
        ("oracle_state", "obs.state_dim", 35 + 14 + 6),
    ],
)
def test_variant_changes_what_its_name_says(name: str, field: str, value: object) -> None:
    described = describe_variant(name)
    assert described["params"][field] == value  # type: ignore[index]  # params is a dict
    assert described["section"] in SECTIONS
    assert str(described["difference"]).endswith((".", ")."))


@pytest.mark.parametrize("total", [100_001, 150_000, 300_000, 1_200_000])
def test_drqv2_learns_for_its_share_of_any_budget(total: int) -> None:
    base = RunConfig()
    schedule = apply_variant("drqv2", replace(base, schedule=replace(base.schedule, total_steps=total))).schedule
    learning = schedule.total_steps - schedule.random_steps
    assert learning >= max(1, (total - schedule.random_steps) * 7 // 11)
    assert schedule.total_steps <= total
    assert total != 1_200_000 or schedule.total_steps == 800_000


@pytest.mark.parametrize("preset", list(PRESETS))
def test_without_stability_every_other_component_pays_what_it_did(preset: str) -> None:
    whole, without = PRESETS[preset]().reward, apply_variant("no_static", PRESETS[preset]()).reward
    assert without.weights.static == 0
    for name in ("reach", "grasp", "place", "post_grasp"):
        pays, paid = (getattr(reward.weights, name) / reward.divisor for reward in (without, whole))
        assert pays == pytest.approx(paid)


def test_unknown_variant_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(ValueError, match="variant = 'no_stat': no such variant; did you mean 'no_state'"):
        apply_variant("no_stat", RunConfig())
