"""How the state is standardised."""

import numpy as np

from slotfilm_dist.config import ObsConfig
from slotfilm_dist.learning.state_scale import SMALLEST_STD, state_scale

OBS = ObsConfig()
GRASPED = sum(OBS.field_dim(name) for name in OBS.state_fields[: OBS.state_fields.index("is_grasped")])


def test_a_grasp_that_random_never_made_enters_the_networks_as_one() -> None:
    states = np.random.default_rng(0).normal(3.0, 2.0, (500, OBS.state_dim)).astype(np.float32)
    states[:, GRASPED] = 0
    mean, std = state_scale(OBS, states)
    states[0, GRASPED] = 1
    standardised = (states - mean) / std
    assert standardised[0, GRASPED] == 1
    assert not standardised[1:, GRASPED].any()
    others = np.delete(standardised, GRASPED, axis=1)
    np.testing.assert_allclose(others.mean(axis=0), 0, atol=1e-4)
    np.testing.assert_allclose(others.std(axis=0), 1, atol=1e-4)


def test_a_field_that_hardly_moves_at_random_is_divided_by_a_least_deviation() -> None:
    states = np.zeros((10, OBS.state_dim), np.float32)
    _, std = state_scale(OBS, states)
    assert (np.delete(std, GRASPED) == np.float32(SMALLEST_STD)).all()
