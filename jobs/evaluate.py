"""An evaluation as a Ray job: one run after another, each with its last checkpoint on held-out seeds.

    ray job submit --working-dir . --no-wait --submission-id evaluate --entrypoint-num-cpus 1 \
        -- python jobs/evaluate.py /shared/runs/grid-steady/slotfilm-* --episodes 50

`/shared` stands for a directory that every node sees. Further words, after the runs, go to `slotfilm evaluate`. It
works in the job's own process, hence the one core that it asks for.

Submitted again it goes on: runs whose evaluation is there are left alone, unless further words may ask for another one.
`ray job stop` ends it within an episode.
"""

import argparse
import sys
from pathlib import Path

from slotfilm_dist.__main__ import main
from slotfilm_dist.commands.evaluate import EPISODES

STOPPED = 128
"""Exit codes from here on mean that a signal has ended it."""


def is_there(run: Path, episodes: int, seed: int) -> bool:
    """Whether the run's last checkpoint has been evaluated so."""
    result = run / "evaluation" / f"agent-{seed}-{episodes}.json"
    written = [checkpoint.stat().st_mtime for checkpoint in (run / "checkpoints").glob("updates-*")]
    return result.exists() and result.stat().st_mtime > max(written, default=0.0)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="directories of runs")
    parser.add_argument("--episodes", type=int, help="of each run (default: as `slotfilm evaluate` has it)")
    parser.add_argument("--seed", type=int, default=10_000_000)
    options, rest = parser.parse_known_args()
    code = 0
    for run in options.runs:
        if not rest and is_there(run, options.episodes or EPISODES, options.seed):
            print(f"{run}: evaluated already")
            continue
        print(f"{run}:", flush=True)
        episodes = [] if options.episodes is None else ["--episodes", str(options.episodes)]
        words = [str(run), *episodes, "--seed", str(options.seed), *rest]
        ended = main(["evaluate", *words])
        if ended >= STOPPED:
            sys.exit(ended)
        code = ended or code
    sys.exit(code)
