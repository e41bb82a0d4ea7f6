"""`slotfilm doctor`: what this machine can do."""

from collections.abc import Sequence

from slotfilm_dist.commands.options import Parser


def main(arguments: Sequence[str]) -> int:
    """Check the machine; exit code 0 when the main job can run."""
    parser = Parser(prog="slotfilm doctor", description="What this machine can do, and a fix for each lack.")
    parser.add_argument("--json", action="store_true", help="print the checks as one JSON object")
    options = parser.parse_args(arguments)

    from slotfilm_dist.doctor import run_doctor

    return run_doctor(json=options.json)
