"""Made-up transitions with the shapes and types of the paper's, for measurements that need no environment."""

import numpy as np

from slotfilm_dist.config import RunConfig
from slotfilm_dist.messages import SampleBatch, TransitionBlock

ACTION_DIM = 7
BACKBONE = "bench"
"""Hash that the tokens carry."""
TOKEN_SHAPE = (64, 42)


def token_batch(rng: np.random.Generator, size: int, config: RunConfig) -> SampleBatch:
    """Random tokens, states, actions and rewards."""
    tokens, after = (rng.normal(size=(size, *TOKEN_SHAPE)).astype(np.float16) for _ in range(2))
    return _batch(rng, tokens, after, config)


def image_batch(rng: np.random.Generator, size: int, config: RunConfig) -> SampleBatch:
    """As `token_batch`, with pictures."""
    shape = (size, config.env.image_size, config.env.image_size, 3)
    pictures, after = (rng.integers(0, 256, shape, np.uint8) for _ in range(2))
    return _batch(rng, pictures, after, config)


def token_block(rng: np.random.Generator, worker: int, sequence: int, num_steps: int, proprio: int) -> TransitionBlock:
    """One worker's next steps, none of which ends an episode."""
    rows = num_steps + 1
    return TransitionBlock(
        worker_id=worker,
        incarnation=0,
        sequence=sequence,
        policy_version=0,
        backbone_hash=BACKBONE,
        visual=rng.integers(0, 15_000, (rows, *TOKEN_SHAPE), np.uint16).view(np.float16),
        proprio=rng.random((rows, proprio), np.float32),
        goal=np.zeros((rows, 3), np.float32),
        uv=np.zeros((rows, 2, 2), np.float32),
        visible=np.zeros((rows, 2), bool),
        action=rng.random((rows, ACTION_DIM), np.float32),
        reward=np.zeros(rows, np.float32),
        terminated=np.zeros(rows, bool),
        truncated=np.zeros(rows, bool),
        is_step=np.arange(rows) < num_steps,
    )


def _batch(rng: np.random.Generator, visual: np.ndarray, after: np.ndarray, config: RunConfig) -> SampleBatch:
    size, state = len(visual), config.obs.state_dim
    proprio, next_proprio = (rng.normal(size=(size, state)).astype(np.float32) for _ in range(2))
    return SampleBatch(
        visual=visual,
        next_visual=after,
        proprio=proprio,
        next_proprio=next_proprio,
        goal=np.zeros((size, 3), np.float32),
        next_goal=np.zeros((size, 3), np.float32),
        action=rng.uniform(-1, 1, (size, ACTION_DIM)).astype(np.float32),
        reward=rng.uniform(0, 1, size).astype(np.float32),
        discount=np.full(size, config.sac.gamma, np.float32),
        terminated=np.zeros(size, bool),
        truncated=np.zeros(size, bool),
    )
