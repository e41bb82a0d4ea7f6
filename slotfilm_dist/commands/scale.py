"""`slotfilm scale`: more or fewer workers for a run that is under way."""

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from slotfilm_dist.commands.options import Parser

if TYPE_CHECKING:
    from slotfilm_dist.cluster.hub_client import HubClient

AUTO = 0
"""Instead of a number of workers: as many as the learner needs."""
MEASURE_S = 5.0
"""Time over which the steps per second are measured before and after."""


def main(arguments: Sequence[str]) -> int:
    """Scale; gives the exit code: 1 if the workers were not there in time."""
    parser = Parser(
        prog="slotfilm scale",
        description="Change the number of environment workers of a live run on Ray; the learner goes on meanwhile.",
    )
    parser.add_argument("run", help="directory of the run")
    parser.add_argument(
        "--workers",
        type=workers_wanted,
        required=True,
        metavar="N|auto",
        help="workers wanted, 1 or more; auto adds and removes them as the learner needs them",
    )
    parser.add_argument(
        "--timeout-s",
        type=float,
        default=120.0,
        metavar="S",
        help="longest wait for them in seconds; 0 asks and does not wait (default: %(default)s)",
    )
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
    options = parser.parse_args(arguments)
    if not 0 <= options.timeout_s < math.inf:
        raise ValueError(f"--timeout-s {options.timeout_s:g}: must be 0 or more, and finite")

    _present_token(Path(options.run))
    from slotfilm_dist.cluster.hub_client import HubClient
    from slotfilm_dist.cluster.session import joined

    with joined(Path(options.run)) as namespace:
        hub = HubClient.find(namespace)
        if options.workers == AUTO:
            hub.want_auto_workers()
            return _tell_auto(hub.status().alive_workers, as_json=options.json)
        before = hub.status()
        rate_before = _steps_per_s(hub) if options.timeout_s else 0.0
        hub.want_workers(options.workers)
        began = time.monotonic()
        while (alive := hub.status().alive_workers) != options.workers:
            if time.monotonic() - began >= options.timeout_s:
                break
            time.sleep(0.25)
        took_s = time.monotonic() - began
        reached = alive == options.workers
        rate_after = _steps_per_s(hub) if options.timeout_s and reached else 0.0
    result = {
        "workers_before": before.alive_workers,
        "workers_wanted": options.workers,
        "workers_after": alive,
        "took_s": took_s,
        "env_steps_per_s_before": rate_before,
        "env_steps_per_s_after": rate_after,
    }
    if options.json:
        json.dump(result, sys.stdout)
        print()
    else:
        print(_sentence(result, reached=reached, waited=options.timeout_s > 0))
    return 0 if reached or options.timeout_s == 0 else 1


def workers_wanted(word: str) -> int:
    """A number of workers, or `AUTO`; raises ``ArgumentTypeError`` for any other word."""
    if word == "auto":
        return AUTO
    if not word.isdecimal() or int(word) < 1:
        raise argparse.ArgumentTypeError(f"{word}: must be 1 or more, or auto")
    return int(word)


def _tell_auto(alive_workers: int, *, as_json: bool) -> int:
    if as_json:
        print(json.dumps({"workers_before": alive_workers, "workers_wanted": "auto"}))
    else:
        print(f"{alive_workers} workers; from now on as many as the learner needs, where cores are free")
    return 0


def _present_token(run: Path) -> None:
    """Show the private cluster's token; Ray reads how to authenticate when it is imported, so this comes before."""
    try:
        values = json.loads((run / "cluster.json").read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError):
        return  # `joined` says what is wrong with it
    if isinstance(values, dict) and values.get("token_path"):
        os.environ["RAY_AUTH_MODE"] = "token"
        os.environ["RAY_AUTH_TOKEN_PATH"] = str(values["token_path"])


def _steps_per_s(hub: "HubClient") -> float:
    first, began = hub.status().env_steps, time.monotonic()
    time.sleep(MEASURE_S)
    return (hub.status().env_steps - first) / (time.monotonic() - began)


def _sentence(result: dict[str, float], *, reached: bool, waited: bool) -> str:
    change = f"{result['workers_before']} -> {result['workers_wanted']} workers"
    if not waited:
        return f"asked for {change}"
    if not reached:
        return (
            f"asked for {change}; {result['workers_after']} run after {result['took_s']:.0f} s. "
            "The run starts the rest when it can; metrics.jsonl has worker_alive_count"
        )
    return (
        f"{change} in {result['took_s']:.1f} s; env steps/s {result['env_steps_per_s_before']:.1f} -> "
        f"{result['env_steps_per_s_after']:.1f}"
    )
