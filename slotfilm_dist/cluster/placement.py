"""How much of the cluster each role asks for, decided before any of them starts."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from slotfilm_dist.config import RunConfig
from slotfilm_dist.replay.memory import check_memory, replay_bytes

SHARES = (1.0, 0.5, 0.25, 0.2, 0.1, 0.05, 0.02, 0.01)
"""Cores that a role may ask for. Below 1, roles share cores: a laptop runs everything, only slower."""
WORKER_RESOURCE = "slotfilm_worker"
"""Ray resource that nodes offer where workers shall run, such as spot machines; any node will do while none does."""
STATE_RESOURCE = "slotfilm_state"
"""Ray resource that nodes offer where hub, shards and learner shall run; any node will do while none does."""
TOKEN = 0.001
"""How much of such a resource a role takes: next to nothing, only to be there."""
OTHER_ROLES = 2
"""Roles beside the workers that ask for a share: the learner and an evaluation player. Hub and shards ask for none."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Placement:
    """What the roles ask Ray for."""

    share_cpus: float
    """Cores of each worker and of each player."""
    gpu: bool
    """The learner computes on a GPU."""
    learner_cpus: float
    """Cores of the learner."""
    learner_gpus: float
    """GPUs of the learner, also a part of one; 0 without."""
    central_inference: bool = False
    """One process acts for all workers."""
    inference_gpus: float = 0.0
    """GPUs of that process."""
    state_resources: Mapping[str, float] = field(default_factory=dict)
    """What roles ask for beside that hold what must not be lost: hub, shards, learner, central inference."""


def plan(config: RunConfig, nodes: Sequence[Mapping[str, float]]) -> Placement:
    """What each role asks for, so that all of them fit.

    Args:
        config: the run.
        nodes: resources of every live node.

    Raises:
        ValueError: the cluster has no GPU where one is asked for, too few cores, or too little memory for replay.
    """
    if memory := sum(node.get("memory", 0.0) for node in nodes):
        check_memory(config, int(memory))
        _check_shards(config, nodes_for(nodes, STATE_RESOURCE))
    num_gpus = sum(node.get("GPU", 0.0) for node in nodes)
    wants_gpu = config.runtime.device == "cuda"
    if wants_gpu and num_gpus < 1:
        raise ValueError(
            "runtime.device = 'cuda': no node of this Ray cluster has a GPU; use --runtime.device cpu or auto"
        )
    gpu = wants_gpu or (config.runtime.device == "auto" and num_gpus >= 1)
    central = infers_centrally(config, gpu=gpu)
    # The learner and central inference share the only GPU there is.
    gpu_share = 0.0 if not gpu else 0.5 if central and num_gpus < 2 else 1.0
    num_roles = config.runtime.num_workers + OTHER_ROLES + central
    cpus = [node.get("CPU", 0.0) for node in nodes]
    needs = (
        (nodes, num_roles),
        (nodes_for(nodes, WORKER_RESOURCE), config.runtime.num_workers),
        (nodes_for(nodes, STATE_RESOURCE), 1 + central),
    )
    for share in SHARES:
        if all(num_roles_that_fit(on, share) >= num for on, num in needs):
            return Placement(
                share_cpus=share,
                gpu=gpu,
                learner_cpus=share,
                learner_gpus=gpu_share,
                central_inference=central,
                inference_gpus=gpu_share if central else 0.0,
            )
    raise ValueError(
        f"runtime.num_workers = {config.runtime.num_workers}: this Ray cluster has {sum(cpus):g} cores; "
        f"it holds at most {max(0, math.floor(sum(cpus) / SHARES[-1]) - OTHER_ROLES)} workers"
    )


def _check_shards(config: RunConfig, nodes: Sequence[Mapping[str, float]]) -> None:
    """Raise ``ValueError`` if the shards, each on one node, find no room though their sum would."""
    steps, num_shards = min(config.replay.capacity, config.schedule.total_steps), config.replay.num_shards
    shard_bytes = replay_bytes(config, steps) / num_shards
    memory = [node.get("memory", 0.0) for node in nodes]
    if sum(int(each // shard_bytes) for each in memory) < num_shards:
        raise ValueError(
            f"replay.num_shards = {num_shards}: a shard takes {shard_bytes / 1e9:.1f} GB, and the nodes for it have "
            f"{', '.join(f'{each / 1e9:.1f}' for each in memory)} GB; set --replay.num_shards higher or "
            "--replay.capacity lower"
        )


def check_grown(nodes: Sequence[Mapping[str, float]]) -> None:
    """Raise ``ValueError`` while nodes that every run needs have yet to join; roles are placed once, at the start."""
    computing = [node for node in nodes if node.get("CPU", 0.0) > 0]
    if not computing:
        raise ValueError("no node of this Ray cluster has cores yet; `ray status` shows which nodes it has")
    if all(WORKER_RESOURCE in node and STATE_RESOURCE not in node for node in computing):
        raise ValueError(
            f"every node of this Ray cluster offers {WORKER_RESOURCE} and none {STATE_RESOURCE}, so that replay and "
            "learner would live on nodes that may go; `ray status` shows which nodes it has"
        )


def num_roles_that_fit(nodes: Sequence[Mapping[str, float]], share: float) -> int:
    """Roles that find so many cores each; a role's cores lie on one node."""
    return sum(math.floor(node.get("CPU", 0.0) / share + 1e-9) for node in nodes)


def nodes_for(nodes: Sequence[Mapping[str, float]], resource: str) -> Sequence[Mapping[str, float]]:
    """The nodes that offer a resource; all of them where none does."""
    return [node for node in nodes if resource in node] or nodes


def place(places: Sequence[Mapping[str, float]], resource: str) -> dict[str, float]:
    """What to ask for to be put where a resource is offered; nothing where none of these nodes or bundles does."""
    return {resource: TOKEN} if any(resource in offered for offered in places) else {}


def infers_centrally(config: RunConfig, *, gpu: bool) -> bool:
    """Whether one process acts for all workers: as the config says, else where it pays, on a GPU with pictures."""
    chosen = config.runtime.inference
    return chosen == "central" or (chosen == "auto" and gpu and config.encoder.uses_image)


def share_for_more(num_workers: int, available_cpus: float) -> float:
    """Cores that each further worker asks for; 0, which always fits, when the cores are taken."""
    return next((s for s in SHARES if s * num_workers <= available_cpus), 0.0)
