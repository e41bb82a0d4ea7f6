"""A worker's policy that keeps itself at the newest weights, in the middle of a block too. Plain, without Ray."""

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Shaped

from slotfilm_dist.cluster.failures import RoleSilentError
from slotfilm_dist.messages import Observation, WeightSnapshot
from slotfilm_dist.policy import Policy

POLL_S = 1.0
"""Longest wait of one request for newer weights."""
SLICE_S = 0.25
"""A pause because of stale weights is cut in slices of this length, so that a stop is noticed."""

_logger = logging.getLogger(__name__)


@runtime_checkable
class WeightLink(Protocol):
    """Where weights are waited for."""

    def await_newer(self, newer_than: int, timeout_s: float) -> WeightSnapshot | None:
        """The newest weights, as soon as there are some newer than a version; None when time runs out."""
        ...


@runtime_checkable
class LoadablePolicy(Policy, Protocol):
    """A `Policy` that takes over published weights, as `AgentPolicy` does."""

    def load(self, version: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over published weights."""
        ...


@runtime_checkable
class ActingPolicy(Policy, Protocol):
    """A `Policy` of the trained agent that gets its weights by itself."""

    def await_weights(self, timeout_s: float) -> bool:
        """Whether it has weights to act with; waits for the first ones."""
        ...

    def take_lags_s(self) -> tuple[float, ...]:
        """Times from a publication until these weights acted here, since the last call."""
        ...

    def close(self) -> None:
        """Follow no weights any more."""
        ...


class WeightFollower:
    """Loads published weights into a policy as they come, in a thread of its own; nobody waits for them but the first.

    Consumes snapshots, by long polls of the hub; produces nothing; waits for a newer version, and for an action under
    way to be chosen (some milliseconds). The newest wins, older versions are left alone. Ends within `POLL_S` of
    `close`, or when the hub is gone, which `raise_error` then says.

    Weights are stale when nothing has been heard for too long: neither newer ones nor that there are none. While the
    learner makes no updates, the hub goes on saying so, and weights of any age are fresh.

    Args:
        policy: gets the weights.
        link: where they come from.
        max_staleness_s: time without an answer from which on the weights are stale.
        clock: seconds that only grow.
    """

    def __init__(
        self,
        policy: LoadablePolicy,
        link: WeightLink,
        max_staleness_s: float = math.inf,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._policy, self._link = policy, link
        self.max_staleness_s, self._clock = max_staleness_s, clock
        self._heard_at = clock()
        self._changed = threading.Condition()
        self._closing = threading.Event()
        self._lags_s: list[float] = []
        self._error: Exception | None = None
        self.version = -1
        """Version of the weights that act; -1 before the first."""
        self.steady = threading.Lock()
        """Held while weights are loaded; hold it while acting."""
        threading.Thread(target=self._run, name="weight-follower", daemon=True).start()

    def await_first(self, timeout_s: float) -> bool:
        """Whether there are weights to act with; raises what ended the thread."""
        with self._changed:
            self._changed.wait_for(lambda: self.version >= 0 or self._error is not None, timeout_s)
        self.raise_error()
        return self.version >= 0

    @property
    def silence_s(self) -> float:
        """Time since the last answer to the question for newer weights."""
        return self._clock() - self._heard_at

    def await_fresh(self, timeout_s: float) -> bool:
        """Whether the weights are not stale; waits for an answer if they are; raises what ended the thread."""
        if self.silence_s > self.max_staleness_s:
            with self._changed:
                self._changed.wait_for(
                    lambda: self.silence_s <= self.max_staleness_s or self._error is not None, timeout_s
                )
        self.raise_error()
        return self.silence_s <= self.max_staleness_s

    def raise_error(self) -> None:
        """Raise what ended the thread, if anything did."""
        if self._error is not None:
            raise self._error

    def take_lags_s(self) -> tuple[float, ...]:
        """Times from publication to being loaded, in seconds, of all but the first weights, since the last call."""
        with self._changed:
            lags, self._lags_s = tuple(self._lags_s), []
        return lags

    def take(self, snapshot: WeightSnapshot) -> bool:
        """Load weights; False for a version that is not newer than those that act."""
        with self.steady:
            if snapshot.version <= self.version:
                return False
            self._policy.load(snapshot.version, snapshot.arrays)
        with self._changed:
            # The first ones may be older than this process: how late they are says nothing of the way here.
            if self.version >= 0:
                self._lags_s.append(max(0.0, time.time() - snapshot.published_at_s))
            self.version = snapshot.version
            self._changed.notify_all()
        return True

    def close(self) -> None:
        """Follow no more."""
        self._closing.set()

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                snapshot = self._link.await_newer(self.version, POLL_S)
                if snapshot is not None and not self._closing.is_set():
                    self.take(snapshot)
                with self._changed:
                    self._heard_at = self._clock()
                    self._changed.notify_all()
            except RoleSilentError:
                continue  # the weights at hand go on acting
            except Exception as error:  # raised again where the policy acts
                with self._changed:
                    self._error = error
                    self._changed.notify_all()
                return


class FollowingPolicy:
    """A policy that a `WeightFollower` keeps up to date.

    Args:
        policy: acts.
        link: where its weights come from.
        note: called with what is waited for while the weights are stale, a few times a second; may raise to end that.
        max_staleness_s: see `WeightFollower`.
    """

    def __init__(
        self, policy: LoadablePolicy, link: WeightLink, note: Callable[[str], None], max_staleness_s: float = math.inf
    ) -> None:
        self._policy, self._note = policy, note
        self._follower = WeightFollower(policy, link, max_staleness_s)
        self.backbone_hash = policy.backbone_hash

    @property
    def version(self) -> int:
        """Version of the weights that act."""
        return self._follower.version

    def await_weights(self, timeout_s: float) -> bool:
        """Whether it has weights to act with; waits for the first ones."""
        return self._follower.await_first(timeout_s)

    def take_lags_s(self) -> tuple[float, ...]:
        """Times from a publication until these weights acted here, since the last call."""
        return self._follower.take_lags_s()

    def visual(self, observation: Observation) -> Shaped[np.ndarray, "envs *visual"]:
        """What replay stores of the pictures; no published weight changes it."""
        return self._policy.visual(observation)

    def act(
        self, observation: Observation, visual: Shaped[np.ndarray, "envs *visual"]
    ) -> Float32[np.ndarray, "envs action"]:
        """Actions of the newest weights; pauses while they are stale."""
        self._pause_while_stale()
        with self._follower.steady:
            return self._policy.act(observation, visual)

    def close(self) -> None:
        """Follow no weights any more."""
        self._follower.close()

    def _pause_while_stale(self) -> None:
        follower, began = self._follower, time.monotonic()
        paused = False
        while not follower.await_fresh(SLICE_S if paused else 0.0):
            waiting_for = (
                f"the hub: no word for {follower.silence_s:.0f} s whether version {follower.version} is the newest, at "
                f"most runtime.max_staleness_s = {follower.max_staleness_s:g}"
            )
            if not paused:
                _logger.warning("waiting for %s", waiting_for)
            paused = True
            self._note(waiting_for)
        if paused:
            _logger.warning("the hub answers again; the pause took %.1f s", time.monotonic() - began)
