"""What one row of replay holds, and the check that every block passes before it is stored."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool

from slotfilm_dist.config import check
from slotfilm_dist.messages import TransitionBlock

VisualKind = Literal["tokens", "rgb", "none"]

ACTION_TOLERANCE = 1e-4
"""How far beyond [-1, 1] an action may lie through rounding."""

_VISUAL_DTYPES: dict[VisualKind, np.dtype[Any]] = {
    "tokens": np.dtype(np.float16),
    "rgb": np.dtype(np.uint8),
    "none": np.dtype(np.uint8),
}
_VISUAL_AXES: dict[VisualKind, int] = {"tokens": 2, "rgb": 3, "none": 1}


@dataclass(frozen=True, kw_only=True, slots=True)
class Column:
    """One field of a row."""

    shape: tuple[int, ...]
    """Shape of one row's value."""
    dtype: np.dtype[Any]
    """Type of its elements."""

    @property
    def num_bytes(self) -> int:
        """Size of one row's value."""
        return int(np.prod(self.shape, dtype=np.int64)) * self.dtype.itemsize


@dataclass(frozen=True, kw_only=True, slots=True)
class ReplaySchema:
    """Shapes and types of a row; blocks that differ are refused."""

    visual_kind: VisualKind
    """`tokens` of a frozen backbone, `rgb` pictures, or `none`."""
    visual_shape: tuple[int, ...]
    """(tokens, channels), (height, width, 3) or (0,)."""
    proprio_dim: int
    """Size of the state vector."""
    action_dim: int
    """Size of an action."""
    num_objects: int
    """Objects whose image positions are labelled."""
    store_labels: bool = False
    """Keep the objects' image positions and visibility; sampling never returns them."""
    backbone_hash: str = ""
    """Hash of the backbone whose tokens are stored; empty for other kinds."""
    num_reward_inputs: int = 0
    """Numbers stored with a step from which the reward of any config follows; 0 stores the reward alone."""

    def __post_init__(self) -> None:
        kind, shape = self.visual_kind, self.visual_shape
        check(
            len(shape) == _VISUAL_AXES[kind] and (shape == (0,) if kind == "none" else min(shape) > 0),
            "schema.visual_shape",
            shape,
            "must be (tokens, channels) for tokens, (height, width, 3) for rgb, (0,) for none",
        )
        check(kind != "rgb" or shape[-1] == 3, "schema.visual_shape", shape, "pictures have 3 channels, last axis")
        for name in ("proprio_dim", "action_dim", "num_objects"):
            check(getattr(self, name) > 0, f"schema.{name}", getattr(self, name), "must be greater than 0")
        check(self.num_reward_inputs >= 0, "schema.num_reward_inputs", self.num_reward_inputs, "must be 0 or more")
        check(
            (kind == "tokens") == bool(self.backbone_hash),
            "schema.backbone_hash",
            self.backbone_hash,
            "must name the backbone where tokens are stored and be empty otherwise",
        )

    @property
    def columns(self) -> dict[str, Column]:
        """The stored fields of a `TransitionBlock`, by name."""
        float32, flag = np.dtype(np.float32), np.dtype(np.bool_)
        columns = {
            "visual": Column(shape=self.visual_shape, dtype=_VISUAL_DTYPES[self.visual_kind]),
            "proprio": Column(shape=(self.proprio_dim,), dtype=float32),
            "goal": Column(shape=(3,), dtype=float32),
            "action": Column(shape=(self.action_dim,), dtype=float32),
            "reward": Column(shape=(), dtype=float32),
            "terminated": Column(shape=(), dtype=flag),
            "truncated": Column(shape=(), dtype=flag),
            "is_step": Column(shape=(), dtype=flag),
        }
        if self.store_labels:
            columns["uv"] = Column(shape=(self.num_objects, 2), dtype=float32)
            columns["visible"] = Column(shape=(self.num_objects,), dtype=flag)
        if self.num_reward_inputs:
            columns["reward_inputs"] = Column(shape=(self.num_reward_inputs,), dtype=float32)
        return columns

    @property
    def row_bytes(self) -> int:
        """Memory of one row."""
        return sum(column.num_bytes for column in self.columns.values())

    def validate(self, block: TransitionBlock) -> None:
        """Check shapes, types, values and the row layout of a block.

        Raises:
            ValueError: names the field, what it holds and what was expected.
        """
        if block.backbone_hash != self.backbone_hash:
            raise _refusal(
                block,
                "backbone_hash",
                f"{block.backbone_hash!r} where replay holds tokens of {self.backbone_hash!r}; "
                "encode the pictures with the run's own backbone",
            )
        if block.num_rows < 2:
            raise _refusal(block, "reward", f"{block.num_rows} rows; a step and its next frame are the least")
        for name, column in self.columns.items():
            value: np.ndarray | None = getattr(block, name)
            expected = (block.num_rows, *column.shape)
            if value is None:
                raise _refusal(block, name, f"missing, expected {expected}; the environment gave none")
            if value.shape != expected:
                raise _refusal(block, name, f"shape {value.shape}, expected {expected}")
            if value.dtype != column.dtype and value.size:
                raise _refusal(block, name, f"type {value.dtype}, expected {column.dtype}")
        self._validate_values(block)
        _validate_layout(block)

    def _validate_values(self, block: TransitionBlock) -> None:
        for name in ("reward", "proprio", "goal", "action", *(["reward_inputs"] if self.num_reward_inputs else [])):
            _require(block, name, np.isfinite(getattr(block, name)), "not finite")
        if self.visual_kind == "tokens":
            # All ones in the exponent's five bits; np.isfinite is 50 times slower on float16.
            exponent = block.visual.view(np.uint16) & 0x7C00
            _require(block, "visual", exponent != 0x7C00, "not finite")
        if self.store_labels:
            _require(block, "uv", np.isfinite(block.uv) | ~block.visible[..., None], "not finite where visible")
        _require(block, "action", np.abs(block.action) <= 1 + ACTION_TOLERANCE, "outside [-1, 1]")


def _validate_layout(block: TransitionBlock) -> None:
    ended = block.terminated | block.truncated
    _require(block, "terminated", block.is_step | ~ended, "an episode ends in a row without a step")
    if block.is_step[-1]:
        raise _refusal(block, "is_step", "the last row is a step, whose next frame is missing")
    _require(
        block,
        "is_step",
        ~(ended[:-1] & block.is_step[1:]),
        "an ended episode is followed by a step; its true last frame must come first, in a row without a step,",
    )


def _require(block: TransitionBlock, name: str, ok: Bool[np.ndarray, "rows *value"], complaint: str) -> None:
    if not ok.all():
        row = int(np.argwhere(~ok)[0][0])
        raise _refusal(block, name, f"{complaint} in row {row}")


def _refusal(block: TransitionBlock, name: str, complaint: str) -> ValueError:
    return ValueError(
        f"block {block.sequence} of worker {block.worker_id} (incarnation {block.incarnation}): {name}: {complaint}"
    )
