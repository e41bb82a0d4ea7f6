"""Shows a person how a grid is doing: a table that stays in place on a terminal, a line every few seconds elsewhere."""

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from slotfilm_dist.progress import PLAIN_EVERY_S, duration, steady_console
from slotfilm_dist.tuning.jobs import Job
from slotfilm_dist.tuning.ledger import JobState, Record

REFRESH_S = 0.5
"""Seconds between two drawings of the table."""
OTHER_LINES = 6
"""Lines of the terminal that the table leaves free."""
STYLES: dict[JobState, str] = {"running": "bold", "failed": "red", "done": "green", "pruned": "dim", "waiting": "dim"}
ORDER: tuple[JobState, ...] = ("running", "failed", "stopped", "done", "pruned", "waiting")
"""From top to bottom: what a person wants to see first."""


@dataclass(kw_only=True, slots=True)
class Row:
    """One job as it is shown."""

    job: Job
    state: JobState
    num_starts: int = 0
    since: float = 0.0
    worked_s: float = 0.0
    error: str = ""
    standing: dict[str, Any] = field(default_factory=dict)
    result: dict[str, Any] = field(default_factory=dict)


class Board:
    """All jobs of a grid as the driver knows them.

    Args:
        records: one for each job, as the ledger has them.
        console: where to write; standard error by default, so that `--json` output stays clean.
    """

    def __init__(self, records: Sequence[tuple[Job, Record]], console: Console | None = None) -> None:
        self._console = console or steady_console()
        self._live: Live | None = None
        self._drawn_at = self._said_at = time.monotonic()
        self.rows: dict[str, Row] = {}
        for job, record in records:
            state = "waiting" if record.state == "running" else record.state
            self.rows[job.key] = Row(
                job=job, state=state, worked_s=record.worked_s, error=record.error, result=record.result
            )

    def __enter__(self) -> "Board":
        if self._console.is_terminal:
            self._live = Live(self.table(), console=self._console, auto_refresh=False, transient=True)
            self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._live is not None:
            self._live.stop()
            self._live = None

    @property
    def counts(self) -> Counter[str]:
        """Jobs by state."""
        return Counter(row.state for row in self.rows.values())

    def note(self, key: str, state: JobState, *, error: str = "", standing: dict[str, Any] | None = None) -> None:
        """A job's state, and what is known of it."""
        row = self.rows[key]
        if state == "running" and row.state != "running":
            row.since, row.standing, row.num_starts = time.monotonic(), {}, row.num_starts + 1
        if row.state == "running" and state != "running":
            row.worked_s += time.monotonic() - row.since
        row.state = state
        row.error = error or row.error
        row.standing = standing or row.standing

    def say(self, text: str) -> None:
        """A sentence that stays."""
        self._console.print(text, soft_wrap=True, markup=False)

    def refresh(self) -> None:
        """Show the present state, if it is time."""
        now = time.monotonic()
        if self._live is not None:
            if now - self._drawn_at >= REFRESH_S:
                self._drawn_at = now
                self._live.update(self.table(), refresh=True)
        elif now - self._said_at >= PLAIN_EVERY_S:
            self._said_at = now
            self.say(self.line())

    def line(self) -> str:
        """The grid in one line."""
        counts = self.counts
        head = ", ".join(
            f"{counts[state]} {state}" for state in ("done", *ORDER[:3], "pruned", "waiting") if counts[state]
        )
        running = [f"{row.job.key} {_progress(row)}" for row in self.rows.values() if row.state == "running"]
        return "  ".join([f"    grid  {head}", *(f"| {text}" for text in running[:4])])

    def table(self) -> Table:
        """The grid in a table no higher than the terminal."""
        table = Table("job", "state", "progress", "steps/s", "return", "time", "", box=None, pad_edge=False)
        rows = sorted(self.rows.values(), key=lambda row: ORDER.index(row.state))
        room = max(4, self._console.height - OTHER_LINES)
        for row in rows[:room]:
            table.add_row(*_cells(row), style=STYLES.get(row.state))
        if len(rows) > room:
            hidden = Counter(row.state for row in rows[room:])
            table.add_row(Text("and " + ", ".join(f"{n} {state}" for state, n in hidden.items()), style="dim"))
        return table


def _cells(row: Row) -> list[str]:
    standing = row.standing if row.state == "running" else {}
    value = standing.get("episode_return", row.result.get("mean_return"))
    worked = row.worked_s + (time.monotonic() - row.since if row.state == "running" else 0.0)
    note = row.error if row.state in ("failed", "running") else ""
    return [
        row.job.key,
        row.state + (f" ({row.num_starts})" if row.num_starts > 1 else ""),
        _progress(row),
        f"{standing['steps_per_s']:.0f}" if "steps_per_s" in standing else "",
        f"{value:.1f}" if value is not None else "",
        duration(worked) if worked >= 1 else "",
        escape(note[:60]),
    ]


def _progress(row: Row) -> str:
    if row.state != "running":
        return ""
    phase, share = row.standing.get("phase", "start"), row.standing.get("share", 0.0)
    return str(row.standing.get("note", "starting"))[:40] if phase == "start" else f"{phase} {share:.0%}"
