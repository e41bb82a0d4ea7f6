"""The paper's run as a Ray job: the proposed agent at the paper's numbers, on workers all over the cluster.

    ray job submit --working-dir . --no-wait --submission-id paper-s0 \
        --runtime-env-json '{"env_vars": {"RAY_JOB_STOP_WAIT_TIME_S": "600"}}' \
        -- python jobs/paper.py --runs /shared/runs --artifacts /shared/artifacts

`/shared` stands for a directory that every node sees. Further words go to `slotfilm train`, as in `--seed 1`.

The same submission again (under another submission id) goes on with the run, or says that it is done. `ray job stop`
sends SIGTERM, on which the run writes its checkpoint with replay; Ray kills what is left after
RAY_JOB_STOP_WAIT_TIME_S seconds, 3 unless the job's environment says otherwise, as above.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from slotfilm_dist.__main__ import main
from slotfilm_dist.runs import RUN_NAME


def words(arguments: list[str]) -> list[str]:
    """The words of the `slotfilm train` that begins the run or goes on with it; none if it is done."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="paper", help="paper, steady or cluster, or a smaller one to try it out")
    parser.add_argument("--name", default="", help="of the run's directory (default: preset, variant if given, seed)")
    parser.add_argument("--variant", default="", help="another agent of `slotfilm variants`")
    parser.add_argument("--seed", default="0")
    parser.add_argument("--runs", required=True, help="absolute, and seen by every node")
    parser.add_argument("--artifacts", required=True, help="absolute, and seen by every node")
    options, rest = parser.parse_known_args(arguments)
    for path in (options.runs, options.artifacts):
        if not Path(path).is_absolute():
            parser.error(f"{path} is relative: Ray deletes a job's working directory; give a path that every node sees")
    given = [options.preset, *filter(None, [options.variant]), f"s{options.seed}"]
    if options.name and not RUN_NAME.fullmatch(options.name):
        parser.error(f"--name {options.name!r}: use letters, digits, '.', '_' and '-', at most 100 of them")
    run = Path(options.runs) / (options.name or "-".join(given))
    begun = _read(run / "config.json")
    for name, wanted in (("seed", options.seed), ("variant", options.variant or "slotfilm")):
        if str(begun.get(name, wanted)) != wanted:
            parser.error(f"--{name} {wanted}: {run} was begun with {name} {begun[name]}; give this run another --name")
    if _read(run / "status.json").get("phase") == "done":
        print(f"{run} is done; see {run / 'report.html'}")
        return []
    places = ["--artifacts", options.artifacts]
    if (run / "config.json").exists():
        return ["train", "--resume", str(run), *places, *rest]
    agent = ["--variant", options.variant] if options.variant else []
    begin = ["train", options.preset, *agent, "--seed", options.seed, "--runs", options.runs, "--name", run.name]
    return [*begin, *places, *rest]


def _read(path: Path) -> dict[str, Any]:
    """A JSON object of the run; empty where it cannot be read: `train` then looks itself."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return values if isinstance(values, dict) else {}


if __name__ == "__main__":
    command = words(sys.argv[1:])
    sys.argv[1:] = command  # what the run records as its command
    sys.exit(main(command) if command else 0)
