"""`slotfilm export`: a run's policy as files that need neither the simulator nor Ray."""

import dataclasses
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path

from slotfilm_dist.commands.options import Parser

FORMATS = {"torch": ("torch",), "onnx": ("onnx",), "both": ("torch", "onnx")}


def main(arguments: Sequence[str]) -> int:
    """Export; gives the exit code."""
    parser = Parser(
        prog="slotfilm export",
        description="Write a run's policy with its normalisation and config; load it with slotfilm_dist.deploy.loader.",
    )
    parser.add_argument("run", help="directory of the run")
    parser.add_argument("--out", metavar="DIR", help="where to write (default: RUN/export)")
    parser.add_argument(
        "--format", choices=tuple(FORMATS), default="both", help="torch.export, ONNX or both (default: %(default)s)"
    )
    parser.add_argument(
        "--checkpoint", choices=("last", "best"), default="last", help="which one acts (default: %(default)s)"
    )
    parser.add_argument(
        "--tolerance",
        type=float,
        default=1e-5,
        metavar="X",
        help="largest difference from the agent's action that is accepted (default: %(default)g)",
    )
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
    options = parser.parse_args(arguments)
    if not 0 <= options.tolerance < math.inf:
        raise ValueError(f"--tolerance {options.tolerance:g}: must be 0 or more and finite")
    run = Path(options.run)
    if not (run / "config.json").exists():
        raise ValueError(f"{run} is no run directory: it has no config.json")
    out = Path(options.out) if options.out else run / "export"

    import torch

    from slotfilm_dist.deploy.export import export_policy

    torch.set_num_threads(1)
    files = export_policy(
        run, out, formats=FORMATS[options.format], checkpoint=options.checkpoint, tolerance=options.tolerance
    )
    if options.json:
        json.dump(
            {"out": str(out), "files": {name: dataclasses.asdict(file) for name, file in files.items()}}, sys.stdout
        )
        print()
        return 0
    print(f"policy of {run}: {out}")
    for name, file in files.items():
        print(
            f"  {name:<6} {file.num_bytes / 1e6:5.1f} MB   {file.latency_ms_mean:.2f} ms an action on one core "
            f"(99 % within {file.latency_ms_p99:.2f})   differs by at most {file.max_difference:.1e}"
        )
    return 0
