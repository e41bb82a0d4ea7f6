"""Labelled frames for pre-training, and their split by episode."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8


@dataclass(frozen=True, kw_only=True, slots=True)
class PretrainFrames:
    """Labelled frames, in any order. Pictures may be a memory-mapped file: they are read batch by batch."""

    rgb: UInt8[np.ndarray, "frames height width 3"]
    uv: Float32[np.ndarray, "frames objects 2"]
    """Objects' projected centres in image units."""
    visible: Bool[np.ndarray, "frames objects"]
    """The object's centre is in view; elsewhere its position is ignored."""
    episode: Int[np.ndarray, " frames"]
    """Episode of each frame; whole episodes are held out, for neighbouring frames are nearly the same."""


def split_by_episode(
    episode: Int[np.ndarray, " frames"], holdout: float, seed: int
) -> tuple[Int[np.ndarray, " train"], Int[np.ndarray, " held_out"]]:
    """Frames to train on and frames of episodes held out: that share of the episodes, at least one, never all.

    Raises:
        ValueError: fewer than two episodes.
    """
    episodes = np.unique(episode)
    if len(episodes) < 2:
        raise ValueError(
            f"pre-training needs frames of at least two episodes, to hold one out, and got {len(episodes)}: "
            "raise schedule.random_steps, or lower schedule.random_episode_steps or env.max_steps"
        )
    num_held_out = min(max(math.ceil(holdout * len(episodes)), 1), len(episodes) - 1)
    chosen = np.random.default_rng(seed).choice(episodes, num_held_out, replace=False)
    held_out = np.isin(episode, chosen)
    return np.flatnonzero(~held_out), np.flatnonzero(held_out)


def mean_position(frames: PretrainFrames, chosen: Int[np.ndarray, " train"]) -> Float32[np.ndarray, "objects 2"]:
    """Each object's mean position over the chosen frames that show it, in image units; the centre if none does."""
    visible = frames.visible[chosen][..., None]
    total = np.where(visible, frames.uv[chosen], 0.0).sum(0, dtype=np.float64)
    count = visible.sum(0)
    return np.where(count > 0, total / np.maximum(count, 1), 0.5).astype(np.float32)
