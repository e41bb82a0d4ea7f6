"""How a signal ends a run: the first asks it to stop where everything can be written, the second ends the process."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Interrupted(Exception):
    """A signal asked the run to stop; everything needed to go on has been written."""

    def __init__(self, number: int) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}")
        self.exit_code = 128 + number


class StopFlag:
    """Remembers the first SIGINT or SIGTERM; a second one ends the process at once."""

    def __init__(self) -> None:
        self.signal_number = 0

    def __call__(self) -> bool:
        """Whether to stop."""
        return self.signal_number != 0

    def check(self) -> None:
        """Raise `Interrupted` if a signal has come."""
        if self.signal_number:
            raise Interrupted(self.signal_number)

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Listen while the body runs."""

        def remember(number: int, frame: FrameType | None) -> None:
            if self.signal_number:
                raise KeyboardInterrupt
            self.signal_number = number

        before = {number: signal.signal(number, remember) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
