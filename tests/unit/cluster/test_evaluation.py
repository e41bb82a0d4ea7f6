"""Players that hang or are in nobody's way, without Ray."""

import time
from collections.abc import Iterator
from typing import Any, ClassVar

import pytest

from slotfilm_dist.backend import EvaluationFailedError
from slotfilm_dist.cluster import evaluation
from slotfilm_dist.cluster.evaluation import EvaluationPool
from slotfilm_dist.cluster.failures import RoleSilentError
from slotfilm_dist.cluster.role_clients import PlayerClient
from slotfilm_dist.presets import smoke

SEEDS = [10_000_000, 10_000_001, 10_000_002]


class Player(PlayerClient):
    """Answers at once, or never."""

    def __init__(self) -> None:
        """Without a process."""

    hanging: ClassVar[set[object]] = set()
    """Seeds whose first request is never answered; `prepare` for every environment."""
    num_killed = 0

    def begin_prepare(self, *arguments: Any) -> str:
        return "prepare"

    def begin_play(self, seed: int) -> int:
        if seed in Player.hanging:
            Player.hanging.discard(seed)
            return -1
        return seed

    def answer(self, request: Any, waiting_for: str, timeout_s: float) -> Any:
        if request == -1 or request in Player.hanging:
            raise RoleSilentError("player", waiting_for, timeout_s)
        return f"episode {request}"

    def kill(self) -> None:
        Player.num_killed += 1


@pytest.fixture
def pool(monkeypatch: pytest.MonkeyPatch) -> Iterator[EvaluationPool]:
    monkeypatch.setattr(PlayerClient, "launch", classmethod(lambda cls, *arguments: Player()))
    monkeypatch.setattr(evaluation, "PREPARE_S", 0.05)
    monkeypatch.setattr(evaluation, "EPISODE_S", 0.05)
    Player.hanging, Player.num_killed = set(), 0
    return EvaluationPool(smoke(), lambda *_: None, 1.0, 2)


def play(pool: EvaluationPool, give_up: Any = lambda: False) -> list[Any]:
    return list(pool.play("random", SEEDS, give_up, camera=False, setup=None, snapshot=None))


def test_episode_that_hangs_is_played_again_by_another_player(pool: EvaluationPool) -> None:
    Player.hanging = {SEEDS[1]}
    assert play(pool) == [f"episode {seed}" for seed in SEEDS]
    assert Player.num_killed == 1


def test_players_that_never_begin_are_given_up_in_time(pool: EvaluationPool) -> None:
    Player.hanging = {"prepare"}
    with pytest.raises(EvaluationFailedError, match=r"its environment; is a core free for it"):
        play(pool)


def test_stop_ends_the_episodes_under_way(pool: EvaluationPool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluation, "EPISODE_S", 60.0)
    Player.hanging = set(SEEDS)
    asked = iter([False] * 5 + [True])
    assert play(pool, lambda: next(asked)) == []
    assert (pool.size, Player.num_killed) == (0, 2)


def test_player_that_finds_no_core_is_left_out_while_another_plays(
    pool: EvaluationPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_room = pool._players[0]
    begin = Player.begin_prepare
    monkeypatch.setattr(Player, "begin_prepare", lambda self, *a: -1 if self is without_room else begin(self, *a))
    monkeypatch.setattr(evaluation, "EPISODE_S", 60.0)
    answer, until = Player.answer, time.monotonic() + 0.5

    def slowly(self: Player, request: Any, waiting_for: str, timeout_s: float) -> Any:
        if request in SEEDS and time.monotonic() < until:
            raise RoleSilentError("player", waiting_for, timeout_s)
        return answer(self, request, waiting_for, timeout_s)

    monkeypatch.setattr(Player, "answer", slowly)
    assert play(pool) == [f"episode {seed}" for seed in SEEDS]
    assert (pool.size, Player.num_killed) == (1, 1)


def test_room_counts_the_players_that_have_cores_already(pool: EvaluationPool) -> None:
    assert (pool.room(0.0), pool.room(1.5)) == (2, 3)
