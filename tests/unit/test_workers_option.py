"""What `--workers` means in the config of a run."""

import pytest

from slotfilm_dist.commands.options import build_config
from slotfilm_dist.commands.scale import AUTO, workers_wanted
from slotfilm_dist.commands.train import workers_fields


@pytest.mark.parametrize(("word", "first", "auto"), [("3", 3, False), ("auto", 2, True)])
def test_number_or_auto_reach_the_config(word: str, first: int, auto: bool) -> None:
    runtime = build_config("smoke", "", workers_fields(workers_wanted(word))).runtime
    assert (runtime.num_workers, runtime.auto_workers) == (first, auto)


def test_number_ends_an_earlier_auto() -> None:
    fields = [*workers_fields(AUTO), *workers_fields(4)]
    runtime = build_config("smoke", "", fields).runtime
    assert (runtime.num_workers, runtime.auto_workers) == (4, False)


def test_fewer_at_most_than_at_first_is_refused() -> None:
    with pytest.raises(ValueError, match=r"runtime\.max_workers = 2: must be 0 or at least runtime\.num_workers = 4"):
        build_config("smoke", "", ["--runtime.num_workers", "4", "--runtime.max_workers", "2"])
