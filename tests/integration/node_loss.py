"""A run on three Ray nodes of which one that workers run on is removed; prints what happened as JSON.

    python node_loss.py FOLDER DATASET

A process of its own, for a process has one Ray cluster at a time.
"""

import json
import logging
import sys
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import ray
from ray.cluster_utils import Cluster

from slotfilm_dist.backend import TrainReport
from slotfilm_dist.cluster.backend import RayBackend
from slotfilm_dist.cluster.placement import STATE_RESOURCE, WORKER_RESOURCE
from slotfilm_dist.config_files import load_config
from slotfilm_dist.envs.toy import make_slow_toy_env

MEASURE_S = 5.0
"""Time over which env steps a second are taken."""
NUM_WORKERS = 2
LIMIT_S = 150.0
"""Longest wait for each of the stages."""


def homes() -> dict[str, set[str]]:
    """Nodes that live actors of each class run on."""
    from ray._private.state import actors

    nodes: dict[str, set[str]] = defaultdict(set)
    for actor in actors().values():
        if actor["State"] == "ALIVE":
            nodes[actor["ActorClassName"]].add(actor["Address"]["NodeID"])
    return nodes


class Watch:
    """Env steps a second over the last `MEASURE_S`, from reports as they come; ends the run when told or too late."""

    def __init__(self) -> None:
        self._seen: list[tuple[float, int]] = []
        self.stop, self.deadline = False, time.monotonic() + LIMIT_S

    def __call__(self) -> bool:
        """Whether to end."""
        return self.stop or time.monotonic() > self.deadline

    def add(self, report: TrainReport) -> float:
        """Take a report in; gives the rate, 0 before there is enough to tell."""
        now = time.monotonic()
        self._seen = [(at, steps) for at, steps in self._seen if now - at <= 2 * MEASURE_S] + [(now, report.env_steps)]
        at, steps = max((s for s in self._seen if now - s[0] >= MEASURE_S), default=(now, 0))
        return (report.env_steps - steps) / (now - at) if now > at else 0.0


def main(folder: Path, dataset: Path) -> dict[str, object]:
    cluster = Cluster(
        initialize_head=True,
        head_node_args={"num_cpus": 4, "resources": {STATE_RESOURCE: 1}, "include_dashboard": False},
    )
    nodes = [cluster.add_node(num_cpus=2, resources={WORKER_RESOURCE: 1}) for _ in range(2)]
    ray.init(address=cluster.address, log_to_driver=False, logging_level=logging.ERROR)
    cluster.wait_for_nodes()
    config = load_config(folder / "config.json")
    backend = RayBackend(replace(config, runtime=replace(config.runtime, mode="ray")), folder, make_slow_toy_env)
    try:
        return observe(cluster, {node.node_id: node for node in nodes}, backend, dataset)
    finally:
        backend.close()
        ray.shutdown()
        cluster.shutdown()


def observe(cluster: Cluster, worker_nodes: dict, backend: RayBackend, dataset: Path) -> dict[str, object]:
    """Train, remove a node with workers once the rate is known, and wait until the rate is back."""
    backend.prepare()
    backend.begin_training(dataset, None, None)
    watch, told, removed_at = Watch(), dict[str, object](), 0.0
    for report in backend.train(watch):
        alive, rate = report.metrics["worker_alive_count"], watch.add(report)
        if not removed_at and alive == NUM_WORKERS and rate > 0 and report.updates > 20:
            where = homes()
            told |= {"worker_nodes": len(where["WorkerActor"]), "rate_before": rate, "updates_before": report.updates}
            told["workers_apart"] = not where["WorkerActor"] & (where["LearnerActor"] | where["ShardActor"])
            told["workers_there"] = where["WorkerActor"] <= worker_nodes.keys()
            cluster.remove_node(worker_nodes[min(where["WorkerActor"])], allow_graceful=False)
            removed_at, watch.deadline = time.monotonic(), time.monotonic() + LIMIT_S
        elif removed_at and time.monotonic() - removed_at > MEASURE_S and alive == NUM_WORKERS:
            told |= {"rate_after": rate, "back_after_s": time.monotonic() - removed_at - MEASURE_S}
            watch.stop = rate >= 0.9 * told["rate_before"]
    told |= {"env_steps": report.env_steps, "updates": report.updates, "metrics": dict(report.metrics)}
    return told


if __name__ == "__main__":
    print(json.dumps(main(Path(sys.argv[1]), Path(sys.argv[2]))))
