"""What the roles of a trial ask for in their placement group."""

from dataclasses import replace

import pytest

from slotfilm_dist.presets import smoke
from slotfilm_dist.tuning.places import placement_in_group
from slotfilm_dist.tuning.resources import TrialResources

CONFIG = smoke()


def resources(num_gpus: float = 0.0) -> TrialResources:
    return TrialResources(num_roles=4, role_cpus=0.5, num_gpus=num_gpus, memory_bytes=1)


def test_every_role_gets_its_share_of_the_groups_cores() -> None:
    placement = placement_in_group(CONFIG, resources())
    assert (placement.share_cpus, placement.learner_cpus, placement.learner_gpus) == (0.5, 0.5, 0.0)
    assert not placement.gpu


def test_learner_on_a_gpu_takes_no_cores_which_a_worker_may_hold() -> None:
    config = replace(CONFIG, runtime=replace(CONFIG.runtime, inference="worker"))
    placement = placement_in_group(config, resources(num_gpus=0.5))
    assert (placement.share_cpus, placement.learner_cpus, placement.learner_gpus) == (0.5, 0.0, 0.5)
    assert placement.gpu


@pytest.mark.parametrize(("num_gpus", "each"), [(1.0, 0.5), (0.0, 0.0)])
def test_central_inference_shares_the_learners_gpu(num_gpus: float, each: float) -> None:
    config = replace(CONFIG, runtime=replace(CONFIG.runtime, inference="central"))
    placement = placement_in_group(config, resources(num_gpus))
    assert placement.central_inference
    assert placement.learner_gpus == placement.inference_gpus == each
