"""Faults that must happen inside another process are switched on and off through files in a folder."""

import os
from pathlib import Path

TAKEN = "@"
"""Between a fault's name and the process that has it."""


class Switches:
    """A folder in which a file is a fault: its name says which, its content how much of it.

    Whoever finds one first renames it, which only one can; so a fault meant for one worker meets one worker.

    Args:
        folder: seen by both sides.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def arm(self, name: str, amount: float = 1.0, count: int = 1) -> None:
        """Let a fault happen `count` times, or until `disarm` if it is one that lasts."""
        for number in range(count):
            path = self._folder / f"{name}.{number}"
            path.with_name("." + path.name).write_text(repr(float(amount)))
            path.with_name("." + path.name).rename(path)

    def disarm(self, name: str) -> None:
        """End a fault, wherever it is."""
        for path in self._folder.glob(f"{name}.*"):
            path.unlink(missing_ok=True)

    def taken(self, name: str) -> bool:
        """Whether somebody has met every fault of that name that was armed."""
        return not any(TAKEN not in path.name for path in self._folder.glob(f"{name}.*"))

    def take(self, name: str) -> float | None:
        """The amount of a fault that happens now and once, None if none is armed."""
        for entry in self._entries():
            if entry.startswith(name + ".") and TAKEN not in entry:
                amount = self._claim(entry, keep=False)
                if amount is not None:  # else another thread was faster: the next one is still to be had
                    return amount
        return None

    def lasting(self, name: str) -> float | None:
        """The amount of a fault that lasts, None if none is armed or another process has it."""
        own = f"{TAKEN}{os.getpid()}"
        for entry in self._entries():
            if entry.startswith(name + "."):
                if entry.endswith(own):
                    return float((self._folder / entry).read_text())
                if TAKEN not in entry:
                    return self._claim(entry, keep=True)
        return None

    def _entries(self) -> list[str]:
        return sorted(entry for entry in os.listdir(self._folder) if not entry.startswith("."))

    def _claim(self, entry: str, *, keep: bool) -> float | None:
        mine = self._folder / f"{entry}{TAKEN}{os.getpid()}"
        try:
            (self._folder / entry).rename(mine)
        except FileNotFoundError:  # another process was faster, or it was disarmed
            return None
        amount = float(mine.read_text())
        if not keep:
            mine.unlink(missing_ok=True)
        return amount
