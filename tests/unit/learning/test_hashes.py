"""What names data and encoders: all that they depend on, and nothing else."""

from dataclasses import replace
from pathlib import Path

import pytest

from slotfilm_dist.commands.options import with_weights_file
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


def test_encoder_is_named_by_what_its_file_of_initial_weights_holds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    path = tmp_path / "resnet.safetensors"
    encoder = replace(RunConfig().encoder, backbone="path", backbone_path=str(path))
    config = replace(RunConfig(), encoder=encoder)
    path.write_bytes(b"some weights")
    first = with_weights_file(config)
    path.write_bytes(b"other weights")
    second = with_weights_file(config)
    assert pretrain_hash(first) != pretrain_hash(second)
    with pytest.raises(ValueError, match=r"is not the file that encoder\.backbone_sha256 names"):
        with_weights_file(first)


def test_data_and_encoder_follow_the_length_of_random_episodes() -> None:
    plain = RunConfig()
    short = replace(plain, schedule=replace(plain.schedule, random_episode_steps=32))
    assert dataset_hash(short) != dataset_hash(plain)
    assert pretrain_hash(short) != pretrain_hash(plain)
