"""The study as a Ray job: every variant and seed as trials of Ray Tune.

    ray job submit --working-dir . --no-wait --submission-id study \
        --runtime-env-json '{"env_vars": {"RAY_JOB_STOP_WAIT_TIME_S": "600"}}' \
        -- python jobs/grid.py steady --seeds 5 --gpus-per-trial 0.25 --runs /shared/runs --artifacts /shared/artifacts

`/shared` stands for a directory that every node sees. All words go to `slotfilm grid`; `--dry-run` among them says
what would be done. A variant changes the preset's agent: the ablations of the reward (`varpi_1`, `varpi_10`,
`no_static`) are the paper's on `paper`; `steady` rewards standing still in its own way.

The same submission again (under another submission id) goes on: finished trials are left alone, interrupted ones
continue from their checkpoints. `ray job stop` sends SIGTERM, on which every trial writes its checkpoint with replay;
Ray kills what is left after RAY_JOB_STOP_WAIT_TIME_S seconds, 3 unless the job's environment says otherwise, as above.
What was killed goes on from its last periodic checkpoint. The job fails if a trial failed for good; the rest is done by
then.
"""

import sys

from slotfilm_dist.__main__ import main

if __name__ == "__main__":
    sys.exit(main(["grid", *sys.argv[1:]]))
