"""The cost table's row of an agent."""

from dataclasses import replace

import pytest

from slotfilm_dist.config import RunConfig
from slotfilm_dist.evaluation.cost import cost_of, costs_of
from slotfilm_dist.variants import apply_variant


@pytest.mark.parametrize(
    ("fusion", "encoder_params", "actor_params"),
    [("film_tanh", 2_829_390, 80_398), ("concat_late", 2_824_266, 89_358), ("state_only", 0, 78_606)],
)
def test_parameters_are_those_of_the_paper(fusion: str, encoder_params: int, actor_params: int) -> None:
    base = RunConfig()
    row = cost_of(replace(base, encoder=replace(base.encoder, fusion=fusion)))
    assert row.encoder_params == encoder_params
    assert row.actor_params == actor_params
    assert row.total_params == encoder_params + actor_params
    assert row.rate_hz == pytest.approx(1000 / row.latency_ms_mean)
    assert row.latency_ms_mean > 0
    assert row.peak_memory_mb > 10
    assert 0 <= row.model_memory_mb < row.peak_memory_mb
    assert row.device.startswith("cpu")


@pytest.mark.parametrize(
    ("variant", "encoder_params", "actor_params"),
    [
        # Four convolutions of 32 filters: 896 + 3 x 9,248 = 28,640.
        ("cnn", 28_640 + 1_568 * 42 + 42, 80_398),
        ("cnn_state", 28_640 + 1_568 * 42 + 42, 89_358),
        ("drq", 28_640 + 103_968 * 50 + 50 + 100, 82_446),
        ("drqv2", 28_640, 103_968 * 50 + 50 + 100 + 50 * 1024 + 1024 + 1024 * 1024 + 1024 + 1024 * 7 + 7),
    ],
)
def test_parameters_of_the_pixel_baselines(variant: str, encoder_params: int, actor_params: int) -> None:
    row = cost_of(apply_variant(variant, RunConfig()))
    assert (row.encoder_params, row.actor_params) == (encoder_params, actor_params)


def test_an_agents_memory_does_not_depend_on_who_was_measured_before() -> None:
    """DrQ-v2's 25 MB of weights must not show in the row of the agent that has none to speak of."""
    configs = [apply_variant(name, RunConfig()) for name in ("drqv2", "state_only")]
    large, small = costs_of(configs, "cpu")
    assert (large.variant, small.variant) == ("drqv2", "state_only")
    assert large.model_memory_mb > 25
    assert small.peak_memory_mb < large.peak_memory_mb - 10
