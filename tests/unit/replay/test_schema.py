from dataclasses import replace

import numpy as np
import pytest

from slotfilm_dist.config_files import from_dict, to_dict
from slotfilm_dist.replay.schema import ReplaySchema


def test_paper_row_takes_five_and_a_half_kilobytes():
    schema = ReplaySchema(
        visual_kind="tokens", visual_shape=(64, 42), proprio_dim=35, action_dim=7, num_objects=2, backbone_hash="x"
    )
    assert schema.row_bytes == 64 * 42 * 2 + 4 * (35 + 3 + 7 + 1) + 3
    assert replace(schema, store_labels=True).row_bytes == schema.row_bytes + 2 * 2 * 4 + 2


def test_schema_survives_json(schema):
    assert from_dict(ReplaySchema, to_dict(schema)) == schema
    with pytest.raises(ValueError, match="visual_kind = 'depth': must be one of tokens, rgb, none"):
        from_dict(ReplaySchema, to_dict(schema) | {"visual_kind": "depth"})


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("visual_shape", (4,)),
        ("visual_shape", (0, 42)),
        ("backbone_hash", ""),
        ("proprio_dim", 0),
        ("action_dim", -1),
        ("num_objects", 0),
    ],
)
def test_impossible_schema_is_refused_by_field(schema, field, value):
    with pytest.raises(ValueError, match=f"schema.{field}"):
        replace(schema, **{field: value})


def test_picture_schema_takes_no_backbone_and_three_channels(picture_schema):
    with pytest.raises(ValueError, match=r"schema\.backbone_hash"):
        replace(picture_schema, backbone_hash="x")
    with pytest.raises(ValueError, match=r"schema\.visual_shape"):
        replace(picture_schema, visual_shape=(4, 4, 4))


def test_valid_blocks_pass(schema, picture_schema, make_block):
    schema.validate(make_block(0, 5, ends=[2]))
    picture_schema.validate(make_block(0, 5, schema=picture_schema))
    blind = replace(picture_schema, visual_kind="none", visual_shape=(0,))
    blind.validate(replace(make_block(0, 5), backbone_hash="", visual=np.zeros((6, 0), np.float32)))


def test_rounding_beyond_the_action_range_passes(schema, make_block):
    block = make_block(0, 5)
    schema.validate(replace(block, action=np.full_like(block.action, 1 + 1e-6)))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("field", ["visual", "proprio", "goal", "action", "reward", "uv"])
def test_values_that_are_not_finite_are_refused_by_field_and_row(schema, make_block, field, bad):
    block = make_block(0, 5)
    getattr(block, field)[3, ...] = bad
    with pytest.raises(ValueError, match=rf"worker 0 .*: {field}: not finite.* in row 3"):
        schema.validate(block)


def test_position_of_an_invisible_object_may_be_anything(schema, make_block):
    block = make_block(0, 5)
    block.uv[2, 1] = np.nan
    block.visible[2, 1] = False
    schema.validate(block)


@pytest.mark.parametrize("field", ["visual", "proprio", "goal", "action", "uv", "visible", "terminated", "is_step"])
def test_wrong_shape_is_refused_by_field(schema, make_block, altered, field):
    block = make_block(0, 5)
    with pytest.raises(ValueError, match=f": {field}: shape"):
        schema.validate(altered(block, **{field: np.zeros((6, 9, 9), getattr(block, field).dtype)}))


@pytest.mark.parametrize("field", ["visual", "proprio", "action", "reward", "truncated"])
def test_wrong_type_is_refused_by_field(schema, make_block, altered, field):
    block = make_block(0, 5)
    with pytest.raises(ValueError, match=f": {field}: type float64"):
        schema.validate(altered(block, **{field: getattr(block, field).astype(np.float64)}))


def test_tokens_of_another_backbone_are_refused(schema, make_block):
    with pytest.raises(ValueError, match="backbone_hash: 'other'"):
        schema.validate(replace(make_block(0, 5), backbone_hash="other"))


def test_action_out_of_range_is_refused(schema, make_block):
    block = make_block(0, 5)
    block.action[1, 1] = -1.01
    with pytest.raises(ValueError, match=r"action: outside \[-1, 1\] in row 1"):
        schema.validate(block)


def test_step_without_its_next_frame_is_refused(schema, make_block):
    block = make_block(0, 5)
    block.is_step[-1] = True
    with pytest.raises(ValueError, match="is_step: the last row is a step"):
        schema.validate(block)


def test_next_frame_from_the_following_episode_is_refused(schema, make_block):
    block = make_block(0, 5)
    block.truncated[2] = True
    with pytest.raises(ValueError, match="its true last frame must come first"):
        schema.validate(block)


def test_end_of_an_episode_outside_a_step_is_refused(schema, make_block):
    block = make_block(0, 5)
    block.terminated[-1] = True
    with pytest.raises(ValueError, match="ends in a row without a step"):
        schema.validate(block)


def test_block_of_one_row_is_refused(schema, make_block, altered):
    block = make_block(0, 1)
    with pytest.raises(ValueError, match="1 rows"):
        schema.validate(altered(block, reward=block.reward[:1]))
