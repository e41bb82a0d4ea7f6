"""n-step returns against sums by hand: inside an episode, at its end, at a block's end, around the ring."""

import numpy as np
import pytest

from slotfilm_dist.config import RunConfig
from slotfilm_dist.replay.ring import RowRing
from slotfilm_dist.variants import apply_variant

GAMMA = 0.5


def drawn(ring: RowRing, count: int = 400) -> dict[int, dict[str, float]]:
    """What is drawn for each step, by its number."""
    (batch,) = ring.sample(np.random.default_rng(0), [count])
    steps = (batch.action[:, 0] * 1e6).round().astype(int)
    names = ("reward", "discount", "terminated", "truncated")
    return {
        int(step): {name: float(getattr(batch, name)[i]) for name in names}
        | {"next": float(batch.next_proprio[i, 0]), "next_goal": float(batch.next_goal[i, 0])}
        for i, step in enumerate(steps)
    }


def test_rewards_are_added_up_to_the_end_of_the_window_the_episode_or_the_block(schema, make_block):
    """Steps 0 to 7, step k rewarded 10 k; an episode ends with step 4, the block with step 7."""
    ring = RowRing(schema, 50, 8, n_step=3, gamma=GAMMA)
    ring.insert(make_block(0, 8, ends={4}))
    found = drawn(ring)
    assert sorted(found) == list(range(8))
    # The whole window: 0 + 10/2 + 20/4, then the value of frame 3 counts an eighth.
    assert found[0] == {
        "reward": 10.0, "discount": 0.125, "terminated": 0, "truncated": 0, "next": 3.0, "next_goal": 1003.0,
    }  # fmt: skip
    # A window that holds the episode's last step ends there, with the true last frame.
    assert found[2]["reward"] == 20 + 30 / 2 + 40 / 4
    assert (found[2]["discount"], found[2]["truncated"], found[2]["next"]) == (0.125, 1, 4.5)
    assert found[3]["reward"] == 30 + 40 / 2
    assert (found[3]["discount"], found[3]["truncated"], found[3]["next"]) == (0.25, 1, 4.5)
    assert found[4]["reward"] == 40
    assert (found[4]["discount"], found[4]["truncated"], found[4]["next"]) == (0.5, 1, 4.5)
    # At the block's end the sum is shorter, and nothing ended.
    assert found[6]["reward"] == 60 + 70 / 2
    assert (found[6]["discount"], found[6]["truncated"], found[6]["next"]) == (0.25, 0, 8.0)
    assert (found[7]["reward"], found[7]["discount"], found[7]["next"]) == (70, 0.5, 8.0)


def test_termination_inside_the_window_is_the_transition_s(schema, make_block, altered):
    block = make_block(0, 6, ends={3})
    ring = RowRing(schema, 50, 8, n_step=3, gamma=GAMMA)
    ring.insert(altered(block, terminated=block.truncated, truncated=block.terminated))
    found = drawn(ring)
    assert [found[k]["terminated"] for k in range(6)] == [0, 1, 1, 1, 0, 0]
    assert not any(f["truncated"] for f in found.values())
    assert found[1]["reward"] == 10 + 20 / 2 + 30 / 4


def test_windows_are_right_all_around_the_ring(schema, make_block):
    ring = RowRing(schema, 12, 4, n_step=3, gamma=GAMMA)
    for first in range(0, 200, 4):
        ring.insert(make_block(first, 4))
        for step, values in drawn(ring, 60).items():
            length = min(3, 4 - step % 4)
            assert values["reward"] == sum(10 * (step + i) * GAMMA**i for i in range(length))
            assert values["discount"] == GAMMA**length
            assert values["next"] == step + length


def test_one_step_is_as_if_there_were_no_windows(schema, make_block):
    plain, one = RowRing(schema, 40, 8), RowRing(schema, 40, 8, n_step=1, gamma=0.9)
    for first in range(0, 80, 8):
        for ring in (plain, one):
            ring.insert(make_block(first, 8, ends={first + 3}))
    a, b = (ring.sample(np.random.default_rng(1), [30, 0, 7]) for ring in (plain, one))
    for before, after in zip(a, b, strict=True):
        for name in ("visual", "proprio", "goal", "action", "reward", "terminated", "truncated", "next_visual"):
            np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
        np.testing.assert_array_equal(after.discount, np.full(len(after.reward), 0.9, np.float32))
        assert after.reward.dtype == np.float32


def test_only_the_algorithm_with_n_step_returns_joins_steps(schema):
    assert RunConfig().n_step == 1
    assert apply_variant("drq", RunConfig()).n_step == 1
    assert apply_variant("drqv2", RunConfig()).n_step == 3
    with pytest.raises(ValueError, match="n_step = 0"):
        RowRing(schema, 1, n_step=0)
