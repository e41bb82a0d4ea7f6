"""Weights that come while a worker acts."""

import threading
import time

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
    following = FollowingPolicy(Recorder(), hub)
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
    following = FollowingPolicy(Recorder(), hub)
    until(lambda: following.version == 1)
    following.close()


def test_lost_hub_is_raised_where_the_policy_acts() -> None:
    hub = Published(snapshot(0))
    following = FollowingPolicy(Recorder(), hub)
    assert following.await_weights(10.0)
    hub.add(RoleLostError("hub", "crash", "killed"))
    with pytest.raises(RoleLostError, match="hub is gone: killed"):
        until(lambda: following.act(SEEN, NO_VISUAL)[0, 0] == 1)
    with pytest.raises(RoleLostError):
        following.await_weights(10.0)
