"""Which workers stand still because their machine is short of memory. Plain, without Ray."""

import math
import time
from collections.abc import Callable, Mapping

PATIENCE_S = 1.0
"""How long a machine is short of memory before a worker is stopped: all its workers have said so then, and what one
that was stopped before had is given back."""
FIRST_HOLD_S = 60.0
"""How long a worker stands still at least; twice as long if its machine is short of memory again soon after."""
LONGEST_HOLD_S = 1800.0


class MemoryGuard:
    """Stops the newest worker of a machine that is short of memory, and one more until it no longer is.

    The others go on, and so does the last worker of a run. Otherwise Ray or the system would end processes of their
    own choice, among them what a run cannot lose.

    Args:
        max_share: of a machine's memory in use; 1 stops nobody.
        clock: seconds that only grow.
    """

    def __init__(self, max_share: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._max_share, self._clock = max_share, clock
        self._held_until: dict[int, float] = {}
        self._hold_s: dict[int, float] = {}
        self._short_since = math.inf

    def is_short(self, memory_share: float) -> bool:
        """A machine of which that share is in use has no room for its workers."""
        return memory_share > self._max_share

    def may_run(self, worker_id: int, shares: Mapping[int, float]) -> bool:
        """Its time of standing still is over, if there was one, and some machine has room.

        Args:
            worker_id: of the worker.
            shares: of the memory of each worker's machine that are in use, by worker.
        """
        if worker_id not in self._held_until:
            return True
        room = not shares or not self.is_short(min(shares.values()))
        return room and self._clock() >= self._held_until[worker_id]

    def pick(self, shares: Mapping[int, float]) -> int | None:
        """The worker to stop now, if there is one; `hold` it, then stop it, then tell it to `look_again`."""
        short = [worker_id for worker_id, share in shares.items() if self.is_short(share)]
        self._short_since = min(self._short_since, self._clock()) if short else math.inf
        if self._clock() - self._short_since < PATIENCE_S or len(shares) < 2:
            return None
        return max(short)

    def hold(self, worker_id: int) -> float:
        """Let a worker stand still, longer each time unless it has run for as long in between; gives the seconds."""
        now, before_s = self._clock(), self._hold_s.get(worker_id, 0.0)
        again = now - self._held_until.get(worker_id, -math.inf) < before_s
        hold_s = min(LONGEST_HOLD_S, 2 * before_s) if again else FIRST_HOLD_S
        self._hold_s[worker_id], self._held_until[worker_id] = hold_s, now + hold_s
        return hold_s

    def look_again(self) -> None:
        """What workers said while one was stopped does not count."""
        self._short_since = math.inf
