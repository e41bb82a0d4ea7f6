"""`slotfilm grid`: every variant and seed of the study on Ray Tune; the same command goes on where it stopped."""

import contextlib
import json
import os
import shlex
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from slotfilm_dist.commands.options import FIELDS_NOTE, Parser, build_config, parse_with_fields, with_weights_file
from slotfilm_dist.config import CheckpointConfig, RunConfig, RuntimeConfig
from slotfilm_dist.config_files import changed_fields, config_hash
from slotfilm_dist.presets import PRESETS, preset_named

if TYPE_CHECKING:
    import argparse

    from slotfilm_dist.tuning.jobs import Job
    from slotfilm_dist.tuning.ledger import Ledger
    from slotfilm_dist.tuning.resources import Nodes, TrialResources

JOB_FILES = "/runtime_resources/working_dir_files/"
"""Part of the path of a Ray job's copy of the submitted directory."""
SHOWN = ("key", "variant", "seed", "state", "num_starts", "worked_s", "error", "result")
"""Fields of a record in the outcome."""


def main(arguments: Sequence[str]) -> int:
    """Run a grid; gives the exit code: 1 if a trial failed for good, 128 + n after signal n."""
    options, fields = parse_with_fields(_parser(), arguments)
    if any(word.split("=")[0] == "--variant" for word in fields):
        raise ValueError("--variant: a grid trains many; `--only A,B` takes some of them")
    if any(not name.strip() for names in (*options.only, *options.exclude) for name in names.split(",")):
        raise ValueError("--only and --exclude: a name is missing; was it an empty variable?")
    if options.retries < 0:
        raise ValueError(f"--retries {options.retries}: must be 0 or more")
    if options.max_concurrent < 0:
        raise ValueError(f"--max-concurrent {options.max_concurrent}: must be 0 or more; 0 is as many as fit")
    base = with_weights_file(build_config(options.preset, "slotfilm", fields, show_fields=options.fields))

    from slotfilm_dist.tuning.grid_file import write_grid_file
    from slotfilm_dist.tuning.jobs import build_jobs, build_trials
    from slotfilm_dist.tuning.ledger import Ledger, held_by_one_driver

    jobs = build_jobs(build_trials(base, _variants(options, base), options.seeds))
    grid = _directory(options, base)
    if options.dry_run:
        return _dry_run(options, fields, grid, jobs)
    ledger = Ledger(grid)
    with held_by_one_driver(grid):
        write_grid_file(grid, _settings(base), command := ("grid", *arguments))
        with contextlib.redirect_stdout(sys.stderr):  # Ray's messages keep out of --json
            signalled = _run(options, fields, grid, jobs, ledger, command)
        code = _outcome(options, grid, jobs, ledger)
        return signalled or code


def _parser() -> Parser:
    parser = Parser(
        prog="slotfilm grid",
        description="Train every variant of the study with several seeds, as trials of Ray Tune: on the cluster that "
        "RAY_ADDRESS names, or on this machine. The same command again goes on: trials that are over are left alone.",
        epilog=FIELDS_NOTE,
    )
    add = parser.add_argument
    add("preset", nargs="?", default="quick", help=f"budget: {', '.join(PRESETS)} (default: %(default)s)")
    add("--only", action="append", default=[], metavar="A,B", help="these variants (default: all of the study)")
    add("--exclude", action="append", default=[], metavar="A,B", help="without these variants")
    add(
        "--seeds", type=int, default=5, metavar="N", help="seeds of each variant, from --seed on (default: %(default)s)"
    )
    add("--name", default="", help="directory of the grid within --runs (default: grid, preset and changed fields)")
    add("--runs", default="runs", metavar="DIR", help="where grids go; every node must see it (default: %(default)s)")
    add(
        "--artifacts",
        default="artifacts",
        metavar="DIR",
        help="data and encoders that trials share (default: %(default)s)",
    )
    add("--retries", type=int, default=2, metavar="N", help="further attempts of a failed trial (default: %(default)s)")
    add("--max-concurrent", type=int, default=0, metavar="N", help="most trials at a time; 0: as many as fit (default)")
    add("--cpus-per-trial", type=float, metavar="X", help="cores of a trial, for all its roles (default: one a role)")
    add(
        "--gpus-per-trial",
        type=float,
        metavar="X",
        help="GPU of a trial's learner, 0 to 1 (default: 1 if there is any)",
    )
    add("--asha", action="store_true", help="end trials early whose return lags behind others of the same reward")
    add("--dry-run", action="store_true", help="say what would be done, with resources, disk and hours; start nothing")
    add("--json", action="store_true", help="print the outcome as one JSON object")
    add("--fields", action="store_true", help="list every field of the config with its default")
    return parser


def _names(given: Sequence[str]) -> list[str]:
    return [name for words in given for name in words.replace(",", " ").split()]


def _variants(options: "argparse.Namespace", base: RunConfig) -> list[str]:
    """The grid's variants; those that the task makes meaningless are left out and named.

    Raises:
        ValueError: one of those was asked for by name, or nothing is left.
    """
    from slotfilm_dist.tuning.jobs import meaningless_variants, select_variants

    chosen = select_variants(_names(options.only), _names(options.exclude))
    reasons = meaningless_variants(base, chosen)
    told = ", ".join(f"{name} ({reason})" for name, reason in reasons.items())
    if reasons and (options.only or len(reasons) == len(chosen)):
        raise ValueError(f"--only {told}: leave it away")
    if reasons:
        print(f"Left out: {told}", file=sys.stderr)
    return [name for name in chosen if name not in reasons]


def _settings(base: RunConfig) -> RunConfig:
    """What all trials of a grid share: the proposed agent, whatever its seed and wherever it runs."""
    return replace(base, seed=0, runtime=RuntimeConfig(), checkpoint=CheckpointConfig())


def _directory(options: "argparse.Namespace", base: RunConfig) -> Path:
    """Where the grid lives: the same for the same command, another one for other settings.

    Raises:
        ValueError: a name that is none, or that belongs to a grid of other settings; a directory that Ray deletes.
    """
    from slotfilm_dist.runs import RUN_NAME
    from slotfilm_dist.tuning.grid_file import check_same_settings

    for option in ("runs", "artifacts"):
        if JOB_FILES in str(Path(getattr(options, option)).resolve()):
            raise ValueError(
                f"--{option} {getattr(options, option)}: in a Ray job this lies in a copy of the working directory "
                "that Ray deletes; give --runs and --artifacts a path that every node sees, as in --runs /shared/runs"
            )
    settings = _settings(base)
    own = f"-{config_hash(settings)[:6]}" if changed_fields(_settings(preset_named(options.preset)), settings) else ""
    name = options.name or f"grid-{options.preset}{own}"
    if not RUN_NAME.fullmatch(name):
        raise ValueError(f"--name {name!r}: use letters, digits, '.', '_' and '-', at most 100 of them")
    grid = Path(options.runs).resolve() / name
    check_same_settings(grid, settings)
    return grid


def _placed(
    options: "argparse.Namespace", fields: Sequence[str], grid: Path, jobs: "Sequence[Job]", nodes: "Nodes"
) -> "tuple[list[Job], dict[str, TrialResources]]":
    """The jobs with the mode that they run in, and what each asks for.

    A mode that the command line names holds. Otherwise a trial that has begun keeps its own, so that it goes on with
    its replay, and a new one runs on Ray where the cluster has a core for each of its roles, else in one process.
    """
    from slotfilm_dist.config_files import load_config
    from slotfilm_dist.tuning.resources import fit_to_resources, job_resources, runs_on_ray

    named = any(word.split("=")[0] == "--runtime.mode" for word in fields)
    placed: list[Job] = []
    resources: dict[str, TrialResources] = {}
    for job in jobs:
        mode = job.config.runtime.mode
        if not named:
            begun = grid / job.key / "config.json"
            mode = "ray" if runs_on_ray(job.config, nodes) else "local"
            mode = load_config(begun).runtime.mode if begun.exists() else mode
        config = replace(job.config, runtime=replace(job.config.runtime, mode=mode))
        job = replace(job, config=config)
        given = job_resources(job, nodes, options.cpus_per_trial, options.gpus_per_trial)
        resources[job.key] = given
        placed.append(replace(job, config=fit_to_resources(config, given)))
    return placed, resources


def _dry_run(options: "argparse.Namespace", fields: Sequence[str], grid: Path, jobs: "Sequence[Job]") -> int:
    from rich.console import Console

    from slotfilm_dist.tuning.dry_run import describe, show
    from slotfilm_dist.tuning.grid import jobs_to_do
    from slotfilm_dist.tuning.ledger import Ledger

    nodes = _nodes_without_starting()
    placed, resources = _placed(options, fields, grid, jobs, nodes)
    todo = jobs_to_do(placed, Ledger(grid), Path(options.artifacts).resolve())
    plan = describe(placed, todo, resources, nodes, options.max_concurrent)
    if options.json:
        json.dump({"grid": str(grid), **plan}, sys.stdout)
        print()
    else:
        show(plan, grid, Console())
    return 0


def _nodes_without_starting() -> "Nodes":
    """The cluster that the grid would run on: the one of RAY_ADDRESS, or this machine as a private one would see it."""
    if os.environ.get("RAY_ADDRESS"):
        from slotfilm_dist.cluster.session import Session

        session = Session()
        try:
            return session.nodes()
        finally:
            session.close()
    import torch

    from slotfilm_dist.cluster.session import STORE_BYTES
    from slotfilm_dist.machine import usable_cores, usable_memory_bytes

    memory = usable_memory_bytes()
    node = {"CPU": float(max(1, int(usable_cores()))), "memory": float(memory - min(STORE_BYTES, memory // 4))}
    return [node | ({"GPU": float(torch.cuda.device_count())} if torch.cuda.is_available() else {})]


def _run(
    options: "argparse.Namespace",
    fields: Sequence[str],
    grid: Path,
    jobs: "Sequence[Job]",
    ledger: "Ledger",
    command: tuple[str, ...],
) -> int:
    """Do what is left to do; gives 128 + n after signal n, else 0."""
    from slotfilm_dist.cluster.session import Session
    from slotfilm_dist.stopping import Interrupted, StopFlag
    from slotfilm_dist.tuning.board import Board
    from slotfilm_dist.tuning.grid import GridLimits, jobs_to_do, run_grid
    from slotfilm_dist.tuning.places import make_backend
    from slotfilm_dist.tuning.resources import check_fits, num_that_fit
    from slotfilm_dist.tuning.work import Orders

    artifacts = Path(options.artifacts).resolve()
    wanted = {job.key for job in jobs_to_do(jobs, ledger, artifacts)}
    if not wanted:
        return 0
    board = Board([(job, ledger.read(job)) for job in jobs if job.kind == "trial" or job.key in wanted])
    stop = StopFlag()
    session = Session(metrics_port=jobs[0].config.runtime.metrics_port)
    try:
        nodes = session.nodes()
        placed, resources = _placed(options, fields, grid, jobs, nodes)
        todo = jobs_to_do(placed, ledger, artifacts)
        for job in todo if session.private else ():
            check_fits(job.key, resources[job.key], nodes)
        homeless = {job.key for job in todo if not num_that_fit(resources[job.key], nodes)}
        if homeless:
            board.say(
                f"    grid  no node of this cluster has room for {', '.join(sorted(homeless))}: they wait for larger "
                "nodes, one at a time, while the others run; `--dry-run` shows what each asks for"
            )
        orders = Orders(
            grid=grid,
            artifacts=artifacts,
            jobs={job.key: job for job in placed},
            resources=resources,
            make_backend=make_backend,
            command=command,
        )
        board.say(f"slotfilm  grid of {sum(job.kind == 'trial' for job in jobs)} trials: {grid}")
        limits = GridLimits(num_retries=options.retries, max_concurrent=options.max_concurrent, asha=options.asha)
        with stop.listening():
            run_grid(todo, orders, limits, board, stop, homeless)
            stop.check()
    except Interrupted as interruption:
        board.say(f"{interruption}; go on with the same command: {shlex.join(('slotfilm', *command))}")
        return interruption.exit_code
    finally:
        session.close()
    return 0


def _outcome(options: "argparse.Namespace", grid: Path, jobs: "Sequence[Job]", ledger: "Ledger") -> int:
    """Say what has become of the trials; gives the exit code."""
    from slotfilm_dist.progress import steady_console

    records = [ledger.read(job) for job in jobs if job.kind == "trial"]
    failed = [record for record in records if record.state == "failed"]
    console = steady_console()
    for record in failed:
        console.print(f"  failed  {record.key}: {record.error}", soft_wrap=True, markup=False)
    counts = Counter(record.state for record in records)
    states = ", ".join(f"{number} {state}" for state, number in counts.items())
    console.print(f"    grid  {states}: {grid}", soft_wrap=True, markup=False)
    if options.json:
        trials = [{name: getattr(record, name) for name in SHOWN} for record in records]
        json.dump({"grid": str(grid), "states": counts, "trials": trials}, sys.stdout)
        print()
    return 1 if failed else 0
