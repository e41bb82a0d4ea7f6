"""`slotfilm train`: a run from nothing to its report, or on from where it stopped."""

import argparse
import contextlib
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from slotfilm_dist.commands.options import (
    Parser,
    add_config_options,
    build_config,
    change_fields,
    parse_with_fields,
    with_weights_file,
)
from slotfilm_dist.commands.scale import AUTO, workers_wanted
from slotfilm_dist.config import RunConfig
from slotfilm_dist.config_files import load_config

if TYPE_CHECKING:
    from slotfilm_dist.backend import Backend

DEFAULT_PRESET = "quick"


def main(arguments: Sequence[str]) -> int:
    """Train; gives the exit code."""
    parser = Parser(prog="slotfilm train", description="Collect, pre-train, train, evaluate; then write a report.")
    add_config_options(parser, DEFAULT_PRESET)
    parser.set_defaults(preset="")
    parser.add_argument(
        "--workers",
        type=workers_wanted,
        metavar="N|auto",
        help="environment workers on Ray; auto adds and removes them as the learner needs them",
    )
    parser.add_argument("--resume", metavar="DIR", help="go on with the run in this directory")
    parser.add_argument("--runs", metavar="DIR", help="where run directories go (default: runs)")
    parser.add_argument("--name", default="", help="name of the run directory (default: preset, variant, seed, number)")
    parser.add_argument(
        "--artifacts",
        default="artifacts",
        metavar="DIR",
        help="data and encoders that runs share (default: %(default)s)",
    )
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
    options, fields = parse_with_fields(parser, arguments)
    if options.workers is not None:
        fields += workers_fields(options.workers)

    from slotfilm_dist.runs import new_run_directory

    if options.resume is not None and not options.fields:
        _refuse_beside_resume(options)
        path = Path(options.resume)
        config = _resumed_config(path, fields)
        with_weights_file(config)  # only looks: what names the run's checkpoints stays
    else:
        preset = options.preset or DEFAULT_PRESET
        config = with_weights_file(build_config(preset, options.variant, fields, show_fields=options.fields))
        path = new_run_directory(Path(options.runs or "runs"), config, preset, options.name)
    if config.runtime.mode == "local" and options.workers is not None:
        raise ValueError("--workers: one process has no workers; leave it away, or take --runtime.mode ray")
    if config.runtime.mode == "ray" and config.runtime.exact_resume:
        raise ValueError("runtime.exact_resume = True: holds in one process alone; add --runtime.mode local")
    return _execute(path, config, Path(options.artifacts), as_json=options.json)


def _refuse_beside_resume(options: argparse.Namespace) -> None:
    if not options.resume:
        raise ValueError("--resume: the directory of the run is missing; was it an empty variable?")
    given = {"--variant": options.variant, "--name": options.name, "--runs": options.runs, "a preset": options.preset}
    beside = [name for name, value in given.items() if value]
    if beside:
        raise ValueError(f"--resume {options.resume}: leave {' and '.join(beside)} away; the run has its own")


def workers_fields(workers: int) -> list[str]:
    """What `--workers` means in the config; a number also ends an earlier `auto`."""
    if workers == AUTO:
        return ["--runtime.auto_workers"]
    return ["--runtime.num_workers", str(workers), "--runtime.no_auto_workers"]


def _resumed_config(path: Path, fields: Sequence[str]) -> RunConfig:
    from slotfilm_dist.runs import resumed_config

    config = load_config(path / "config.json")
    return resumed_config(path, config, change_fields(config, fields)) if fields else config


def _execute(path: Path, config: RunConfig, artifacts: Path, *, as_json: bool) -> int:
    from slotfilm_dist.driver import drive

    with contextlib.redirect_stdout(sys.stderr):  # Ray's messages keep out of --json
        code = drive(path, config, artifacts, _backend)
    if code == 0 and as_json:
        json.dump({"run": str(path), "report": str(path / "report.html"), **_result(path)}, sys.stdout)
        print()
    return code


def _backend(path: Path, config: RunConfig) -> "Backend":
    """Where the roles live; each is imported only where it is used."""
    if config.runtime.mode == "ray":
        from slotfilm_dist.cluster.backend import RayBackend

        return RayBackend(config, path)
    from slotfilm_dist.local import LocalBackend

    return LocalBackend(config)


def _result(path: Path) -> dict[str, object]:
    values = json.loads((path / "evaluation" / "final.json").read_text(encoding="utf-8"))
    return {name: values[name] for name in ("mean_return", "success_rate", "success_interval")}
