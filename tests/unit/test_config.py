"""The config: what it refuses, how it is written and read back, what its hash sees."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from slotfilm_dist.config import EncoderConfig, EnvConfig, LrConfig, ObsConfig, RewardWeights, RunConfig, SacConfig
from slotfilm_dist.config_files import changed_fields, config_hash, from_dict, load_config, save_config, to_dict
from slotfilm_dist.presets import PRESETS


def with_value(path: str, value: Any) -> dict[str, Any]:
    """The default config as plain values with one of them changed."""
    values = to_dict(RunConfig())
    *sections, name = path.split(".")
    owner = values
    for section in sections:
        owner = owner[section]
    owner[name] = value
    return values


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("env.image_size", 100),
        ("env.image_size", 16),
        ("env.max_steps", 0),
        ("env.fov_deg", 180.0),
        ("env.far_m", 0.001),
        ("obs.state_dim", 34),
        ("reward.alpha", -1.0),
        ("encoder.num_heads", 4),
        ("encoder.feature_dim", 43),
        ("encoder.num_slots", 1),
        ("pretrain.holdout", 1.0),
        ("pretrain.lambda_pos", -0.1),
        ("lr.actor", 0.0),
        ("lr.actor", float("nan")),
        ("lr.actor", float("inf")),
        ("sac.gamma", 1.0),
        ("sac.gamma", float("nan")),
        ("sac.tau", 0.0),
        ("sac.hidden", []),
        ("sac.hidden", [256, 0]),
        ("sac.log_std_min", 3.0),
        ("replay.min_steps", 1_200_000),
        ("schedule.random_steps", 1_200_000),
        ("schedule.updates_per_step", 0.0),
        ("evaluation.seed", 5),
        ("evaluation.episodes", 0),
        ("runtime.num_workers", 0),
        ("checkpoint.keep", 0),
        ("seed", -1),
        ("seed", 2**31),
    ],
)
def test_impossible_value_is_refused_by_the_fields_name(path: str, value: Any) -> None:
    with pytest.raises(ValueError, match=path.replace(".", r"\.")):
        from_dict(RunConfig, with_value(path, value))


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("sac.gama", 0.9, r"unknown field 'sac\.gama'; did you mean 'sac\.gamma'\?"),
        ("sac.gamma", "high", r"sac\.gamma = 'high': must be a float"),
        ("sac.batch_size", 1.5, r"sac\.batch_size = 1\.5: must be an int"),
        ("sac.batch_size", True, r"sac\.batch_size = True"),
        ("env.goal_visible", 1, r"env\.goal_visible = 1: must be a bool"),
        ("env.goal", "bowl", r"env\.goal = 'bowl': must be one of near_bowl, fixed, random"),
        ("sac", 3, r"sac = 3: must be a section"),
        ("sac.hidden", 256, r"sac\.hidden = 256: must be a list"),
        ("obs.state_fields", ["qpso"], r"unknown field 'qpso'; did you mean 'qpos'"),
    ],
)
def test_unknown_key_and_wrong_type_are_refused_in_one_sentence(path: str, value: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message) as error:
        from_dict(RunConfig, with_value(path, value))
    assert "\n" not in str(error.value)


def test_state_dim_is_checked_against_the_fields() -> None:
    with pytest.raises(ValueError, match=r"add up to 18; set obs\.state_dim = 18"):
        ObsConfig(state_fields=("qpos", "qvel"))
    with pytest.raises(ValueError, match=r"obs\.state_dim"):
        ObsConfig(state_fields=(), state_dim=0)
    assert ObsConfig(state_fields=("object_poses",), state_dim=21, num_objects=3).field_dim("object_poses") == 21


def test_weights_may_not_all_be_zero() -> None:
    with pytest.raises(ValueError, match=r"reward\.weights"):
        RewardWeights(reach=0, grasp=0, place=0, post_grasp=0, static=0)


def test_file_of_weights_is_needed_where_it_is_asked_for() -> None:
    with pytest.raises(ValueError, match=r"encoder\.backbone_path.*needs a file"):
        EncoderConfig(backbone="path")


@pytest.mark.parametrize("name", list(PRESETS))
def test_config_survives_its_file(tmp_path: Path, name: str) -> None:
    config = replace(PRESETS[name](), seed=7)
    save_config(config, tmp_path / "config.json")
    assert load_config(tmp_path / "config.json") == config


@pytest.mark.parametrize(
    "content", ["", "{", "[]", "3", "null", '{"sac": []}', '{"variant": 3}', '{"seeed": 1}', "\x00"]
)
def test_corrupt_file_is_refused_by_its_name(tmp_path: Path, content: str) -> None:
    path = tmp_path / "config.json"
    path.write_text(content)
    with pytest.raises(ValueError, match=r"config\.json"):
        load_config(path)


def test_file_of_an_older_version_with_a_field_that_nothing_read_is_taken(tmp_path: Path) -> None:
    values = to_dict(RunConfig())
    values["sac"]["train_heads"] = False
    (tmp_path / "config.json").write_text(json.dumps(values))
    assert load_config(tmp_path / "config.json") == RunConfig()


def test_bytes_that_are_no_text_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "config.json"
    with pytest.raises(ValueError, match=r"does not exist; a run directory has a config\.json"):
        load_config(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="not valid JSON"):
        load_config(path)


def test_whole_numbers_are_taken_for_floats_and_stay_equal() -> None:
    config = from_dict(RunConfig, with_value("lr.actor", 1))
    assert config.lr.actor == 1.0
    assert isinstance(config.lr.actor, float)


def test_hash_follows_every_value_and_only_values() -> None:
    assert config_hash(SacConfig()) == config_hash(from_dict(SacConfig, json.loads(json.dumps(to_dict(SacConfig())))))
    assert len({config_hash(SacConfig()), config_hash(SacConfig(gamma=0.98)), config_hash(LrConfig())}) == 3
    assert config_hash(EnvConfig(), 3) != config_hash(EnvConfig(), 4)


def test_changed_fields_are_dotted() -> None:
    other = replace(RunConfig(), seed=3, sac=SacConfig(gamma=0.5))
    assert changed_fields(RunConfig(), other) == {"seed": (0, 3), "sac.gamma": (0.99, 0.5)}
