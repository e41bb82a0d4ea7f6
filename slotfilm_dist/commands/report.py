"""`slotfilm report`: writes the page of a run, or the report of a study beside what the paper printed."""

import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slotfilm_dist.commands.options import Parser

if TYPE_CHECKING:
    from slotfilm_dist.evaluation.study.collection import Grid, Trial


def main(arguments: Sequence[str]) -> int:
    """Write the report; gives the exit code."""
    options = _parser().parse_args(arguments)
    folder = Path(options.run)

    from slotfilm_dist.evaluation.study.collection import is_run

    if is_run(folder) or not folder.is_dir():
        if options.out:
            raise ValueError("--out: the page of a single run lies in its directory; leave --out away")
        from slotfilm_dist.evaluation.page import write_page

        path = write_page(folder)
        print(json.dumps({"page": str(path)}) if options.json else path)
        return 0

    from slotfilm_dist.evaluation.study.collection import collect_study
    from slotfilm_dist.evaluation.study.report import write_study

    study = collect_study(folder, list(_grids(folder)))
    report = write_study(study, Path(options.out) if options.out else folder / "report")
    items = report.summary["items"]
    num_shown = sum(item["shown"] for item in items)
    print(f"{num_shown} of the paper's {len(items)} figures and tables, {len(study.runs)} runs", file=sys.stderr)
    print(json.dumps({"page": str(report.page), **report.summary}) if options.json else report.page)
    return 0


def _parser() -> Parser:
    parser = Parser(
        prog="slotfilm report",
        description="Of a run, finished or not: write its report.html. Of a grid, or of a folder of runs and grids: "
        "every figure and table of the paper that the runs support, beside what the paper printed, as report.html, "
        "report.md, figures/*.png and tables/*.csv; what is missing is named with the command that would make it.",
    )
    parser.add_argument("run", help="directory of a run or of a grid, or a folder of runs and grids")
    parser.add_argument("--out", default="", metavar="DIR", help="folder of a study's report (default: report in it)")
    parser.add_argument("--json", action="store_true", help="print what was written as one JSON object")
    return parser


def _grids(folder: Path) -> "Iterator[Grid]":
    """The grids that a folder is or holds."""
    from slotfilm_dist.evaluation.study.collection import Grid, folders_of_runs

    for path in folders_of_runs(folder):
        trials, commands = _trials(path), _commands(path)
        if trials or commands:
            yield Grid(path=path, trials=tuple(trials), commands=tuple(commands))


def _trials(folder: Path) -> "list[Trial]":
    """Jobs of a grid's ledger; none for a folder of runs."""
    from slotfilm_dist.evaluation.study.collection import Trial
    from slotfilm_dist.tuning.ledger import LEDGER, directory_of

    trials = []
    for values in map(_object, sorted((folder / LEDGER).glob("*.json"))):
        if {"key", "kind", "variant", "seed", "state"} <= values.keys():
            trials.append(
                Trial(
                    path=directory_of(folder, values["key"], values["kind"]),
                    kind=values["kind"],
                    variant=values["variant"],
                    seed=values["seed"],
                    state=values["state"],
                    error=values.get("error", ""),
                )
            )
    return trials


def _commands(folder: Path) -> list[str]:
    """Commands that a grid was started with."""
    from slotfilm_dist.tuning.grid_file import GRID_FILE

    return [str(command) for command in _object(folder / GRID_FILE).get("commands", [])]


def _object(path: Path) -> dict[str, Any]:
    from slotfilm_dist.evaluation.study.measurements import read_object

    return read_object(path)
