"""`slotfilm variants` and `slotfilm cost`: what there is, and what it takes."""

import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from slotfilm_dist.commands.options import Parser
from slotfilm_dist.presets import PRESETS
from slotfilm_dist.variants import VARIANTS, apply_variant, describe_variant


def variants(arguments: Sequence[str]) -> int:
    """List the agents, or the tasks, or the presets."""
    parser = Parser(
        prog="slotfilm variants", description="Agents of the study and how each differs from the proposed one."
    )
    parser.add_argument("--tasks", action="store_true", help="list the tasks instead")
    parser.add_argument("--presets", action="store_true", help="list the presets instead")
    parser.add_argument("--json", action="store_true", help="print a list of JSON objects")
    options = parser.parse_args(arguments)
    if options.tasks:
        from slotfilm_dist.envs.tasks import TASKS

        rows = [dataclasses.asdict(task) for task in TASKS.values()]
        head = ["env_id", "objects", "goal", "max_steps"]
    elif options.presets:
        rows = [{"name": name, "what": (make.__doc__ or "").strip()} for name, make in PRESETS.items()]
        head = ["name", "what"]
    else:
        rows = [describe_variant(name) for name in VARIANTS]
        head = ["name", "section", "difference"]
    _print(rows, head, as_json=options.json)
    return 0


def cost(arguments: Sequence[str]) -> int:
    """Parameters, latency and memory of every variant (Table A3), and the machine (Table A2)."""
    parser = Parser(
        prog="slotfilm cost", description="Parameters, batch-1 latency and memory of the variants (Tables A2 and A3)."
    )
    parser.add_argument("--only", nargs="*", default=list(VARIANTS), help="variants to measure (default: all)")
    parser.add_argument(
        "--device", choices=("auto", "cpu", "cuda"), default="auto", help="where (default: %(default)s)"
    )
    parser.add_argument("--out", metavar="DIR", help="also write cost.csv, cost.json and machine.json there")
    parser.add_argument("--json", action="store_true", help="print a list of JSON objects")
    options = parser.parse_args(arguments)
    names = [name for word in options.only for name in word.split(",") if name]
    if not names:
        raise ValueError("--only: name at least one variant")
    if options.out and Path(options.out).exists() and not Path(options.out).is_dir():
        raise ValueError(f"--out {options.out}: is a file, not a folder")
    configs = [apply_variant(name, PRESETS["paper"]()) for name in names]

    from slotfilm_dist.evaluation.cost import costs_of
    from slotfilm_dist.local import learner_device

    placed = [
        dataclasses.replace(
            config,
            encoder=dataclasses.replace(config.encoder, backbone="random"),
            runtime=dataclasses.replace(config.runtime, device=options.device),
        )
        for config in configs
    ]
    device = learner_device(placed[0], "--device")
    rows = []
    for row in costs_of(placed, device):
        print(f"{row.variant}: {row.latency_ms_mean:.2f} ms on {row.device}", file=sys.stderr)
        rows.append(dataclasses.asdict(row))
    if options.out:
        _write_costs(Path(options.out), rows)
    _print(rows, list(rows[0]), as_json=options.json)
    return 0


def _write_costs(folder: Path, rows: list[dict]) -> None:
    """The table, and the machine that it was measured on."""
    import torch

    from slotfilm_dist.evaluation.result_files import write_csv, write_json
    from slotfilm_dist.runs import describe_machine

    write_csv(folder / "cost.csv", rows)
    write_json(folder / "cost.json", rows)
    write_json(folder / "machine.json", describe_machine() | {"cuda": torch.version.cuda or "none"})


def _print(rows: list[dict], head: list[str], *, as_json: bool) -> None:
    if as_json:
        json.dump(rows, sys.stdout)
        print()
        return
    table = Table(*head)
    for row in rows:
        table.add_row(*(_cell(row[name]) for name in head))
    Console().print(table)


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.3g}"
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
