"""A seed sweep of one variant as a Ray job.

    ray job submit --working-dir . --no-wait --submission-id no-state \
        --runtime-env-json '{"env_vars": {"RAY_JOB_STOP_WAIT_TIME_S": "600"}}' \
        -- python jobs/seeds.py no_state steady --seeds 10 --runs /shared/runs --artifacts /shared/artifacts

`/shared` stands for a directory that every node sees. The first word is the variant, all others go to `slotfilm grid`.
Submitted again it goes on, as `jobs/grid.py` does; it shares that grid's directory, so that a sweep adds seeds to a
study, but the two cannot run at the same time: give one of them a `--name`.
"""

import sys

from slotfilm_dist.__main__ import main

if __name__ == "__main__":
    if sys.argv[1:] in (["-h"], ["--help"]):
        print(__doc__)
        sys.exit(0)
    if len(sys.argv) < 2 or sys.argv[1].startswith("-"):
        print("usage: python jobs/seeds.py VARIANT [PRESET] [--seeds N] [options of slotfilm grid]", file=sys.stderr)
        sys.exit(2)
    sys.exit(main(["grid", *sys.argv[2:], "--only", sys.argv[1]]))
