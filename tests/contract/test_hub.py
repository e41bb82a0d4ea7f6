"""Admission of steps and updates, and weights, from the hub itself and from the hub behind its client."""

import threading
import time

import numpy as np
import pytest

from slotfilm_dist.cluster.acting import WeightLink
from slotfilm_dist.cluster.hub import Hub
from slotfilm_dist.cluster.hub_client import HubClient
from slotfilm_dist.cluster.messages import BlockKey, BlockNotice
from slotfilm_dist.contracts import WeightSource
from slotfilm_dist.messages import WeightSnapshot

AnyHub = Hub | HubClient


def notice(sequence: int, *, worker_id: int = 0, incarnation: int = 0, version: int = -1) -> BlockNotice:
    """A block of 16 steps."""
    key = BlockKey(worker_id=worker_id, incarnation=incarnation, sequence=sequence)
    return BlockNotice(key=key, num_steps=16, policy_version=version, episodes=())


def snapshot(version: int) -> WeightSnapshot:
    arrays = {"actor.weight": np.full(100_000, version, np.float32)}
    return WeightSnapshot(version=version, published_at_s=time.time(), arrays=arrays)


def until(holds, timeout_s: float = 20.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def publish(hub: AnyHub, version: int) -> None:
    hub.publish(snapshot(version))
    until(lambda: hub.newest_version() >= version)


def test_steps_and_updates_keep_their_ratio_and_who_waits_is_told_for_what(hub: AnyHub) -> None:
    hub.count_random_steps(1)
    granted = [hub.admit_steps(notice(sequence), [], 0.05) for sequence in range(6)]
    allowed = sum(grant.granted for grant in granted)
    assert 2 <= allowed < 6  # the workers' lead
    assert "more updates" in granted[-1].waiting_for
    assert hub.admit_updates(4, 1.0).num_updates == 4
    num_updates = 4
    while (grant := hub.admit_updates(4, 0.05)).num_updates:
        num_updates += grant.num_updates
    assert num_updates == 8 * allowed
    assert "more environment steps" in grant.waiting_for
    assert hub.status().updates_owed == 0


def test_block_asked_for_again_counts_once_and_a_lost_one_is_taken_back(hub: AnyHub) -> None:
    hub.count_random_steps(1)
    for _ in range(2):
        assert hub.admit_steps(notice(0), [], 1.0).granted
    assert hub.admit_steps(notice(1), [notice(0).key], 1.0).granted
    assert hub.status().env_steps == 17  # what is under way does not count yet
    assert hub.pending(0, 0) == [notice(1).key]
    assert hub.settle(0, 0, []) == 16
    assert not hub.admit_steps(notice(2), [], 0.05).granted  # from an incarnation that has been given up
    assert hub.admit_steps(notice(0, incarnation=1), [], 1.0).granted
    assert (hub.status().env_steps, hub.status().num_refunded_steps) == (17, 16)


def test_run_is_finished_after_its_last_step(hub: AnyHub) -> None:
    for sequence in range(63):  # before learning begins nothing is held back
        key = notice(sequence).key
        assert hub.admit_steps(notice(sequence), [], 1.0).granted
        hub.confirm([key])
    last = hub.admit_steps(notice(63), [], 0.05)
    assert (last.granted, last.finished, hub.status().finished) == (False, True, True)


def test_newest_weights_win(hub: AnyHub) -> None:
    assert isinstance(hub, WeightSource)
    assert isinstance(hub, WeightLink)
    assert hub.latest(-1) is None
    publish(hub, 10)
    hub.publish(snapshot(5))  # overtaken on the way
    publish(hub, 20)
    for newest in (hub.latest(-1), hub.latest(10), hub.await_newer(10, 5.0)):
        assert newest is not None
        assert newest.version == 20
        np.testing.assert_array_equal(newest.arrays["actor.weight"], np.full(100_000, 20, np.float32))
    assert hub.latest(20) is None
    assert hub.status().num_published == 2


def test_who_waits_for_weights_gets_them_when_they_come(hub: AnyHub) -> None:
    publish(hub, 0)
    assert hub.await_newer(0, 0.05) is None
    got: list[WeightSnapshot | None] = []
    waiting = [threading.Thread(target=lambda: got.append(hub.await_newer(0, 60.0))) for _ in range(3)]
    for thread in waiting:
        thread.start()
    assert hub.await_newer(0, 0.5) is None  # by now the others wait
    hub.publish(snapshot(1))
    for thread in waiting:
        thread.join(20.0)
    assert [snapshot.version for snapshot in got if snapshot] == [1, 1, 1]


def test_number_of_workers_that_somebody_asked_for_is_kept(hub: AnyHub) -> None:
    hub.want_auto_workers()
    hub.adapt_workers(5)
    assert (hub.status().wanted_workers, hub.status().auto_workers) == (5, True)
    hub.want_workers(3)
    hub.adapt_workers(6)
    assert (hub.status().wanted_workers, hub.status().auto_workers) == (3, False)
    with pytest.raises(ValueError, match="workers = 0: must be 1 or more"):
        hub.want_workers(0)
