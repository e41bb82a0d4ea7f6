"""What a fetcher draws, when, and what it throws away."""

import numpy as np

from slotfilm_dist.cluster.learning_loops import FRESH_S, BatchReserve
from slotfilm_dist.messages import SampleBatch


def batch_of(number: int) -> SampleBatch:
    """A batch of one transition, with a number for its reward."""
    flag, none = np.zeros(1, np.bool_), np.zeros((1, 0), np.float32)
    return SampleBatch(
        visual=none,
        next_visual=none,
        proprio=none,
        next_proprio=none,
        goal=np.zeros((1, 3), np.float32),
        next_goal=np.zeros((1, 3), np.float32),
        action=none,
        reward=np.full(1, number, np.float32),
        discount=np.ones(1, np.float32),
        terminated=flag,
        truncated=flag,
    )


class Store:
    """Numbered batches, in the order in which they are drawn."""

    def __init__(self) -> None:
        self.requests: list[int] = []

    def sample(self, num_batches: int, batch_size: int) -> list[SampleBatch]:
        assert batch_size == 4
        first = sum(self.requests)
        self.requests.append(num_batches)
        return [batch_of(number) for number in range(first, first + num_batches)]

    def num_steps(self) -> int:
        raise NotImplementedError

    def insert_all(self, blocks: object) -> int:
        raise NotImplementedError


class Fetcher:
    """A reserve of 24 batches, and the seconds that pass."""

    def __init__(self) -> None:
        self.store, self.now_s = Store(), 0.0
        self._reserve = BatchReserve(self.store, 4, 24, lambda: self.now_s)

    def take(self, num_batches: int, after_s: float = 0.01, beginning: int = 0) -> list[int]:
        """Numbers of the batches that a grant gets."""
        self.now_s += after_s
        return [int(batch.reward[0]) for batch in self._reserve.take(num_batches, beginning)]


def test_steady_grants_share_a_request() -> None:
    fetcher = Fetcher()
    taken = [number for _ in range(7) for number in fetcher.take(8)]
    assert fetcher.store.requests == [8, 24, 24]
    assert taken == list(range(56))


def test_smaller_grants_leave_the_rest_for_the_next_ones() -> None:
    fetcher = Fetcher()
    assert [len(fetcher.take(n)) for n in (5, 8, 3, 8, 8)] == [5, 8, 3, 8, 8]
    assert fetcher.store.requests == [5, 24, 24]


def test_rare_grants_draw_what_they_need() -> None:
    fetcher = Fetcher()
    taken = [fetcher.take(8, after_s=FRESH_S * 1.1) for _ in range(3)]
    assert fetcher.store.requests == [8, 8, 8]
    assert taken[-1] == list(range(16, 24))


def test_batches_that_have_waited_too_long_are_not_used() -> None:
    fetcher = Fetcher()
    fetcher.take(8)
    assert fetcher.take(8) == list(range(8, 16))
    assert fetcher.take(8, after_s=FRESH_S * 1.1) == list(range(32, 40))


def test_batches_of_an_earlier_beginning_are_not_used() -> None:
    fetcher = Fetcher()
    fetcher.take(8)
    fetcher.take(8)
    assert fetcher.take(8, beginning=1) == list(range(32, 40))
    assert fetcher.take(8, beginning=1) == list(range(40, 48))
