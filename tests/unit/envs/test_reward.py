"""The paper's reward against numbers computed by hand."""

import math
from dataclasses import replace
from math import exp
from typing import Any

import numpy as np
import pytest
import torch

from slotfilm_dist.config import RewardConfig, RewardWeights, SuccessConfig
from slotfilm_dist.envs.reward import (
    TERMS,
    RewardInputs,
    RewardTerms,
    num_reward_inputs,
    progress,
    reward_inputs,
    reward_terms,
    rewards_of,
    shaped,
)
from slotfilm_dist.envs.reward_bounds import largest_terms, max_reward
from slotfilm_dist.envs.scene import SceneState

DEFAULT = RewardConfig()
RAW = replace(DEFAULT, normalize="none", weights=RewardWeights(place=1.0))


def scene(
    *,
    to_tcp: float = 0.3,
    to_goal: float = 0.2,
    grasped: bool = False,
    speeds: tuple[float, ...] = (0.0,) * 9,
) -> SceneState:
    """The object at the origin, the tool that far away along x and the goal along y."""
    return SceneState(
        qpos=torch.zeros(1, 9),
        qvel=torch.tensor([speeds]),
        tcp_pose=torch.tensor([[to_tcp, 0, 0, 1, 0, 0, 0]]),
        tcp_twist=torch.zeros(1, 6),
        object_poses=torch.tensor([[[0.0, 0, 0, 1, 0, 0, 0], [9.0, 9, 9, 1, 0, 0, 0]]]),
        goal=torch.tensor([[0.0, to_goal, 0.0]]),
        grasped=torch.tensor([grasped]),
        contact=torch.tensor([grasped]),
    )


def terms(config: RewardConfig, **state: Any) -> RewardTerms:
    here = scene(**state)
    return reward_terms(reward_inputs(here, progress(here, config, SuccessConfig())), config)


def near(value: torch.Tensor, expected: float) -> bool:
    return abs(float(value) - expected) < 1e-6


def test_far_from_everything_only_reaching_counts() -> None:
    found = terms(RAW)
    assert near(found.reach, math.exp(-10 * 0.3))
    assert [float(x) for x in (found.grasp, found.place, found.post_grasp, found.static)] == [0, 0, 0, 0]


def test_holding_far_from_the_goal() -> None:
    found = terms(RAW, to_tcp=0.01, to_goal=0.2, grasped=True)
    assert near(found.reach, 1 / (1 + 0.01 + 1e-5))
    assert near(found.grasp, 1.0)
    assert near(found.place, math.exp(-2))
    assert near(found.post_grasp, 1 - math.exp(-2))
    assert near(found.static, 0.0)


def test_holding_at_the_goal_rewards_stillness_by_the_arms_speed() -> None:
    found = terms(RAW, to_tcp=0.0, to_goal=0.02, grasped=True, speeds=(0.03, 0.04, 0, 0, 0, 0, 0, 0.7, 0.7))
    assert near(found.place, 1 / (1 + 0.02 + 1e-5))
    assert near(found.post_grasp, 1 - math.exp(-0.2))
    assert near(found.static, 1 - math.tanh(5 * 0.05))


@pytest.mark.parametrize(
    ("fields", "speed"),
    [
        ({"static_norm": "max"}, 0.04),
        ({"static_joints": "all"}, math.sqrt(0.03**2 + 0.04**2 + 2 * 0.7**2)),
        ({"static_joints": "all", "static_norm": "max"}, 0.7),
        ({"varpi": 1.0}, 0.01),
    ],
)
def test_static_term_reads_the_speed_it_is_told_to(fields: dict[str, Any], speed: float) -> None:
    found = terms(replace(RAW, **fields), to_goal=0.02, speeds=(0.03, 0.04, 0, 0, 0, 0, 0, 0.7, 0.7))
    assert near(found.static, 1 - math.tanh(5 * speed))


def test_weights_are_divided_by_their_sum() -> None:
    found = terms(DEFAULT, to_tcp=0.3, to_goal=0.2, grasped=True)
    assert near(found.reach, math.exp(-3) / 6)
    assert near(found.grasp, 1 / 6)
    assert near(found.place, 2 * math.exp(-2) / 6)
    assert near(found.total(), (math.exp(-3) + 1 + 2 * math.exp(-2) + 1 - math.exp(-2)) / 6)


def test_reward_lies_between_0_and_1_and_is_the_sum_of_its_terms() -> None:
    generator = torch.Generator().manual_seed(0)
    for _ in range(300):
        distances = torch.rand(2, generator=generator) ** 4
        found = terms(
            DEFAULT,
            to_tcp=float(distances[0]),
            to_goal=float(distances[1]),
            grasped=bool(torch.rand((), generator=generator) < 0.5),
            speeds=tuple(float(x) for x in torch.rand(9, generator=generator) * 0.2),
        )
        parts = [found.reach, found.grasp, found.place, found.post_grasp, found.static]
        assert all(0 <= float(part) <= 1 for part in parts)
        assert near(found.total(), sum(float(part) for part in parts))
        assert 0 <= float(found.total()) <= max_reward(DEFAULT) == 1.0


@pytest.mark.parametrize(
    ("form", "distance", "expected"),
    [
        ("bounded", 0.02, 1 / 1.02001),
        ("bounded", 0.025, 1 / 1.02501),
        ("bounded", 0.026, math.exp(-0.26)),
        ("inverse", 0.02, 10.0),
        ("inverse", 0.026, math.exp(-0.26)),
        ("exp_only", 0.02, math.exp(-0.2)),
        ("exp_only", 0.0, 1.0),
    ],
)
def test_distance_term_switches_form_at_delta(form: str, distance: float, expected: float) -> None:
    assert near(shaped(torch.tensor([distance]), replace(DEFAULT, near_form=form)), expected)


def test_inverse_form_without_effective_cap_is_the_printed_one() -> None:
    config = replace(DEFAULT, near_form="inverse", near_cap=1e6)
    assert abs(float(shaped(torch.tensor([0.02]), config)) - 1 / 0.02001) < 1e-3


@pytest.mark.parametrize(
    ("form", "expected"), [("one_minus_exp", 1 - math.exp(-2)), ("exp", math.exp(-0.2)), ("exp_alpha", math.exp(-2))]
)
def test_post_grasp_forms_count_only_while_grasped(form: str, expected: float) -> None:
    config = replace(RAW, pg_form=form)
    assert near(terms(config, grasped=True).post_grasp, expected)
    assert near(terms(config, grasped=False).post_grasp, 0.0)


def test_ungated_placing_counts_without_a_grasp() -> None:
    assert near(terms(replace(RAW, place_gate="none")).place, math.exp(-2))
    assert near(terms(RAW).place, 0.0)


def test_static_counts_only_in_the_target_region() -> None:
    assert near(terms(RAW, to_goal=0.025, grasped=True).static, 1.0)
    assert near(terms(RAW, to_goal=0.0251, grasped=True).static, 0.0)


def test_success_is_placed_and_still_and_released_where_asked() -> None:
    config = SuccessConfig()
    slow, fast = (0.19,) * 7 + (5.0, 5.0), (0.0,) * 6 + (-0.21,) + (0.0, 0.0)
    held = scene(to_goal=0.02, grasped=True, speeds=slow)
    assert bool(progress(held, DEFAULT, config).success)
    moving = progress(scene(to_goal=0.02, speeds=fast), DEFAULT, config)
    assert (bool(moving.placed), bool(moving.static), bool(moving.success)) == (True, False, False)
    assert bool(progress(scene(to_goal=0.02, speeds=fast), DEFAULT, replace(config, require_static=False)).success)
    assert not bool(progress(scene(to_goal=0.03, speeds=slow), DEFAULT, config).success)
    release = replace(config, require_release=True)
    assert not bool(progress(held, DEFAULT, release).success)
    assert bool(progress(scene(to_goal=0.02, speeds=slow), DEFAULT, release).success)


@pytest.mark.parametrize(
    ("fields", "bound"),
    [
        ({}, 1.0),
        ({"near_form": "inverse"}, (10 + 1 + 20 + 1 + 1) / 6),
        ({"normalize": "none"}, 6.0),
        # Just beyond delta, at 0.02 m, exp(-alpha d) is more than so low a cap.
        ({"near_form": "inverse", "near_cap": 0.1, "alpha": 5.0, "delta_m": 0.02}, (3 * exp(-0.1) + 3) / 6),
    ],
)
def test_upper_bound_of_the_reward(fields: dict[str, Any], bound: float) -> None:
    config = replace(DEFAULT, **fields)
    assert max_reward(config) == pytest.approx(bound)
    assert sum(largest_terms(config).values()) == pytest.approx(bound)


@pytest.mark.parametrize("form", ["bounded", "inverse", "exp_only"])
def test_components_come_up_to_their_largest_values_and_no_further(form: str) -> None:
    config = replace(DEFAULT, near_form=form)
    near, far = terms(config, to_tcp=0.0, to_goal=0.0, grasped=True), terms(config, to_goal=9.0, grasped=True)
    found = {name: float(getattr(near, name)) for name in ("reach", "grasp", "place", "static")}
    found["post_grasp"] = float(far.post_grasp)
    assert found == pytest.approx(largest_terms(config), rel=1e-4)


def drawn_inputs(count: int) -> RewardInputs:
    """Instants on both sides of every threshold."""
    generator = torch.Generator().manual_seed(3)
    return RewardInputs(
        object_to_tcp_m=torch.rand(count, generator=generator) * 0.1,
        object_to_goal_m=torch.rand(count, generator=generator) * 0.06,
        grasped=(torch.rand(count, generator=generator) < 0.5).float(),
        qvel=torch.randn(count, 9, generator=generator) * 0.2,
    )


@pytest.mark.parametrize(
    "config",
    [
        DEFAULT,
        replace(DEFAULT, alpha=5.0, near_form="inverse", pg_form="exp", place_gate="none"),
        replace(DEFAULT, varpi=1.0, static_norm="max", static_joints="all", pg_form="exp_alpha", normalize="none"),
        replace(DEFAULT, near_form="exp_only", weights=RewardWeights(static=0.0)),
    ],
)
def test_rewards_of_many_stored_steps_are_those_of_each_step_bit_for_bit(config: RewardConfig) -> None:
    packed = drawn_inputs(301).packed()
    alone = [float(reward_terms(RewardInputs.unpacked(row[None]), config).total()) for row in packed]
    assert rewards_of(packed.numpy(), config).tolist() == alone
    assert len(set(alone)) > 250


def test_packed_inputs_come_back_bit_for_bit_and_of_their_number() -> None:
    inputs = drawn_inputs(5)
    packed = inputs.packed()
    assert packed.shape == (5, num_reward_inputs(TERMS))
    back = RewardInputs.unpacked(packed)
    for name in ("object_to_tcp_m", "object_to_goal_m", "grasped", "qvel"):
        assert getattr(back, name).equal(getattr(inputs, name)), name
    with pytest.raises(ValueError, match="reward_inputs: 11 numbers a step, expected 12"):
        rewards_of(np.zeros((2, 11), np.float32), DEFAULT)


def test_environment_with_a_reward_of_its_own_stores_the_reward() -> None:
    assert num_reward_inputs(("reward",)) == num_reward_inputs(("reach",)) == 0
