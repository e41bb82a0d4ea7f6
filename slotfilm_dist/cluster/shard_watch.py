"""Counts the restarts of replay shards, which Ray starts again by itself. Plain, without Ray."""

import time
from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

from slotfilm_dist.backend import RunFailedError
from slotfilm_dist.cluster.messages import ShardBeat

SHARD_GONE_S = 900.0
"""Longest time that a shard may not answer: Ray starts it again, and it reads what it had stored."""


@runtime_checkable
class ShardHandle(Protocol):
    """A shard as its watch needs it."""

    index: int

    def poll(self) -> ShardBeat | None:
        """Its last beat; never waits; None while it does not answer."""
        ...

    def look(self) -> ShardBeat | None:
        """A beat of now; waits for it; None if it does not answer."""
        ...


class ShardWatch:
    """Counts the shards' restarts, and gives up where one does not come back.

    Args:
        shards: Ray replaces their processes by itself.
        clock: seconds that only grow.
    """

    def __init__(self, shards: Sequence[ShardHandle], clock: Callable[[], float] = time.monotonic) -> None:
        self._shards, self._clock = shards, clock
        self._starts: dict[int, str] = {}
        self._gone_since: dict[int, float] = {}
        self.beats: dict[int, ShardBeat] = {}
        self.num_restarts = 0

    def tick(self, *, wait: bool = False) -> None:
        """Look at every shard once; with `wait` at what it is now, otherwise at what it last said.

        Raises:
            RunFailedError: a shard has not answered for `SHARD_GONE_S`.
        """
        for shard in self._shards:
            beat = shard.look() if wait else shard.poll()
            if beat is None:
                self.beats.pop(shard.index, None)
                gone_s = self._clock() - self._gone_since.setdefault(shard.index, self._clock())
                if gone_s > SHARD_GONE_S:
                    raise RunFailedError(
                        f"replay shard {shard.index} has not answered for {gone_s / 60:.0f} minutes: look for its "
                        "error in Ray's logs, and whether its snapshot can be read; then go on with --resume"
                    )
                continue
            self._gone_since.pop(shard.index, None)
            self.num_restarts += self._starts.get(shard.index, beat.starts) != beat.starts
            self._starts[shard.index] = beat.starts
            self.beats[shard.index] = beat
