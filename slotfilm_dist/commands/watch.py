"""`slotfilm watch`: the newest metrics of a run, live in a terminal."""

import json
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from slotfilm_dist.commands.options import Parser
from slotfilm_dist.metrics import AXES, find_metric
from slotfilm_dist.progress import duration

STALE_S = 60.0
"""Silence after which a run is called quiet."""


class MetricsFile:
    """Follows a run's `metrics.jsonl`: keeps the newest value of each metric.

    Args:
        path: the file; it may not be there yet.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0
        self.values: dict[str, Any] = {}

    def read(self) -> None:
        """Take in what was appended since the last call."""
        if not self._path.exists():
            return
        with self._path.open("rb") as file:
            file.seek(self._offset)
            for line in file:
                if not line.endswith(b"\n"):
                    break
                self._offset += len(line)
                self.values |= _parsed(line)

    def age_s(self) -> float:
        """Seconds since the run wrote last."""
        return time.time() - self._path.stat().st_mtime if self._path.exists() else float("inf")


def _parsed(line: bytes) -> dict[str, Any]:
    """What this version knows of a line: declared metrics that are numbers, and the phase."""
    try:
        values = json.loads(line)
    except (ValueError, RecursionError):
        return {}
    return {k: v for k, v in values.items() if _is_shown(k, v)} if isinstance(values, dict) else {}


def _is_shown(key: str, value: object) -> bool:
    if key == "phase":
        return isinstance(value, str)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return False
    try:
        return key in AXES or bool(find_metric(key))
    except ValueError:  # of another version
        return False


def main(arguments: Sequence[str]) -> int:
    """Show a run until Ctrl-C; gives the exit code."""
    parser = Parser(prog="slotfilm watch", description="The newest metrics of a run, live; Ctrl-C leaves.")
    parser.add_argument("run", help="directory of the run")
    parser.add_argument("--every", type=float, default=1.0, metavar="S", help="seconds between looks (default: 1)")
    parser.add_argument("--once", action="store_true", help="show the present values and leave")
    parser.add_argument("--json", action="store_true", help="print the present values as one JSON object and leave")
    options = parser.parse_args(arguments)
    if not 0.01 <= options.every <= 86_400:
        raise ValueError(f"--every {options.every:g}: must be 0.01 s or more, and a day at the most")
    run = Path(options.run)
    if not (run / "config.json").exists():
        raise ValueError(f"{run} is no directory of a run: it has no config.json")
    metrics = MetricsFile(run / "metrics.jsonl")
    metrics.read()
    if options.json:
        print(json.dumps(metrics.values))
        return 0
    console = Console()
    if options.once:
        console.print(_view(run, metrics))
        return 0
    with Live(_view(run, metrics), console=console, auto_refresh=False, screen=console.is_terminal) as live:
        while True:
            time.sleep(options.every)
            metrics.read()
            live.update(_view(run, metrics), refresh=True)


def _view(run: Path, metrics: MetricsFile) -> Group:
    values = metrics.values
    phase = values.get("phase", "starting")
    age = metrics.age_s()
    head = Text(f"{run.name}  {phase}", style="bold")
    head.append(
        f"  {int(values.get('env_steps', 0))} env steps, {int(values.get('updates', 0))} updates, "
        f"{duration(values.get('time_s', 0))}",
        style="not bold",
    )
    if age > STALE_S:
        head.append("  no news" + (f" for {duration(age)}" if age < float("inf") else " yet"), style="yellow")
    table = Table("metric", "value", "unit", box=None, pad_edge=False)
    role = ""
    for key in sorted(values):
        if key in AXES:
            continue
        metric, _ = find_metric(key)
        if metric.role != role:
            role = metric.role
            table.add_section()
        table.add_row(key, f"{values[key]:,.6g}", metric.unit)
    return Group(head, Text(""), table)
