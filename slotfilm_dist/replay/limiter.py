"""The one authority over the ratio of updates to environment steps."""

import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from slotfilm_dist.config import check


@dataclass(frozen=True, kw_only=True, slots=True)
class Admission:
    """The limiter's answer to someone who was ready to wait."""

    granted: bool
    """The steps or updates may go ahead and have been counted."""
    waited_s: float
    """Time spent waiting, in seconds."""
    waiting_for: str
    """What was still missing when time ran out; empty if granted."""


class RateLimiter:
    """Holds updates per environment step to a fixed ratio by making the side that is ahead wait. Thread-safe.

    With b the environment steps at which learning began, updates stay between
    `updates_per_step * (env_steps - b - slack_steps)` and `updates_per_step * (env_steps - b) + slack_updates`; the
    arithmetic is exact. Over a window of w steps the ratio is therefore off by at most
    `(slack_steps + slack_updates / updates_per_step) / w`: at most 1 % of 10 000 steps with slacks of 100 in sum.
    Steps collected before learning owe no updates and are never held back.

    Whoever waits is woken by the other side's progress, by `start_learning`, by `close`, or gives up after its timeout.
    A grant counts at once; `refund_insert` and `refund_update` take back what then did not happen.

    Args:
        updates_per_step: the ratio.
        min_steps: environment steps before the first update.
        slack_updates: updates the learner may be ahead; 0 lets it follow the steps exactly.
        slack_steps: steps the workers may be ahead; at least what they send at once.
    """

    def __init__(self, updates_per_step: float, min_steps: int, slack_updates: int, slack_steps: int) -> None:
        check(updates_per_step > 0, "updates_per_step", updates_per_step, "must be greater than 0")
        check(min_steps >= 0, "min_steps", min_steps, "must be 0 or more")
        check(slack_updates >= 0, "slack_updates", slack_updates, "must be 0 or more")
        check(slack_steps > 0, "slack_steps", slack_steps, "must be greater than 0")
        # Through the decimal form, so that 0.1 means a tenth and no rounding ever blocks a step that is due. Below,
        # updates are counted in parts of which `_update_parts` make one and a step owes `_step_parts`, all ints.
        self._ratio = Fraction(str(updates_per_step))
        self._step_parts, self._update_parts = self._ratio.as_integer_ratio()
        self._min_steps = min_steps
        self._slack_updates = slack_updates
        self._slack_steps = slack_steps
        self._changed = threading.Condition()
        self._closed = False
        self._learning = False
        self._env_steps = self._updates = 0
        self._base_steps = self._base_updates = 0
        self._largest_insert = self._largest_update = 0
        self._waited_insert_s = self._waited_update_s = 0.0
        self._waiting_inserts = self._waiting_updates = 0

    @property
    def env_steps(self) -> int:
        """Environment steps granted so far."""
        with self._changed:
            return self._env_steps

    @property
    def updates(self) -> int:
        """Updates granted so far."""
        with self._changed:
            return self._updates

    @property
    def ratio(self) -> float:
        """Updates per environment step since learning began; the target while there is no step yet."""
        with self._changed:
            steps = self._env_steps - self._base_steps
            return (self._updates - self._base_updates) / steps if self._learning and steps > 0 else float(self._ratio)

    @property
    def waited_insert_s(self) -> float:
        """Time that workers have waited, summed, in seconds."""
        with self._changed:
            return self._waited_insert_s

    @property
    def waited_update_s(self) -> float:
        """Time that the learner has waited, in seconds."""
        with self._changed:
            return self._waited_update_s

    @property
    def waiting_inserts(self) -> int:
        """Threads waiting now to insert."""
        with self._changed:
            return self._waiting_inserts

    @property
    def waiting_updates(self) -> int:
        """Threads waiting now to update."""
        with self._changed:
            return self._waiting_updates

    def start_learning(self, env_steps: int) -> None:
        """Let updates begin; steps up to `env_steps` or `min_steps`, whichever is more, owe none.

        Called again it makes a fresh start from there, as after a loss of the stored steps: nothing is owed, and
        updates wait until so many environment steps have been counted.
        """
        check(env_steps >= 0, "env_steps", env_steps, "must be 0 or more")
        with self._changed:
            self._base_steps = max(env_steps, self._min_steps)
            self._base_updates = self._updates
            self._learning = True
            self._changed.notify_all()

    def updates_owed(self) -> int:
        """Updates that the steps counted so far ask for and that are still to come; sync mode makes just these."""
        with self._changed:
            return max(0, self._debt_parts() // self._update_parts) if self._learning else 0

    def may_insert(self, num_steps: int) -> bool:
        """Whether steps would be granted now; counts nothing."""
        with self._changed:
            self._check_sizes(num_steps=num_steps)
            return self._insert_fits(num_steps)

    def may_update(self, num_updates: int) -> bool:
        """Whether updates would be granted now; counts nothing."""
        with self._changed:
            self._check_sizes(num_updates=num_updates)
            return self._update_fits(num_updates)

    def try_insert(self, num_steps: int) -> bool:
        """Count steps if they fit now."""
        return self.await_insert(num_steps, timeout_s=0.0).granted

    def try_update(self, num_updates: int) -> bool:
        """Count updates if they fit now."""
        return self.await_update(num_updates, timeout_s=0.0).granted

    def await_insert(self, num_steps: int, timeout_s: float) -> Admission:
        """Wait until steps fit, then count them.

        Raises:
            ValueError: so many at once could block both sides for ever; names the slack to raise.
        """
        with self._changed:
            self._check_sizes(num_steps=num_steps)
            self._waiting_inserts += 1
            waited_s = self._wait(lambda: self._insert_fits(num_steps), timeout_s)
            self._waiting_inserts -= 1
            self._waited_insert_s += waited_s
            if self._closed or not self._insert_fits(num_steps):
                return Admission(granted=False, waited_s=waited_s, waiting_for=self._insert_waits_for(num_steps))
            self._env_steps += num_steps
            self._changed.notify_all()
            return Admission(granted=True, waited_s=waited_s, waiting_for="")

    def await_update(self, num_updates: int, timeout_s: float) -> Admission:
        """Wait until updates fit, then count them.

        Raises:
            ValueError: so many at once could block both sides for ever; names the slack to raise.
        """
        with self._changed:
            self._check_sizes(num_updates=num_updates)
            self._waiting_updates += 1
            waited_s = self._wait(lambda: self._update_fits(num_updates), timeout_s)
            self._waiting_updates -= 1
            self._waited_update_s += waited_s
            if self._closed or not self._update_fits(num_updates):
                return Admission(granted=False, waited_s=waited_s, waiting_for=self._update_waits_for(num_updates))
            self._updates += num_updates
            self._changed.notify_all()
            return Admission(granted=True, waited_s=waited_s, waiting_for="")

    def refund_insert(self, num_steps: int) -> None:
        """Take back granted steps that were not stored: a repeated block, or a worker lost in between."""
        with self._changed:
            check(0 < num_steps <= self._env_steps, "num_steps", num_steps, "must not exceed the steps granted")
            self._env_steps -= num_steps
            self._changed.notify_all()

    def refund_update(self, num_updates: int) -> None:
        """Take back granted updates that did not happen."""
        with self._changed:
            check(0 < num_updates <= self._updates, "num_updates", num_updates, "must not exceed the updates granted")
            self._updates -= num_updates
            self._changed.notify_all()

    def set_updates(self, num_updates: int) -> None:
        """Take over the learner's own count, which falls where updates are lost or turn out to have been skipped."""
        check(num_updates >= 0, "num_updates", num_updates, "must be 0 or more")
        with self._changed:
            self._updates = num_updates
            self._changed.notify_all()

    def close(self) -> None:
        """Send everyone who waits home, and grant nothing more."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def save(self) -> dict[str, Any]:
        """The counters."""
        with self._changed:
            return {
                "updates_per_step": str(self._ratio),
                "learning": self._learning,
                "env_steps": self._env_steps,
                "updates": self._updates,
                "base_steps": self._base_steps,
                "base_updates": self._base_updates,
                "waited_insert_s": self._waited_insert_s,
                "waited_update_s": self._waited_update_s,
            }

    def load(self, state: Mapping[str, Any]) -> None:
        """Take over saved counters; raises ``ValueError`` if they belong to another ratio."""
        missing = self.save().keys() - state.keys()
        check(not missing, "limiter", sorted(state), f"lacks {', '.join(sorted(missing))}")
        saved = state["updates_per_step"]
        check(saved == str(self._ratio), "updates_per_step", saved, f"this run has {self._ratio}; keep the saved ratio")
        with self._changed:
            self._learning = state["learning"]
            self._env_steps, self._updates = state["env_steps"], state["updates"]
            self._base_steps, self._base_updates = state["base_steps"], state["base_updates"]
            self._waited_insert_s, self._waited_update_s = state["waited_insert_s"], state["waited_update_s"]
            self._changed.notify_all()

    def _debt_parts(self) -> int:
        """Parts of updates owed; negative while the learner is ahead."""
        steps, updates = self._env_steps - self._base_steps, self._updates - self._base_updates
        return steps * self._step_parts - updates * self._update_parts

    def _insert_fits(self, num_steps: int) -> bool:
        return not self._learning or self._debt_parts() <= (self._slack_steps - num_steps) * self._step_parts

    def _update_fits(self, num_updates: int) -> bool:
        ready = self._learning and self._env_steps >= self._base_steps
        return ready and (num_updates - self._slack_updates) * self._update_parts <= self._debt_parts()

    def _wait(self, fits: Callable[[], bool], timeout_s: float) -> float:
        began_s = time.monotonic()
        self._changed.wait_for(lambda: self._closed or fits(), timeout_s)
        return time.monotonic() - began_s

    def _check_sizes(self, *, num_steps: int = 1, num_updates: int = 1) -> None:
        check(num_steps > 0, "num_steps", num_steps, "must be greater than 0")
        check(num_updates > 0, "num_updates", num_updates, "must be greater than 0")
        if not self._learning:  # nothing is held back yet, so nothing can wait for ever
            return
        insert, update = max(self._largest_insert, num_steps), max(self._largest_update, num_updates)
        # Both sides can wait at once only if one request of each is larger than the two slacks together.
        needed = math.ceil(insert + (update - self._slack_updates) / self._ratio)
        check(
            needed <= self._slack_steps,
            "slack_steps",
            self._slack_steps,
            f"must be at least {needed}, or inserts of {insert} steps and {update} updates at once could wait for each "
            "other for ever",
        )
        self._largest_insert, self._largest_update = insert, update

    def _insert_waits_for(self, num_steps: int) -> str:
        if self._closed:
            return "nothing: the limiter is closed"
        excess_parts = self._debt_parts() + (num_steps - self._slack_steps) * self._step_parts
        needed = -(-excess_parts // self._update_parts)
        steps, updates = self._env_steps - self._base_steps, self._updates - self._base_updates
        return (
            f"{needed} more updates; since learning began there were {steps} steps and {updates} updates, "
            f"the target is {float(self._ratio):g} updates per step"
        )

    def _update_waits_for(self, num_updates: int) -> str:
        if self._closed:
            return "nothing: the limiter is closed"
        if not self._learning:
            return f"learning to start; {self._env_steps} environment steps so far"
        missing_parts = (num_updates - self._slack_updates) * self._update_parts - self._debt_parts()
        missing_steps = max(-(-missing_parts // self._step_parts), self._base_steps - self._env_steps)
        return (
            f"{missing_steps} more environment steps; there were {self._env_steps} so far, "
            f"and learning begins at {self._base_steps}"
        )
