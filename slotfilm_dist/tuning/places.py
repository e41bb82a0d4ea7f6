"""Where a trial's roles live: in its placement group on Ray, or all in the trial's own process."""

from collections.abc import Callable
from pathlib import Path

from slotfilm_dist.backend import Backend
from slotfilm_dist.cluster.backend import RayBackend
from slotfilm_dist.cluster.placement import Placement, infers_centrally
from slotfilm_dist.cluster.workforce import make_wrist_env
from slotfilm_dist.config import RunConfig
from slotfilm_dist.contracts import VectorEnv
from slotfilm_dist.tuning.resources import TrialResources

MakeBackend = Callable[[RunConfig, Path, TrialResources], Backend]
"""Builds a backend from a config, the run's directory, and what its placement group holds."""


def placed_backend(
    config: RunConfig,
    run: Path,
    resources: TrialResources,
    make_env: Callable[[RunConfig, bool], VectorEnv] = make_wrist_env,
) -> RayBackend:
    """`RayBackend` in a placement group: its roles ask for what the group holds, whatever else the cluster has.

    Args:
        config: the run.
        run: its directory, which every node must see.
        resources: what the group holds.
        make_env: builds an environment; a function at the top of a module.
    """
    return RayBackend(config, run, make_env, placement=placement_in_group(config, resources))


def placement_in_group(config: RunConfig, resources: TrialResources) -> Placement:
    """What the roles of a trial ask for.

    With a GPU, or on a node for state, the learner asks for no cores, although the group holds them: a worker may have
    come first and taken those that lie there, and the learner cannot live elsewhere.
    """
    gpus, cpus = resources.num_gpus, resources.role_cpus
    central = infers_centrally(config, gpu=gpus > 0)
    share = gpus / 2 if central else gpus
    return Placement(
        share_cpus=cpus,
        gpu=gpus > 0,
        learner_cpus=0.0 if gpus or resources.state_token else cpus,
        learner_gpus=share,
        central_inference=central,
        inference_gpus=share if central else 0.0,
    )


def make_backend(config: RunConfig, run: Path, resources: TrialResources) -> Backend:
    """The backend that `runtime.mode` names."""
    if config.runtime.mode == "ray":
        return placed_backend(config, run, resources)
    from slotfilm_dist.local import LocalBackend

    return LocalBackend(config)
