"""A replay that cannot fit is refused with the capacity that does."""

import re
from dataclasses import replace

import pytest

from slotfilm_dist.config import RunConfig
from slotfilm_dist.presets import PRESETS
from slotfilm_dist.replay.memory import SHARE, check_memory, replay_bytes
from slotfilm_dist.variants import apply_variant

GB = 10**9


def test_pictures_take_nine_times_the_memory_of_tokens_and_the_state_next_to_nothing() -> None:
    slots, pixels, state = (
        replay_bytes(apply_variant(v, RunConfig()), 1000) for v in ("slotfilm", "drq", "state_only")
    )
    assert pixels / slots == pytest.approx(49_400 / 5_600, rel=0.02)
    assert state < 300 * 1000
    assert replay_bytes(apply_variant("end_to_end", RunConfig()), 1000) == pixels


def test_refusal_names_a_capacity_that_fits() -> None:
    config = apply_variant("drq", RunConfig())
    with pytest.raises(ValueError, match=r"replay.capacity = 1000000: 1000000 pictures take 5\d.\d GB") as refusal:
        check_memory(config, 16 * GB)
    named = re.search(r"set --replay.capacity to (\d+) or less", str(refusal.value))
    assert named is not None
    fits = int(named[1])
    assert 0.8 < replay_bytes(config, fits) / (SHARE * 16 * GB) <= 1
    check_memory(replace(config, replay=replace(config.replay, capacity=fits)), 16 * GB)


def test_steps_that_are_never_taken_need_no_memory() -> None:
    config = apply_variant("drq", PRESETS["smoke"]())
    check_memory(replace(config, replay=replace(config.replay, capacity=1_000_000)), GB)


@pytest.mark.parametrize("variant", ["slotfilm", "cnn", "drq", "drqv2"])
@pytest.mark.parametrize("preset", ["smoke", "quick"])
def test_short_presets_fit_into_4_gb(preset: str, variant: str) -> None:
    check_memory(apply_variant(variant, PRESETS[preset]()), 4 * GB)
