"""What a trial asks of the cluster: a placement group for its roles, or one bundle for a run in one process."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from slotfilm_dist.cluster.placement import (
    OTHER_ROLES,
    SHARES,
    STATE_RESOURCE,
    TOKEN,
    WORKER_RESOURCE,
    nodes_for,
    num_roles_that_fit,
)
from slotfilm_dist.config import RunConfig
from slotfilm_dist.replay.memory import replay_bytes
from slotfilm_dist.tuning.jobs import Job

LOCAL_BYTES = 2_000_000_000
"""Memory of a run in one process beside its replay: Python, torch, simulator, networks."""
ROLE_BYTES = 1_000_000_000
"""Memory of a worker, the learner or an evaluation player on Ray; hub and shards take little beside the replay."""
FEATURE_BYTES = 512
"""What pre-training on a fixed backbone keeps of a token: 256 channels in float16."""
_MIB = 1 << 20

Nodes = Sequence[Mapping[str, float]]
"""Resources of every live node, as Ray names them."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TrialResources:
    """What one trial is given for itself."""

    num_roles: int
    """Processes that share the cores: workers, who act by themselves, learner, evaluation player; 1 in one process."""
    role_cpus: float
    """Cores of each; below 1, roles or trials share a core."""
    num_gpus: float
    """GPUs of the learner; below 1, trials share a GPU."""
    memory_bytes: int
    """Most memory that all of it takes."""
    state_token: float = 0.0
    """Of the resource of nodes for roles with state, where there are such nodes."""
    worker_token: float = 0.0
    """Of the resource of nodes for workers, for each bundle of a worker or a player."""

    @property
    def num_cpus(self) -> float:
        """Cores of the trial."""
        return self.num_roles * self.role_cpus

    @property
    def bundles(self) -> list[dict[str, float]]:
        """Bundles of the placement group; the first is that of the process which drives the trial.

        On Ray the driving process computes nothing: its bundle holds the memory of replay and learner, as the others
        hold that of a worker or player, which no role asks for by itself; so Ray never packs more trials onto a node
        than fit. The learner's bundle comes second. These two, or all of a run in one process, go where state belongs.
        """
        gpus = {"GPU": self.num_gpus} if self.num_gpus else {}
        state = {STATE_RESOURCE: self.state_token} if self.state_token else {}
        kept = {"memory": _whole_mib(self.kept_bytes)} | state
        role = {"CPU": self.role_cpus}
        if self.num_roles == 1:
            return [role | kept | gpus]
        worker = {WORKER_RESOURCE: self.worker_token} if self.worker_token else {}
        worker |= {"memory": _whole_mib(ROLE_BYTES)}
        return [kept, role | gpus | state, *(role | worker for _ in range(self.num_roles - 1))]

    @property
    def kept_bytes(self) -> int:
        """Memory of what must not be lost: replay and learner, or a whole run in one process."""
        return self.memory_bytes - (self.num_roles - 1) * ROLE_BYTES


def runs_on_ray(config: RunConfig, nodes: Nodes) -> bool:
    """Whether the cluster has a whole core for every role of a trial, so that spreading them pays."""
    return sum(node.get("CPU", 0.0) for node in nodes) >= config.runtime.num_workers + OTHER_ROLES


def job_resources(
    job: Job, nodes: Nodes, cpus_per_trial: float | None = None, gpus_per_trial: float | None = None
) -> TrialResources:
    """What a trial, or the making of an artifact, asks for.

    Args:
        job: its `runtime.mode` says how it runs.
        nodes: the cluster.
        cpus_per_trial: cores, divided evenly among the roles; None gives each role a core, or the largest share with
            which one trial fits.
        gpus_per_trial: GPUs of the learner, also where a node with a GPU has yet to join; None gives it one where
            there is one.

    Raises:
        ValueError: a number that cannot be asked for.
    """
    for option, value in (("--cpus-per-trial", cpus_per_trial), ("--gpus-per-trial", gpus_per_trial)):
        if value is not None and not (0 < value < math.inf or (value == 0 and option == "--gpus-per-trial")):
            raise ValueError(f"{option} {value:g}: must be greater than 0 and finite")
    if gpus_per_trial is not None and gpus_per_trial > 1:
        raise ValueError(f"--gpus-per-trial {gpus_per_trial:g}: a trial has one learner, which uses at most 1 GPU")
    config = job.config
    on_ray = config.runtime.mode == "ray"
    num_gpus = _gpus(config, nodes, gpus_per_trial)
    num_roles = config.runtime.num_workers + OTHER_ROLES if on_ray else 1
    state_nodes, worker_nodes = nodes_for(nodes, STATE_RESOURCE), nodes_for(nodes, WORKER_RESOURCE)
    needs = ((nodes, num_roles), (state_nodes, 1), (worker_nodes, num_roles - 1))
    if cpus_per_trial is not None:
        # Ray counts in ten-thousandths of a core.
        role_cpus = max(int(cpus_per_trial / num_roles * 10_000) / 10_000, 0.0001)
    else:
        fitting = (s for s in SHARES if all(num_roles_that_fit(on, s) >= num for on, num in needs))
        role_cpus = next(fitting, SHARES[-1])
    return TrialResources(
        num_roles=num_roles,
        role_cpus=role_cpus,
        num_gpus=num_gpus,
        # Hub, learner and shards take a token each.
        state_token=TOKEN * (2 + config.replay.num_shards) if _offered(STATE_RESOURCE, nodes) else 0.0,
        worker_token=TOKEN * config.runtime.num_workers if on_ray and _offered(WORKER_RESOURCE, nodes) else 0.0,
        memory_bytes=_stored_bytes(job) + (num_roles * ROLE_BYTES if on_ray else LOCAL_BYTES),
    )


def fit_to_resources(config: RunConfig, resources: TrialResources) -> RunConfig:
    """The config with as many torch threads as the trial has cores, and no roles beyond its placement group."""
    threads = config.runtime.learner_threads or max(1, int(resources.role_cpus))
    runtime = replace(config.runtime, learner_threads=threads, auto_workers=False, inference="worker")
    return replace(config, runtime=runtime)


def num_that_fit(resources: TrialResources, nodes: Nodes) -> int:
    """Trials that run at the same time, as far as the totals of the cluster and of its two kinds of nodes say."""
    if resources.num_gpus and not any("GPU" in node for node in nodes):
        return 0
    bundles = resources.bundles
    if not all(any(_holds(node, bundle) for node in nodes) for bundle in bundles):
        return 0
    for_state = bundles if len(bundles) == 1 else bundles[:2]
    for_workers = bundles[len(for_state) :]
    groups = ((nodes, bundles), (nodes_for(nodes, STATE_RESOURCE), for_state))
    groups += ((nodes_for(nodes, WORKER_RESOURCE), for_workers),) if resources.worker_token else ()
    return min((_num_on(on, asked) for on, asked in groups), default=0)


def check_fits(key: str, resources: TrialResources, nodes: Nodes) -> None:
    """Raise ``ValueError`` if the cluster, empty, has no room for a trial."""
    if num_that_fit(resources, nodes):
        return
    cores, memory = (sum(node.get(name, 0.0) for node in nodes) for name in ("CPU", "memory"))
    gpus = sum(node.get("GPU", 0.0) for node in nodes)
    raise ValueError(
        f"{key} asks for {resources.num_cpus:g} cores, {resources.num_gpus:g} GPUs and "
        f"{resources.memory_bytes / 1e9:.1f} GB of memory; the cluster has {cores:g}, {gpus:g} and {memory / 1e9:.1f} "
        "GB. Give --cpus-per-trial or --gpus-per-trial a smaller number, or set --replay.capacity lower"
    )


def _holds(node: Mapping[str, float], bundle: Mapping[str, float]) -> bool:
    """Whether a node, empty, has room for a bundle, which lies on one node; memory that it does not tell is enough."""
    return all(
        node.get(name, math.inf if name == "memory" else 0.0) + 1e-6 >= wanted for name, wanted in bundle.items()
    )


def _num_on(nodes: Nodes, bundles: Sequence[Mapping[str, float]]) -> int:
    """How often these bundles fit into the totals of some nodes; what no node tells is not counted."""
    needed = {name: sum(bundle.get(name, 0.0) for bundle in bundles) for name in ("CPU", "GPU", "memory")}
    totals = {name: sum(node.get(name, 0.0) for node in nodes) for name in needed if any(name in n for n in nodes)}
    return min((int(totals[name] / needed[name] + 1e-6) for name in totals if needed[name]), default=0)


def _whole_mib(num_bytes: int) -> float:
    return float(num_bytes // _MIB * _MIB)


def _stored_bytes(job: Job) -> int:
    """Frames in memory: replay, or the features that pre-training keeps."""
    config = job.config
    if job.kind == "trial":
        return replay_bytes(config, min(config.replay.capacity, config.schedule.total_steps))
    if job.kind == "encoder" and config.pretrain.train_backbone == "none":
        return config.schedule.random_steps * (config.env.image_size // 16) ** 2 * FEATURE_BYTES
    return 0


def _offered(resource: str, nodes: Nodes) -> bool:
    return any(resource in node for node in nodes)


def _gpus(config: RunConfig, nodes: Nodes, gpus_per_trial: float | None) -> float:
    if config.runtime.device == "cpu":
        return 0.0
    if gpus_per_trial is not None:
        return gpus_per_trial
    there = any(node.get("GPU", 0.0) > 0 for node in nodes)
    return 1.0 if there or config.runtime.device == "cuda" else 0.0
