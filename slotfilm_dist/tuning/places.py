"""Where a trial's roles live: in its placement group on Ray, or all in the trial's own process."""

from collections.abc import Callable, Mapping
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


class PlacedBackend(RayBackend):
    """`RayBackend` in a placement group: its roles ask for what the group holds, whatever else the cluster has.

    Args:
        config: the run.
        run: its directory, which every node must see.
        resources: what the group holds.
        make_env: builds an environment; a function at the top of a module.
    """

    def __init__(
        self,
        config: RunConfig,
        run: Path,
        resources: TrialResources,
        make_env: Callable[[RunConfig, bool], VectorEnv] = make_wrist_env,
    ) -> None:
        self._resources = resources
        self._state_resources: Mapping[str, float] = {}
        super().__init__(config, run, make_env)

    @property
    def _placement(self) -> Placement:
        """What the roles ask for.

        With a GPU the learner asks for no cores, although the group holds them: a worker may have come first and taken
        those that lie beside the GPU, and the learner cannot live elsewhere.
        """
        gpus, cpus = self._resources.num_gpus, self._resources.role_cpus
        central = infers_centrally(self._config, gpu=gpus > 0)
        share = gpus / 2 if central else gpus
        return Placement(
            share_cpus=cpus,
            gpu=gpus > 0,
            learner_cpus=0.0 if gpus else cpus,
            learner_gpus=share,
            central_inference=central,
            inference_gpus=share if central else 0.0,
            state_resources=self._state_resources,
        )

    @_placement.setter
    def _placement(self, of_the_cluster: Placement) -> None:
        """What the cluster as a whole could give is not this trial's, but for where roles with state belong."""
        self._state_resources = of_the_cluster.state_resources


def make_backend(config: RunConfig, run: Path, resources: TrialResources) -> Backend:
    """The backend that `runtime.mode` names."""
    if config.runtime.mode == "ray":
        return PlacedBackend(config, run, resources)
    from slotfilm_dist.local import LocalBackend

    return LocalBackend(config)
