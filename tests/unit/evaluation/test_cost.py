"""The cost table's row of an agent."""

from dataclasses import replace

import pytest

from slotfilm_dist.config import RunConfig
from slotfilm_dist.evaluation.cost import cost_of


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
    assert row.device.startswith("cpu")
