"""By how much each field of the state is shifted and divided before the networks see it (`obs.normalize_state`)."""

import numpy as np
from jaxtyping import Float, Float32

from slotfilm_dist.config import ObsConfig

SMALLEST_STD = 1e-2
"""Least deviation that the state is divided by: a field that barely moves at random may matter later."""
FLAGS = ("is_grasped",)
"""Fields of 0 or 1, left as they are: a random policy hardly ever grasps; by its deviation, a grasp would be 100."""


def state_scale(
    obs: ObsConfig, states: Float32[np.ndarray, "rows proprio"]
) -> tuple[Float[np.ndarray, " proprio"], Float[np.ndarray, " proprio"]]:
    """Mean and deviation by which the state is standardised, from the random policy's states."""
    mean = states.mean(axis=0, dtype=np.float64)
    std = np.maximum(states.std(axis=0, dtype=np.float64), SMALLEST_STD)
    first = 0
    for name in obs.state_fields:
        end = first + obs.field_dim(name)
        if name in FLAGS:
            mean[first:end], std[first:end] = 0.0, 1.0
        first = end
    return mean.astype(np.float32), std.astype(np.float32)
