"""What roles ask of a cluster, decided on the nodes' resources alone."""

from dataclasses import replace

import pytest

from slotfilm_dist.cluster.placement import (
    STATE_RESOURCE,
    WORKER_RESOURCE,
    check_grown,
    infers_centrally,
    num_roles_that_fit,
    place,
    plan,
)
from slotfilm_dist.config import RunConfig
from slotfilm_dist.presets import cluster, smoke
from slotfilm_dist.variants import apply_variant


def config_with(**runtime: object) -> RunConfig:
    base = smoke()
    return replace(base, runtime=replace(base.runtime, mode="ray", **runtime))


def test_every_role_gets_a_core_where_there_are_enough_and_a_share_where_not() -> None:
    config = config_with(num_workers=2)
    assert plan(config, [{"CPU": 4.0}]).share_cpus == 1.0
    assert plan(config, [{"CPU": 2.0}]).share_cpus == 0.5
    assert plan(config, [{"CPU": 1.0}, {"CPU": 1.0}]).share_cpus == 0.5


def test_too_few_cores_are_refused_with_the_number_that_fits() -> None:
    with pytest.raises(ValueError, match=r"runtime\.num_workers = 500: .* has 2 cores; it holds at most 198 workers"):
        plan(config_with(num_workers=500), [{"CPU": 2.0}])


def test_cores_count_only_where_a_role_may_run() -> None:
    config = config_with(num_workers=4)
    assert plan(config, [{"CPU": 2.0}, {"CPU": 4.0}]).share_cpus == 1.0
    spot = [{"CPU": 6.0, STATE_RESOURCE: 1.0}, {"CPU": 2.0, WORKER_RESOURCE: 1.0}]
    assert plan(config, spot).share_cpus == 0.5  # four workers on two cores


@pytest.mark.parametrize(
    ("inference", "gpu", "variant", "central"),
    [
        ("auto", True, "slotfilm", True),
        ("auto", False, "slotfilm", False),
        ("auto", True, "state_only", False),
        ("central", False, "slotfilm", True),
        ("worker", True, "slotfilm", False),
    ],
)
def test_inference_is_central_where_a_gpu_sees_pictures_or_where_asked_for(
    inference: str, gpu: bool, variant: str, central: bool
) -> None:
    config = apply_variant(variant, config_with(inference=inference))
    assert infers_centrally(config, gpu=gpu) == central


@pytest.mark.parametrize(("gpus", "learner", "inference"), [(1.0, 0.5, 0.5), (2.0, 1.0, 1.0)])
def test_learner_and_central_inference_share_the_only_gpu(gpus: float, learner: float, inference: float) -> None:
    placement = plan(config_with(num_workers=2), [{"CPU": 8.0, "GPU": gpus}])
    assert (placement.learner_gpus, placement.inference_gpus) == (learner, inference)
    alone = plan(config_with(num_workers=2, inference="worker"), [{"CPU": 8.0, "GPU": gpus}])
    assert (alone.learner_gpus, alone.inference_gpus) == (1.0, 0.0)


def test_role_finds_its_cores_on_one_node() -> None:
    assert num_roles_that_fit([{"CPU": 1.5}, {"CPU": 1.5}, {"memory": 1.0}], 1.0) == 2
    assert num_roles_that_fit([{"CPU": 1.5}, {"CPU": 1.5}], 0.5) == 6


def test_nodes_are_asked_for_by_their_resource_only_while_one_offers_it() -> None:
    nodes = [{"CPU": 2.0}, {"CPU": 2.0, WORKER_RESOURCE: 1.0}]
    assert list(place(nodes, WORKER_RESOURCE)) == [WORKER_RESOURCE]
    assert place(nodes[:1], WORKER_RESOURCE) == {}


@pytest.mark.parametrize(
    ("nodes", "sentence"),
    [
        ([{"memory": 1e9}], "no node of this Ray cluster has cores yet"),
        ([{"memory": 1e9}, {"CPU": 16.0, WORKER_RESOURCE: 1.0}], "replay and learner would live on nodes that may go"),
    ],
)
def test_cluster_whose_nodes_have_yet_to_join_is_refused(nodes: list[dict[str, float]], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        check_grown(nodes)
    check_grown([*nodes, {"CPU": 4.0, STATE_RESOURCE: 1.0}])
    check_grown([*nodes, {"CPU": 4.0}])


def test_shard_must_fit_onto_one_node_not_onto_the_sum_of_all() -> None:
    config = apply_variant("cnn", cluster())
    nodes = [{"CPU": 16.0, "memory": memory * 1e9} for memory in (34, 26, 20)]
    assert plan(config, nodes).share_cpus > 0
    with pytest.raises(ValueError, match=r"replay\.num_shards = 2: a shard takes 25\.\d GB, .* 34\.0, 20\.0, 20\.0 GB"):
        plan(config, [{"CPU": 16.0, "memory": memory * 1e9} for memory in (34, 20, 20)])
