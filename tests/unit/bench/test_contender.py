"""Contenders in processes of their own."""

import pytest

from slotfilm_dist.bench.contender import Contender, ContenderError


def test_child_answers_with_its_own_threads_and_survives_a_failure() -> None:
    with Contender("echo", {"factor": 2.5}, threads=3) as child:
        assert child.ask("times", number=4) == 10.0
        assert child.ask("threads") == "3"
        with pytest.raises(ContenderError, match="RuntimeError: no luck"):
            child.ask("fail")
        assert child.ask("times", number=2) == 5.0


def test_child_that_cannot_be_built_says_why() -> None:
    with pytest.raises(ContenderError, match="factor: must not be negative"):
        Contender("echo", {"factor": -1.0})


def test_module_that_ends_at_once_is_reported_with_its_last_words() -> None:
    with pytest.raises(ContenderError, match=r"No module named .*nothing"):
        Contender("nothing", {})
