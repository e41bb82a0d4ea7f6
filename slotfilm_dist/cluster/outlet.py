"""Where a worker's blocks go: to replay through a `BlockSender`, or into a mailbox while the random policy collects."""

import queue
from typing import Protocol, runtime_checkable

from slotfilm_dist.messages import TransitionBlock


@runtime_checkable
class Outlet(Protocol):
    """Where a worker's blocks go."""

    finished: bool
    """No more blocks are wanted."""

    def offer(self, block: TransitionBlock, timeout_s: float) -> bool:
        """Take a block, or say False while there is no room."""
        ...

    def waiting_for(self) -> str:
        """What it waits for now."""
        ...

    def close(self) -> None:
        """Get rid of what was taken, and end."""
        ...


class Mailbox:
    """Keeps the random policy's blocks until they are fetched."""

    def __init__(self, num_blocks: int) -> None:
        self._queue: queue.Queue[TransitionBlock] = queue.Queue(num_blocks)
        self.finished = False

    def offer(self, block: TransitionBlock, timeout_s: float) -> bool:
        """Take a block, or say False while it is full."""
        try:
            self._queue.put(block, timeout=timeout_s)
        except queue.Full:
            return False
        return True

    def take(self, timeout_s: float) -> list[TransitionBlock]:
        """All blocks that are there, at least one unless time runs out."""
        blocks: list[TransitionBlock] = []
        try:
            blocks.append(self._queue.get(timeout=timeout_s))
            while True:
                blocks.append(self._queue.get_nowait())
        except queue.Empty:
            return blocks

    def waiting_for(self) -> str:
        """The driver fetches the blocks."""
        return "the driver to fetch the random policy's blocks"

    def close(self) -> None:
        """What was not fetched is dropped."""
        self.finished = True
