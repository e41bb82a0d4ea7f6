"""`slotfilm chaos`: damages a real run on purpose and says what followed."""

import contextlib
import math
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

from slotfilm_dist.commands.options import Parser


def main(arguments: Sequence[str]) -> int:
    """Carry out a plan; gives the exit code: 1 if anything was not as expected."""
    from slotfilm_dist.chaos.plan import KINDS, PLANS, FaultPlan

    parser = Parser(
        prog="slotfilm chaos",
        description="Train, break things on purpose, and print what was expected and what was observed.",
        epilog="Faults: " + ", ".join(KINDS) + ".",
    )
    parser.add_argument("faults", nargs="*", metavar="FAULT", help="these faults instead of a plan")
    parser.add_argument("--plan", choices=tuple(PLANS), default="short", help="which faults (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of order, times and targets (default: %(default)s)")
    parser.add_argument(
        "--minutes", type=float, default=0.0, help="go through the plan again and again for so long (default: once)"
    )
    parser.add_argument("--soak", type=float, default=0.0, metavar="MINUTES", help="a kill every 30 s, for so long")
    parser.add_argument("--simulator", action="store_true", help="the live run in the simulator instead of the toy")
    parser.add_argument("--json", action="store_true", help="print the table as one JSON object")
    parser.add_argument("--markdown", action="store_true", help="print the table for a page")
    parser.add_argument("--keep", metavar="DIR", help="write the runs there and leave them (default: deleted)")
    options = parser.parse_args(arguments)
    if not (0 <= options.minutes < math.inf and 0 <= options.soak < math.inf):
        raise ValueError("--minutes and --soak must be numbers of 0 or more")
    if options.keep and Path(options.keep).exists():
        raise ValueError(f"--keep {options.keep}: is there already; give the name of a new folder")
    plan = FaultPlan.draw(options.faults or PLANS[options.plan], options.seed)

    from slotfilm_dist.chaos.outcome import Outcome, as_json, as_line, as_markdown, as_text
    from slotfilm_dist.chaos.runner import carry_out
    from slotfilm_dist.chaos.soak import soak

    signal.signal(signal.SIGTERM, _leave)
    environment, outcomes = "simulator" if options.simulator else "toy", list[Outcome]()
    # Ray tells of dead processes on standard output, which is the table's.
    with tempfile.TemporaryDirectory(prefix="chaos-") as scratch, contextlib.redirect_stdout(sys.stderr):
        folder = Path(options.keep or scratch)
        if options.soak:
            outcomes.append(soak(folder, options.soak, options.seed, environment))
        else:
            until_s = time.monotonic() + 60 * options.minutes if options.minutes else float("inf")
            rounds = 0
            while rounds == 0 or (options.minutes and time.monotonic() < until_s):
                drawn = FaultPlan.draw([f.kind.name for f in plan.faults], options.seed + rounds)
                for outcome in carry_out(drawn, folder / f"round-{rounds}", environment, until_s):
                    outcomes.append(outcome)
                    print(as_line(outcome), file=sys.stderr, flush=True)
                rounds += 1
    shape = as_markdown if options.markdown else as_text
    print(as_json(outcomes, options.seed) if options.json else shape(outcomes))
    return 0 if all(outcome.holds for outcome in outcomes) else 1


def _leave(number: int, frame: FrameType | None) -> None:
    """End by way of every `finally`: what was mounted and started here must not stay."""
    sys.exit(128 + number)
