"""Blocks of recognisable values: step k has action = k / 1e6, reward = 10 k and frames that say k and k + 1."""

import copy
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from slotfilm_dist.messages import TransitionBlock
from slotfilm_dist.replay.schema import ReplaySchema

TOKEN_SHAPE = (2, 2)
MakeBlock = Callable[..., TransitionBlock]


@pytest.fixture
def schema() -> ReplaySchema:
    return ReplaySchema(
        visual_kind="tokens",
        visual_shape=TOKEN_SHAPE,
        proprio_dim=3,
        action_dim=2,
        num_objects=2,
        store_labels=True,
        backbone_hash="b",
    )


@pytest.fixture
def picture_schema() -> ReplaySchema:
    return ReplaySchema(
        visual_kind="rgb", visual_shape=(4, 4, 3), proprio_dim=3, action_dim=2, num_objects=2, store_labels=True
    )


@pytest.fixture
def make_block() -> MakeBlock:
    return _make_block


@pytest.fixture
def altered() -> Callable[..., TransitionBlock]:
    """A block with fields of any shape or type, as another version of the code might send it."""

    def altered(block: TransitionBlock, **values: object) -> TransitionBlock:
        block = copy.copy(block)
        for name, value in values.items():
            object.__setattr__(block, name, value)
        return block

    return altered


def _make_block(
    first_step: int,
    num_steps: int,
    *,
    worker_id: int = 0,
    incarnation: int = 0,
    sequence: int = 0,
    ends: Sequence[int] = (),
    schema: ReplaySchema | None = None,
) -> TransitionBlock:
    """Steps first_step, first_step + 1, ...; an episode is cut by time after each step in `ends`."""
    frames: list[float] = []
    is_step: list[bool] = []
    truncated: list[bool] = []
    for step in range(first_step, first_step + num_steps):
        frames.append(step)
        is_step.append(True)
        truncated.append(step in ends)
        if step in ends or step == first_step + num_steps - 1:
            frames.append(step + 0.5 if step in ends else step + 1)
            is_step.append(False)
            truncated.append(False)
    frame = np.array(frames, np.float32)
    rows = len(frame)
    step_number = np.where(is_step, frame, 0).astype(np.float32)
    kind = schema.visual_kind if schema else "tokens"
    shape = schema.visual_shape if schema else TOKEN_SHAPE
    dtype = np.float16 if kind == "tokens" else np.uint8
    return TransitionBlock(
        worker_id=worker_id,
        incarnation=incarnation,
        sequence=sequence,
        policy_version=7,
        backbone_hash="b" if kind == "tokens" else "",
        visual=np.broadcast_to(np.floor(frame % 200).reshape(-1, *[1] * len(shape)), (rows, *shape)).astype(dtype),
        proprio=np.repeat(frame[:, None], 3, axis=1),
        goal=np.repeat(frame[:, None] + 1000, 3, axis=1),
        uv=np.full((rows, 2, 2), 0.5, np.float32),
        visible=np.ones((rows, 2), bool),
        action=np.repeat(step_number[:, None] / 1e6, 2, axis=1).astype(np.float32),
        reward=10 * step_number,
        terminated=np.zeros(rows, bool),
        truncated=np.array(truncated),
        is_step=np.array(is_step),
    )
