"""Rows of the bench and the object that `--json` prints."""

import json

import pytest

from slotfilm_dist.bench.results import (
    BenchOptions,
    as_json,
    at_least,
    at_most,
    for_information,
    not_measured,
    worst_first,
)

KEYS = {"name", "measured", "goal", "holds", "unit", "how"}


def test_goals_hold_from_their_own_value_on() -> None:
    assert [at_least("a", x, 2.0, "times", "").holds for x in (1.9, 2.0, 2.1)] == [False, True, True]
    assert [at_most("a", x, 2.0, "ms", "").holds for x in (1.9, 2.0, 2.1)] == [True, True, False]


def test_json_has_the_promised_keys_and_null_for_what_is_not_known() -> None:
    rows = [for_information("i", 1.5, "ms", "x"), not_measured("n", 3.0, "times", "no GPU; use a host with one")]
    found = json.loads(json.dumps(as_json(rows)))
    assert set(found) == {"results"}
    assert all(set(row) == KEYS for row in found["results"])
    assert (found["results"][0]["goal"], found["results"][0]["holds"]) == (None, None)
    missing = found["results"][1]
    assert (missing["measured"], missing["holds"], missing["goal"]) == (None, None, 3.0)
    assert missing["how"] == "not measured: no GPU; use a host with one"


def test_rows_that_fall_short_come_first() -> None:
    rows = [
        for_information("information", 1.0, "ms", ""),
        at_least("held", 3.0, 2.0, "times", ""),
        not_measured("missing", 2.0, "times", ""),
        at_least("short", 1.0, 2.0, "times", ""),
    ]
    assert [row.name for row in worst_first(rows)] == ["short", "missing", "held", "information"]


def test_no_rounds_are_refused() -> None:
    with pytest.raises(ValueError, match="--rounds 0"):
        BenchOptions(rounds=0)
    assert (BenchOptions(quick=True).scaled(50), BenchOptions(quick=True).scaled(5), BenchOptions().scaled(50)) == (
        5,
        1,
        50,
    )
