"""Weights that come while a worker acts."""

import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from slotfilm_dist.cluster.acting import FollowingPolicy, WeightFollower
from slotfilm_dist.cluster.failures import RoleLostError, RoleSilentError
from slotfilm_dist.messages import Observation, WeightSnapshot


class Recorder:
    """A policy that notes what it loads and whether it was disturbed while acting."""

    version = 0
    backbone_hash = "b"

    def __init__(self) -> None:
        self.loaded: list[int] = []

    def load(self, version: int, arrays: dict[str, np.ndarray]) -> None:
        self.loaded.append(version)

    def visual(self, observation: Observation) -> np.ndarray:
        return np.zeros((1, 0), np.uint8)

    def act(self, observation: Observation, visual: np.ndarray) -> np.ndarray:
        return np.full((1, 7), self.loaded[-1], np.float32)


class Published:
    """A hub that hands out what is in it, then waits; raises what it is told to."""

    def __init__(self, *answers: WeightSnapshot | Exception) -> None:
        self._answers = list(answers)
        self._changed = threading.Condition()

    def add(self, answer: WeightSnapshot | Exception) -> None:
        with self._changed:
            self._answers.append(answer)
            self._changed.notify_all()

    def await_newer(self, newer_than: int, timeout_s: float) -> WeightSnapshot | None:
        with self._changed:
            if not self._changed.wait_for(lambda: self._answers, timeout_s):
                return None
            answer = self._answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer


class Waits:
    """Notes what is waited for, does what it is told to then, and ends the wait when told to."""

    def __init__(self, last: int = 1 << 30, then: Callable[[], object] = lambda: None) -> None:
        self.texts: list[str] = []
        self.last, self.then = last, then

    def __call__(self, waiting_for: str) -> None:
        self.texts.append(waiting_for)
        self.then()
        if len(self.texts) >= self.last:
            raise StopIteration


class Answering:
    """A hub that answers as long as it is told to: its first weights, then that there are none newer."""

    def __init__(self) -> None:
        self.answers = threading.Event()
        self.answers.set()
        self.asked = threading.Semaphore(0)

    def await_newer(self, newer_than: int, timeout_s: float) -> WeightSnapshot | None:
        self.asked.release()
        if not self.answers.wait(0.01):
            raise RoleSilentError("hub", "newer weights", 0.01)
        return snapshot(0) if newer_than < 0 else None


SEEN = Observation(
    rgb=None,
    proprio=np.zeros((1, 35), np.float32),
    uv=np.zeros((1, 2, 2), np.float32),
    visible=np.zeros((1, 2), bool),
    goal=np.zeros((1, 3), np.float32),
)
NO_VISUAL = np.zeros((1, 0), np.uint8)


def snapshot(version: int, published_at_s: float | None = None) -> WeightSnapshot:
    return WeightSnapshot(version=version, published_at_s=published_at_s or time.time(), arrays={})


def until(holds, timeout_s: float = 10.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_newest_weights_win_and_older_ones_are_left_alone() -> None:
    policy, hub = Recorder(), Published(snapshot(5), snapshot(3), snapshot(5), snapshot(9))
    follower = WeightFollower(policy, hub)
    until(lambda: follower.version == 9)
    follower.close()
    assert policy.loaded == [5, 9]


def test_first_weights_are_waited_for_and_the_lag_of_later_ones_is_told_once() -> None:
    hub = Published()
    following = FollowingPolicy(Recorder(), hub, Waits())
    assert not following.await_weights(0.01)
    assert following.version == -1
    hub.add(snapshot(0, published_at_s=time.time() - 2.0))
    assert following.await_weights(10.0)
    assert following.take_lags_s() == ()
    assert following.act(SEEN, NO_VISUAL)[0, 0] == 0
    hub.add(snapshot(1, published_at_s=time.time() - 3.0))
    until(lambda: following.version == 1)
    (lag_s,) = following.take_lags_s()
    assert 3.0 <= lag_s < 13.0
    assert following.take_lags_s() == ()
    following.close()


def test_weights_are_not_loaded_in_the_middle_of_an_action() -> None:
    policy, hub = Recorder(), Published(snapshot(0))
    follower = WeightFollower(policy, hub)
    assert follower.await_first(10.0)
    with follower.steady:
        hub.add(snapshot(1))
        until(lambda: not hub._answers)
        assert policy.loaded == [0]
    until(lambda: policy.loaded == [0, 1])
    follower.close()


def test_silent_hub_leaves_the_old_weights_acting() -> None:
    hub = Published(snapshot(0), RoleSilentError("hub", "newer weights", 1.0), snapshot(1))
    following = FollowingPolicy(Recorder(), hub, Waits())
    until(lambda: following.version == 1)
    following.close()


def test_lost_hub_is_raised_where_the_policy_acts() -> None:
    hub = Published(snapshot(0))
    following = FollowingPolicy(Recorder(), hub, Waits())
    assert following.await_weights(10.0)
    hub.add(RoleLostError("hub", "crash", "killed"))
    with pytest.raises(RoleLostError, match="hub is gone: killed"):
        until(lambda: following.act(SEEN, NO_VISUAL)[0, 0] == 1)
    with pytest.raises(RoleLostError):
        following.await_weights(10.0)


def test_weights_of_any_age_act_while_the_hub_says_that_there_are_none_newer() -> None:
    hub, now = Answering(), [0.0]
    follower = WeightFollower(Recorder(), hub, max_staleness_s=10.0, clock=lambda: now[0])
    assert follower.await_first(10.0)
    now[0] = 1e6
    assert follower.await_fresh(10.0)
    assert follower.silence_s == 0
    follower.close()


def test_weights_go_stale_without_a_word_and_are_fresh_again_with_one() -> None:
    hub, now = Answering(), [0.0]
    follower = WeightFollower(Recorder(), hub, max_staleness_s=10.0, clock=lambda: now[0])
    assert follower.await_first(10.0)
    hub.answers.clear()
    while hub.asked.acquire(blocking=False):
        pass
    # The answer to the question before the last may still have been under way, that to the last is not.
    assert hub.asked.acquire(timeout=10.0)
    assert hub.asked.acquire(timeout=10.0)
    now[0] = 10.0
    assert follower.await_fresh(0.0)
    now[0] = 10.5
    assert not follower.await_fresh(0.0)
    hub.answers.set()
    assert follower.await_fresh(10.0)
    follower.close()


def test_policy_pauses_while_its_weights_are_stale_and_names_the_hub(caplog: pytest.LogCaptureFixture) -> None:
    hub = Answering()
    waits = Waits(then=hub.answers.set)
    following = FollowingPolicy(Recorder(), hub, waits, max_staleness_s=0.3)
    assert following.await_weights(10.0)
    hub.answers.clear()
    until(lambda: following.act(SEEN, NO_VISUAL) is not None and waits.texts)
    assert "the hub: no word for" in waits.texts[0]
    assert "runtime.max_staleness_s = 0.3" in waits.texts[0]
    assert "waiting for the hub" in caplog.messages[0]
    assert "the hub answers again" in caplog.messages[1]
    following.close()


def test_pause_ends_when_the_worker_is_told_to_stop() -> None:
    hub = Answering()
    following = FollowingPolicy(Recorder(), hub, Waits(last=2), max_staleness_s=0.05)
    assert following.await_weights(10.0)
    hub.answers.clear()
    with pytest.raises(StopIteration):
        until(lambda: following.act(SEEN, NO_VISUAL) is None)
    following.close()
