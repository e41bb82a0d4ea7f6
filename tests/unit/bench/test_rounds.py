"""Interleaving and its statistics."""

from collections.abc import Callable

import pytest

from slotfilm_dist.bench.rounds import Rounds, interleave


def test_ratio_is_the_median_of_the_rounds_own_ratios() -> None:
    rounds = Rounds({"a": [10.0, 30.0, 2.0], "b": [1.0, 10.0, 1.0]})
    ratio = rounds.ratio("a", "b")
    # The ratio of the medians would be 10.
    assert (ratio.median, ratio.low, ratio.high) == (3.0, 2.0, 10.0)
    rate = rounds.rate("a")
    assert (rate.median, rate.low, rate.high) == (10.0, 2.0, 30.0)


def test_contenders_take_turns_and_the_warm_up_does_not_count() -> None:
    calls: list[str] = []

    def contender(name: str) -> Callable[[], float]:
        def work() -> float:
            calls.append(name)
            return float(calls.count(name))

        return work

    rounds = interleave({"a": contender("a"), "b": contender("b")}, 3)
    assert calls == ["a", "b", "a", "b", "b", "a", "a", "b"]
    assert rounds.num_rounds == 3
    assert (rounds.rate("a").low, rounds.rate("a").high) == (2.0, 4.0)


def test_description_names_both_and_the_ratio() -> None:
    text = Rounds({"ours": [4.0], "theirs": [2.0]}).describe("ours", "theirs", "steps/s")
    assert text == ("ours 4 (4 to 4) steps/s, theirs 2 (2 to 2) steps/s; ratio 2 (2 to 2) over 1 interleaved rounds")


def test_uneven_rounds_are_refused() -> None:
    with pytest.raises(AssertionError, match="every contender"):
        Rounds({"a": [1.0], "b": [1.0, 2.0]})
