"""A lock that a busy loop cannot keep for itself."""

import threading
from types import TracebackType


class FairLock:
    """Goes to a thread that waits before the one that has just released it takes it again.

    A plain lock does not: a loop that releases it and asks for it at once mostly wins, and others wait for many rounds.
    """

    def __init__(self) -> None:
        self._turn = threading.Lock()
        """Held by who is next, from the moment it asks until it has the lock."""
        self._held = threading.Lock()

    def __enter__(self) -> None:
        with self._turn:
            self._held.acquire()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._held.release()
