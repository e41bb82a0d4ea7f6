"""What names data and encoders: all that they depend on, and nothing else."""

from dataclasses import replace

from slotfilm_dist.config import RunConfig
from slotfilm_dist.learning.learner import dataset_hash, pretrain_hash


def with_radius(config: RunConfig, delta_m: float) -> RunConfig:
    return replace(config, reward=replace(config.reward, delta_m=delta_m))


def test_encoder_is_named_by_the_targets_radius_only_where_pictures_depend_on_it() -> None:
    plain = RunConfig()
    assert pretrain_hash(with_radius(plain, 0.05)) == pretrain_hash(plain)
    for field in ("goal_visible", "terminate_on_success"):
        config = replace(plain, env=replace(plain.env, **{field: True}))
        assert pretrain_hash(with_radius(config, 0.05)) != pretrain_hash(config)
    ending = replace(plain, env=replace(plain.env, terminate_on_success=True))
    easier = replace(ending, success=replace(ending.success, require_static=False))
    assert pretrain_hash(easier) != pretrain_hash(ending)


def test_data_and_encoder_follow_the_length_of_random_episodes() -> None:
    plain = RunConfig()
    short = replace(plain, schedule=replace(plain.schedule, random_episode_steps=32))
    assert dataset_hash(short) != dataset_hash(plain)
    assert pretrain_hash(short) != pretrain_hash(plain)
