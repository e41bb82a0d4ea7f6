"""`slotfilm bench`: ratios against what a user would pick instead."""

import json
import sys
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from slotfilm_dist.bench.results import BenchOptions, BenchResult, as_json, worst_first
from slotfilm_dist.bench.suite import SUBJECTS, run_subjects
from slotfilm_dist.commands.options import Parser


def main(arguments: Sequence[str]) -> int:
    """Measure; gives the exit code 0 whatever the numbers are."""
    parser = Parser(
        prog="slotfilm bench",
        description="Speed as ratios within one run: contenders take turns, then medians of the rounds' ratios.",
        epilog="Subjects: " + "; ".join(f"{name} ({text})" for name, text in SUBJECTS.items()) + ". Peers' software "
        "comes from an environment of its own: `make bench-peers` installs it.",
    )
    parser.add_argument("what", nargs="*", metavar="WHAT", help=f"{', '.join(SUBJECTS)} (default: all)")
    parser.add_argument("--rounds", type=int, default=5, help="interleaved rounds (default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help="a tenth of the work, to see that everything runs")
    parser.add_argument("--json", action="store_true", help="print one JSON object with `results`")
    options = parser.parse_args(arguments)
    results: list[BenchResult] = []
    for name, rows in run_subjects(options.what, BenchOptions(rounds=options.rounds, quick=options.quick)):
        print(f"slotfilm bench: {name}: {len(rows)} rows", file=sys.stderr)
        results += rows
    if options.json:
        print(json.dumps(as_json(results)))
    else:
        Console().print(_table(worst_first(results)))
    return 0


def _table(results: Sequence[BenchResult]) -> Table:
    table = Table("what", "measured", "goal", "holds", "how")
    for row in results:
        measured = "-" if row.measured is None else f"{row.measured:.3g} {row.unit}"
        goal = "-" if row.goal is None else f"{row.goal:g}"
        table.add_row(row.name, measured, goal, {True: "yes", False: "NO", None: "-"}[row.holds], row.how)
    return table
