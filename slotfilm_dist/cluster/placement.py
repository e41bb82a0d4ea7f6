"""How much of the cluster each role asks for, decided before any of them starts."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from slotfilm_dist.config import RunConfig
from slotfilm_dist.replay.memory import check_memory

SHARES = (1.0, 0.5, 0.25, 0.2, 0.1, 0.05, 0.02, 0.01)
"""Cores that a role may ask for. Below 1, roles share cores: a laptop runs everything, only slower."""
OTHER_ROLES = 2
"""Roles beside the workers that ask for a share: the learner and an evaluation player. Hub and shards ask for none."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Placement:
    """What the roles ask Ray for."""

    share_cpus: float
    """Cores of each worker, of the learner and of each player."""
    gpu: bool
    """The learner gets a GPU."""


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
    num_gpus = sum(node.get("GPU", 0.0) for node in nodes)
    wants_gpu = config.runtime.device == "cuda"
    if wants_gpu and num_gpus < 1:
        raise ValueError(
            "runtime.device = 'cuda': no node of this Ray cluster has a GPU; use --runtime.device cpu or auto"
        )
    num_roles = config.runtime.num_workers + OTHER_ROLES
    cpus = [node.get("CPU", 0.0) for node in nodes]
    for share in SHARES:
        if sum(math.floor(c / share + 1e-9) for c in cpus) >= num_roles:
            return Placement(share_cpus=share, gpu=wants_gpu or (config.runtime.device == "auto" and num_gpus >= 1))
    raise ValueError(
        f"runtime.num_workers = {config.runtime.num_workers}: this Ray cluster has {sum(cpus):g} cores; "
        f"it holds at most {max(0, math.floor(sum(cpus) / SHARES[-1]) - OTHER_ROLES)} workers"
    )


def share_for_more(num_workers: int, available_cpus: float) -> float:
    """Cores that each further worker asks for; 0, which always fits, when the cores are taken."""
    return next((s for s in SHARES if s * num_workers <= available_cpus), 0.0)
