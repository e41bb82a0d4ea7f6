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

from slotfilm_dist.__main__ import main


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
    run = Path(options.runs) / (options.name or "-".join(given))
    if _phase(run / "status.json") == "done":
        print(f"{run} is done; see {run / 'report.html'}")
        return []
    places = ["--artifacts", options.artifacts]
    if (run / "config.json").exists():
        return ["train", "--resume", str(run), *places, *rest]
    agent = ["--variant", options.variant] if options.variant else []
    begin = ["train", options.preset, *agent, "--seed", options.seed, "--runs", options.runs, "--name", run.name]
    return [*begin, *places, *rest]


def _phase(status: Path) -> str:
    """How far the run has come; empty where that cannot be read: `train` then looks itself."""
    try:
        return str(json.loads(status.read_text(encoding="utf-8")).get("phase", ""))
    except (OSError, ValueError, AttributeError):
        return ""


if __name__ == "__main__":
    command = words(sys.argv[1:])
    sys.exit(main(command) if command else 0)
