"""`slotfilm report`: writes the page of a run."""

from collections.abc import Sequence
from pathlib import Path

from slotfilm_dist.commands.options import Parser


def main(arguments: Sequence[str]) -> int:
    """Write the page; gives the exit code."""
    parser = Parser(prog="slotfilm report", description="Write report.html of a run, finished or not.")
    parser.add_argument("run", help="directory of the run")
    options = parser.parse_args(arguments)

    from slotfilm_dist.evaluation.page import write_page

    print(write_page(Path(options.run)))
    return 0
