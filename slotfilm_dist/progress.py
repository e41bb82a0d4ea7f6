"""Tells a person how a run is doing: one line that stays in place on a terminal, a line every few seconds elsewhere."""

import contextlib
import sys
import time
import typing
from collections.abc import Mapping
from typing import Any, Literal, TextIO

from rich.console import Console
from rich.live import Live
from rich.text import Text

Phase = Literal["collect", "pretrain", "train", "evaluate"]
PLAIN_EVERY_S = 10.0
"""Seconds between lines where the output is no terminal."""
SMOOTHING_S = 20.0
"""Time over which the speed is averaged for the time left."""


def duration(seconds: float) -> str:
    """Hours, minutes and seconds as a person writes them."""
    whole = round(seconds)
    hours, minutes = divmod(whole // 60, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {whole % 60:02d} s" if minutes else f"{whole} s"


class SteadyStderr:
    """Standard error for a console whose loss must end nothing: a full disk, a closed terminal, a reader that died."""

    def __init__(self) -> None:
        self._file = getattr(sys.stderr, "rich_proxied_file", sys.stderr)

    def write(self, text: str) -> int:
        """Write what can be written."""
        with contextlib.suppress(OSError):
            self._file.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush if that is possible."""
        with contextlib.suppress(OSError):
            self._file.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def steady_console(**options: Any) -> Console:
    """A console on standard error that raises nothing."""
    return Console(file=typing.cast(TextIO, SteadyStderr()), highlight=False, **options)


class Progress:
    """Shows phase, share done, speed, and what matters of the metrics.

    Args:
        console: where to write; standard error by default, so that `--json` output stays clean.
    """

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or steady_console()
        self._live: Live | None = None
        self._phase = ""
        self._started = self._printed = 0.0
        self._marks: list[tuple[float, float]] = []

    def say(self, text: str) -> None:
        """A sentence that stays."""
        self._console.print(text, soft_wrap=True, markup=False)

    def begin(self, phase: Phase, text: str) -> None:
        """Start of a phase."""
        self.end()
        self._phase = phase
        self._started = self._printed = time.monotonic()
        self._marks = []
        self.say(f"{phase:>8}  {text}")
        if self._console.is_terminal:
            self._live = Live(Text(""), console=self._console, refresh_per_second=4, transient=True)
            self._live.start()

    def show(self, done: float, total: float, values: Mapping[str, str]) -> None:
        """How far the phase is, with a few values to show."""
        now = time.monotonic()
        self._marks.append((now, done))
        self._marks = [mark for mark in self._marks if now - mark[0] <= SMOOTHING_S] or self._marks[-1:]
        line = self._line(done, total, values)
        if self._live is not None:
            self._live.update(Text(line, no_wrap=True, overflow="ellipsis"))
        elif now - self._printed >= PLAIN_EVERY_S:
            self._printed = now
            self.say(line)

    def end(self, text: str = "") -> None:
        """End of the phase."""
        if self._live is not None:
            self._live.stop()
            self._live = None
        if text:
            self.say(f"{self._phase:>8}  {text} ({duration(time.monotonic() - self._started)})")

    def _line(self, done: float, total: float, values: Mapping[str, str]) -> str:
        share = min(done / total, 1.0) if total else 1.0
        filled = round(share * 20)
        parts = [f"{self._phase:>8}  {'#' * filled}{'.' * (20 - filled)} {share:4.0%}"]
        parts += [f"{name} {value}" for name, value in values.items()]
        first, last = self._marks[0], self._marks[-1]
        if last[1] > first[1] and total > done:
            left = (total - done) * (last[0] - first[0]) / (last[1] - first[1])
            parts.append(f"{duration(left)} left")
        return "  ".join(parts)
