"""Tells what a grid would do: trials, resources, memory, disk and hours, without starting anything."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from slotfilm_dist.tuning.estimate import SOURCE, JobEstimate, estimate, total_hours
from slotfilm_dist.tuning.jobs import Job
from slotfilm_dist.tuning.resources import Nodes, TrialResources, num_that_fit


def describe(
    jobs: Sequence[Job],
    todo: Sequence[Job],
    resources: Mapping[str, TrialResources],
    nodes: Nodes,
    max_concurrent: int,
) -> dict[str, Any]:
    """What a grid would do, as plain values.

    Args:
        jobs: all of the grid.
        todo: those that are left.
        resources: by key.
        nodes: the cluster that it would run on.
        max_concurrent: most at the same time; 0 is as many as fit.
    """
    estimates = {job.key: estimate(job, resources[job.key]) for job in todo}
    trials = [job for job in todo if job.kind == "trial"]
    fits = {job.key: num_that_fit(resources[job.key], nodes) for job in trials}
    at_once = min((n for n in fits.values() if n), default=0)
    at_once = min(at_once, max_concurrent) if max_concurrent else at_once
    largest = sorted((estimates[job.key].disk_bytes - estimates[job.key].kept_bytes for job in trials), reverse=True)
    return {
        "trials": sum(job.kind == "trial" for job in jobs),
        "to_do": len(trials),
        "at_once": at_once,
        "no_room": [key for key, n in fits.items() if n == 0],
        "jobs": [_row(job, resources[job.key], estimates[job.key]) for job in todo],
        "job_hours": sum(e.hours for e in estimates.values()),
        "hours": total_hours(todo, estimates, at_once),
        "kept_bytes": sum(e.kept_bytes for e in estimates.values()),
        "hours_by_name": _hours_by_name(trials, estimates),
        "disk_bytes": sum(e.kept_bytes for e in estimates.values()) + sum(largest[: max(at_once, 1)]),
        "hours_source": SOURCE,
    }


def show(plan: dict[str, Any], grid: Path, console: Console) -> None:
    """Print what `describe` gives, one line for trials that differ only in their seed."""
    table = Table(
        "job", "number", "mode", "cores", "GPUs", "memory GB", "disk GB", "hours each", box=None, pad_edge=False
    )
    for rows in _alike(plan["jobs"]):
        first = rows[0]
        table.add_row(
            first["name"],
            str(len(rows)),
            first["mode"],
            f"{first['cpus']:g}",
            f"{first['gpus']:g}",
            f"{first['memory_bytes'] / 1e9:.1f}",
            f"{first['disk_bytes'] / 1e9:.2f}",
            _hours(first["hours"]),
        )
    console.print(table)
    over = plan["trials"] - plan["to_do"]
    console.print(
        f"\n{plan['trials']} trials, {over} of them over, {plan['to_do']} to do; {plan['at_once']} at a time. "
        f"About {_hours(plan['hours'])} h ({_hours(plan['job_hours'])} h of jobs); at the most "
        f"{plan['disk_bytes'] / 1e9:.1f} GB of disk, of which {plan['kept_bytes'] / 1e9:.1f} GB stay in {grid} and the "
        f"artifacts.\nHours come from the costs of single steps on {plan['hours_source']}.",
        soft_wrap=True,
    )
    if costly := _costly(plan):
        console.print(
            f"Most of the hours are those of {', '.join(f'{name} ({_hours(h)} h)' for name, h in costly.items())}: "
            "`--exclude` them where there is no GPU.",
            soft_wrap=True,
        )
    if plan["no_room"]:
        lacking = dict.fromkeys(row["name"] for row in plan["jobs"] if row["key"] in plan["no_room"])
        console.print(f"The cluster has no room for {', '.join(lacking)} as it is now.", style="red", soft_wrap=True)


def _hours_by_name(trials: Sequence[Job], estimates: Mapping[str, JobEstimate]) -> dict[str, float]:
    """Hours of all seeds of a variant, the longest first."""
    hours: dict[str, float] = {}
    for job in trials:
        hours[job.config.variant] = hours.get(job.config.variant, 0.0) + estimates[job.key].hours
    return dict(sorted(hours.items(), key=lambda item: -item[1]))


def _costly(plan: dict[str, Any]) -> dict[str, float]:
    """The fewest variants that make up nine tenths of the hours; none where that is more than half of the variants."""
    hours, taken = plan["hours_by_name"], 0.0
    costly: dict[str, float] = {}
    for name, own in hours.items():
        if taken >= 0.9 * plan["job_hours"]:
            break
        costly[name], taken = own, taken + own
    return costly if 2 * len(costly) <= len(hours) else {}


def _row(job: Job, resources: TrialResources, taken: JobEstimate) -> dict[str, Any]:
    return {
        "key": job.key,
        "kind": job.kind,
        "name": {"data": "random data", "encoder": "encoder", "trial": job.config.variant}[job.kind],
        "seed": job.config.seed,
        "mode": job.config.runtime.mode,
        "cpus": resources.num_cpus,
        "gpus": resources.num_gpus,
        "memory_bytes": resources.memory_bytes,
        "bundles": resources.bundles,
        "disk_bytes": taken.disk_bytes,
        "hours": taken.hours,
    }


def _alike(rows: Sequence[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["name"], row["mode"], row["cpus"], row["memory_bytes"], row["hours"]), []).append(row)
    return list(groups.values())


def _hours(hours: float) -> str:
    return f"{hours:.2f}" if hours < 10 else f"{hours:,.0f}"
