"""A whole run on a private cluster, for `test_private_run`, with its token as for any user.

    python private_run.py RUN ARTIFACTS

Prints one line once the cluster is there: where it and everything it started listens. Runs, then waits for its input to
end, so that the cluster can be asked things; then closes it and prints what is left of it.
"""

import contextlib
import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import psutil

from slotfilm_dist.cluster.backend import RayBackend
from slotfilm_dist.cluster.session import read_cluster_file
from slotfilm_dist.envs.toy import make_toy_env
from slotfilm_dist.pipeline import Pipeline
from slotfilm_dist.presets import smoke
from slotfilm_dist.progress import Progress
from slotfilm_dist.runs import RunDirectory
from slotfilm_dist.stopping import StopFlag
from slotfilm_dist.variants import apply_variant


def main(folder: str, artifacts: str) -> None:
    base = apply_variant("state_only", smoke())
    config = replace(
        base,
        schedule=replace(base.schedule, total_steps=300, random_steps=150),
        runtime=replace(base.runtime, mode="ray", num_workers=1, learner_threads=1, device="cpu"),
        evaluation=replace(base.evaluation, episodes=1),
    )
    backend = RayBackend(config, Path(folder), make_toy_env)
    backend.prepare()
    with RunDirectory(Path(folder), config) as run:
        Pipeline(run, backend, Path(artifacts), Progress(), StopFlag()).execute()
    cluster = read_cluster_file(Path(folder))
    print(json.dumps({"listening": listening(psutil.Process()), **cluster}), flush=True)
    sys.stdin.read()
    backend.close()
    print(json.dumps({"folder_left": os.path.exists(os.path.dirname(cluster["token_path"]))}))


def listening(process: psutil.Process) -> list[tuple[str, str, int]]:
    """Name of the process, address and port of everything at which it or what it started accepts connections."""
    found: list[tuple[str, str, int]] = []
    for each in [process, *process.children(recursive=True)]:
        with contextlib.suppress(psutil.NoSuchProcess):  # it may have ended since
            name = each.name()
            addresses = [c.laddr for c in each.net_connections(kind="inet") if c.status == psutil.CONN_LISTEN]
            found += [(name, address.ip, address.port) for address in addresses]
    return found


if __name__ == "__main__":
    main(*sys.argv[1:])
