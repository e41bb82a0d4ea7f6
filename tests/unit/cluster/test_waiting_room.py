"""More workers than the hub has threads to wait on."""

import threading
import time
from collections.abc import Iterable

import numpy as np

from slotfilm_dist.cluster.actors import CONCURRENCY, HubActor
from slotfilm_dist.cluster.failures import RoleSilentError
from slotfilm_dist.cluster.hub import ASKS_PER_S, LEAST_RETRY_S, WAITING_ROOM, Hub
from slotfilm_dist.cluster.messages import BlockKey, BlockNotice, StepGrant
from slotfilm_dist.cluster.sender import BlockSender
from slotfilm_dist.messages import TransitionBlock
from slotfilm_dist.replay.limiter import RateLimiter


def notice(worker_id: int) -> BlockNotice:
    key = BlockKey(worker_id=worker_id, incarnation=0, sequence=0)
    return BlockNotice(key=key, num_steps=8, policy_version=0, episodes=())


def full_hub(waiting_room: int) -> tuple[Hub, RateLimiter]:
    """A hub whose workers are as far ahead as they may be."""
    limiter = RateLimiter(1.0, 0, slack_updates=0, slack_steps=20)
    limiter.start_learning(0)
    assert limiter.try_insert(16)
    return Hub(limiter, 100_000, 1, waiting_room=waiting_room), limiter


def update(limiter: RateLimiter, times: int) -> None:
    assert all(limiter.try_update(1) for _ in range(times))


def until(holds, timeout_s: float = 20.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_those_beyond_the_waiting_room_are_answered_at_once_and_those_inside_are_served() -> None:
    hub, limiter = full_hub(waiting_room=2)
    grants: list[StepGrant] = []
    waiting = [
        threading.Thread(target=lambda i=i: grants.append(hub.admit_steps(notice(i), [], 60.0))) for i in range(2)
    ]
    for thread in waiting:
        thread.start()
    until(lambda: limiter.waiting_inserts == 2)
    began = time.monotonic()
    third = hub.admit_steps(notice(2), [], 60.0)
    assert time.monotonic() - began < 30.0
    assert not third.granted
    assert not third.finished
    assert "16 steps and 0 updates" in third.waiting_for
    assert LEAST_RETRY_S / 2 <= third.retry_s <= LEAST_RETRY_S * 1.5
    update(limiter, 16)
    for thread in waiting:
        thread.join(20.0)
    assert [grant.granted for grant in grants] == [True, True]
    assert [grant.retry_s for grant in grants] == [0.0, 0.0]


def test_places_are_free_again_once_their_holders_have_gone() -> None:
    hub, limiter = full_hub(waiting_room=1)
    for _ in range(3):
        assert hub.admit_steps(notice(0), [], 0.01).retry_s == 0
    update(limiter, 16)
    assert hub.admit_steps(notice(0), [], 0.01).granted


def test_without_a_place_steps_that_fit_are_granted_at_once() -> None:
    hub, limiter = full_hub(waiting_room=0)
    update(limiter, 8)
    assert hub.admit_steps(notice(0), [], 60.0).granted


def test_many_workers_together_ask_at_a_bounded_rate_at_scattered_times() -> None:
    hub, _ = full_hub(waiting_room=0)
    grants = [hub.admit_steps(notice(worker), [], 60.0) for worker in range(600)]
    last = [grant.retry_s for grant in grants[-100:]]
    assert 0.5 * 500 / ASKS_PER_S <= min(last) < max(last) <= 1.5 * 600 / ASKS_PER_S
    assert len(set(last)) > 90


def test_hub_has_threads_for_those_that_wait_and_spare_ones_for_those_that_ask() -> None:
    assert CONCURRENCY[HubActor]["workers"] >= WAITING_ROOM + 8


class Crowded:
    """A hub that sends a worker away some times, then admits it."""

    def __init__(self, times: int) -> None:
        self.times, self.asked_at = times, list[float]()
        self.confirmed: list[BlockKey] = []

    def admit_steps(self, notice: BlockNotice, stored: Iterable[BlockKey], timeout_s: float) -> StepGrant:
        self.asked_at.append(time.monotonic())
        granted = len(self.asked_at) > self.times
        return StepGrant(granted=granted, waited_s=0.0, waiting_for="", finished=False, retry_s=0.0 if granted else 0.2)

    def confirm(self, stored: Iterable[BlockKey]) -> None:
        self.confirmed += stored


class Store:
    def __init__(self, silent: int = 0) -> None:
        self.blocks: list[TransitionBlock] = []
        self.silent = silent

    def insert(self, block: TransitionBlock) -> bool:
        if self.silent:
            self.silent -= 1
            raise RoleSilentError("shard 0", "a block to be stored", 5.0)
        self.blocks.append(block)
        return True

    def index_of(self, block: TransitionBlock) -> int:
        return 0


def one_block() -> TransitionBlock:
    return TransitionBlock(
        worker_id=0,
        incarnation=0,
        sequence=0,
        policy_version=0,
        backbone_hash="",
        visual=np.zeros((1, 0), np.uint8),
        proprio=np.zeros((1, 3), np.float32),
        goal=np.zeros((1, 3), np.float32),
        uv=np.zeros((1, 2, 2), np.float32),
        visible=np.zeros((1, 2), bool),
        action=np.zeros((1, 7), np.float32),
        reward=np.zeros(1, np.float32),
        terminated=np.zeros(1, bool),
        truncated=np.zeros(1, bool),
        is_step=np.ones(1, bool),
    )


def test_sender_that_is_sent_away_asks_again_only_after_that_time() -> None:
    hub, store = Crowded(times=2), Store()
    sender = BlockSender(hub, store)
    block = one_block()
    assert sender.offer(block, 10.0)
    until(lambda: store.blocks)
    sender.close()
    assert len(hub.asked_at) == 3
    assert min(np.diff(hub.asked_at)) >= 0.2


def test_block_that_its_shard_took_only_after_the_last_grant_is_confirmed() -> None:
    hub, store = Crowded(times=0), Store(silent=3)
    sender = BlockSender(hub, store)
    assert sender.offer(one_block(), 10.0)
    until(lambda: hub.asked_at)
    sender.finished = True  # as the hub says to whoever asks after the run's last step
    until(lambda: store.blocks)
    sender.close()
    assert hub.confirmed == [BlockKey(worker_id=0, incarnation=0, sequence=0)]
