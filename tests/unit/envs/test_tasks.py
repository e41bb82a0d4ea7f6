"""Descriptions of tasks, and what follows from them for a config."""

from dataclasses import replace

import pytest

from slotfilm_dist.config import EnvConfig, RunConfig
from slotfilm_dist.envs.tasks import TASKS, adapt_config, check_goal, task_named
from slotfilm_dist.variants import apply_variant


def config_of(task: str, **fields: int) -> RunConfig:
    return RunConfig(env=EnvConfig(task=task, **fields))


def test_unknown_task_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(ValueError, match=r"env\.task = 'PickBanana-v2'.*did you mean 'PickBanana-v1'"):
        task_named("PickBanana-v2")
    with pytest.raises(ValueError, match="known: PickBanana-v1, PickCube-v1, StackCube-v1"):
        task_named("zzz")


def test_default_task_leaves_the_default_config_alone() -> None:
    assert adapt_config(RunConfig()) == RunConfig()


@pytest.mark.parametrize("name", list(TASKS))
def test_config_follows_from_the_task(name: str) -> None:
    config = adapt_config(config_of(name))
    task = TASKS[name]
    assert config.obs.num_objects == len(task.objects) == config.encoder.num_slots
    assert config.env.max_steps == task.max_steps
    assert config.obs.state_dim == 35


def test_what_the_user_chose_stays() -> None:
    config = config_of("PickCube-v1", max_steps=30)
    config = adapt_config(replace(config, encoder=replace(config.encoder, num_slots=5)))
    assert (config.env.max_steps, config.encoder.num_slots) == (30, 5)


@pytest.mark.parametrize(("name", "poses"), [("PickBanana-v1", 2), ("PickCube-v1", 1), ("StackCube-v1", 2)])
def test_oracle_state_counts_the_tasks_objects(name: str, poses: int) -> None:
    config = apply_variant("oracle_state", adapt_config(config_of(name)))
    assert config.obs.state_dim == 35 + 7 * poses + 6
    assert adapt_config(config) == config


def test_object_poses_are_recounted_when_the_number_of_objects_changes() -> None:
    config = apply_variant("oracle_state", RunConfig())
    adapted = adapt_config(replace(config, env=EnvConfig(task="PickCube-v1")))
    assert adapted.obs.state_dim == config.obs.state_dim - 7


def test_goal_query_needs_a_task_with_a_goal() -> None:
    config = config_of("StackCube-v1")
    check_goal(config)
    with pytest.raises(ValueError, match=r"encoder\.goal = True: StackCube-v1 has no goal.*leave --encoder\.goal"):
        check_goal(replace(config, encoder=replace(config.encoder, goal=True)))
    check_goal(apply_variant("slotfilm_goal", config_of("PickCube-v1")))
