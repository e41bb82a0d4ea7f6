"""How well a frozen encoder sees labelled frames, clean and corrupted, and how stable its slots are (Section 5.2).

Position error, attention and visibility are measured as during pre-training (Figure 3): best matching of slots and
objects in each frame, averages over visible objects. Slot swaps count how often the matching changes within an episode.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int32, UInt8
from torch import Tensor

from slotfilm_dist.evaluation.corruptions import CORRUPTIONS, corrupt_frames
from slotfilm_dist.evaluation.labelled_frames import LabelledFrames
from slotfilm_dist.learning.perception_losses import attention_share, best_matching
from slotfilm_dist.learning.perception_quality import (
    PerceptionQuality,
    only_slots,
    perception_quality,
    strongest_slots,
)
from slotfilm_dist.nets.encoder import SlotFusionEncoder
from slotfilm_dist.nets.perception import Perception

_BATCH = 64
_RESAMPLES = 1000


@torch.inference_mode()
def perceive_frames(encoder: SlotFusionEncoder, rgb: UInt8[np.ndarray, "frames height width 3"]) -> Perception:
    """What the encoder sees in the frames, on the CPU."""
    device = encoder.proprio_mean.device
    parts = []
    for start in range(0, len(rgb), _BATCH):
        pictures = torch.from_numpy(np.array(rgb[start : start + _BATCH])).to(device)
        parts.append(encoder.perceive(encoder.tokens(pictures)))
    return Perception(
        **{
            field.name: torch.cat([getattr(part, field.name) for part in parts]).cpu()
            for field in dataclasses.fields(Perception)
        }
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class SwapRate:
    """How often slots change their objects between neighbouring frames that both show every object."""

    num_pairs: int
    """Neighbouring frames of one episode in which every object is visible."""
    num_swaps: int
    """Pairs whose two matchings differ."""
    by_episode: dict[int, tuple[int, int]]
    """Swaps and pairs of each episode, by its seed."""

    @property
    def rate(self) -> float:
        """Swaps a pair; NaN without pairs."""
        return self.num_swaps / self.num_pairs if self.num_pairs else math.nan


def swap_rate(
    matching: Int[np.ndarray, "frames objects"],
    visible: Bool[np.ndarray, "frames objects"],
    episode: Int32[np.ndarray, " frames"],
) -> SwapRate:
    """Count the changes of a matching over each episode."""
    pairs = (episode[1:] == episode[:-1]) & visible[1:].all(axis=1) & visible[:-1].all(axis=1)
    swaps = pairs & (matching[1:] != matching[:-1]).any(axis=1)
    by_episode = {}
    for seed in np.unique(episode).tolist():
        within = episode[1:] == seed
        by_episode[seed] = (int(swaps[within].sum()), int(pairs[within].sum()))
    return SwapRate(num_pairs=int(pairs.sum()), num_swaps=int(swaps.sum()), by_episode=by_episode)


def attention_matching(
    attention: Float[Tensor, "frames slots tokens"], uv: Float[Tensor, "frames objects 2"]
) -> Int[Tensor, "frames objects"]:
    """Slot of each object in the one-to-one assignment with most attention on the objects' tokens.

    Needs no trained UV head, unlike the matching by position.
    """
    num_slots, num_objects = attention.shape[1], uv.shape[1]
    shares = torch.stack([attention_share(attention[:, [s]], uv, "sum") for s in range(num_slots)], dim=1)
    assignments = torch.tensor(list(itertools.permutations(range(num_slots), num_objects)))
    total = shares[:, assignments, torch.arange(num_objects)].sum(2)
    return assignments[total.argmax(1)]


@dataclass(frozen=True, kw_only=True, slots=True)
class PerceptionResult:
    """An encoder measured on a set of frames."""

    quality: dict[str, PerceptionQuality]
    """By corruption, `clean` first."""
    intervals: dict[str, dict[str, tuple[float, float]]]
    """95 % bootstrap intervals over episodes of error, attention and visibility, by corruption."""
    swaps_by_position: dict[str, SwapRate]
    """By corruption, matched by predicted positions."""
    swaps_by_attention: dict[str, SwapRate]
    """By corruption, matched by attention."""
    clean: Perception
    """What was seen in the clean frames."""
    matching: Int[np.ndarray, "frames objects"]
    """Slot of each object in the clean frames, by position."""


def measure_perception(
    encoder: SlotFusionEncoder,
    frames: LabelledFrames,
    *,
    seed: int,
    names: Sequence[str] = tuple(CORRUPTIONS),
    shown: Callable[[str], None] = lambda name: None,
) -> PerceptionResult:
    """Measure an encoder on frames, clean and corrupted; an affine corruption moves the labels with the picture.

    Of surplus slots only the strongest count, one an object, chosen by the attention in the clean frames.

    A label under an occluding square stays: nothing tells the encoder that it need not guess.

    Args:
        encoder: frozen, with slots.
        frames: in episodes.
        seed: of the corruptions and of the intervals' resampling.
        names: corruptions; `clean` is always measured.
        shown: called with each name before it is measured.
    """
    quality, intervals, by_position, by_attention = {}, {}, {}, {}
    assert encoder.perception is not None
    matched_visibility = encoder.perception.matched_visibility
    clean: Perception | None = None
    clean_matching: Tensor | None = None
    counted: list[int] = []
    for name in dict.fromkeys(("clean", *names)):
        shown(name)
        rgb, uv_moved = corrupt_frames(frames.rgb, frames.uv, name, seed)
        visible_now = frames.visible & ((uv_moved >= 0) & (uv_moved < 1)).all(axis=2)
        everything = perceive_frames(encoder, rgb)
        counted = counted or strongest_slots(everything.attention.numpy(), frames.uv.shape[1])
        seen = only_slots(everything, counted, matched_visibility=matched_visibility)
        uv, visible = torch.from_numpy(uv_moved), torch.from_numpy(visible_now)
        quality[name] = _quality(encoder, seen, uv, visible)
        intervals[name] = _intervals(encoder, seen, uv, visible, frames.episode, seed)
        _, matching = best_matching(seen.uv, uv, visible)
        by_position[name] = swap_rate(matching.numpy(), visible_now, frames.episode)
        by_attention[name] = swap_rate(attention_matching(seen.attention, uv).numpy(), visible_now, frames.episode)
        if clean is None:
            clean, clean_matching = everything, torch.tensor(counted)[matching]
    assert clean is not None
    assert clean_matching is not None
    return PerceptionResult(
        quality=quality,
        intervals=intervals,
        swaps_by_position=by_position,
        swaps_by_attention=by_attention,
        clean=clean,
        matching=clean_matching.numpy(),
    )


def _quality(
    encoder: SlotFusionEncoder,
    seen: Perception,
    uv: Float[Tensor, "frames objects 2"],
    visible: Bool[Tensor, "frames objects"],
) -> PerceptionQuality:
    """The errors; the baseline is each object's mean position over these very frames."""
    assert encoder.perception is not None
    shown = visible.unsqueeze(2)
    count = visible.sum(0).unsqueeze(1)
    mean = torch.where(count > 0, torch.where(shown, uv, 0.0).sum(0) / count.clamp(min=1), 0.5)
    return perception_quality(
        seen,
        uv,
        visible,
        mean,
        image_size=encoder.perception.image_size,
        matched_visibility=encoder.perception.matched_visibility,
    )


def _intervals(
    encoder: SlotFusionEncoder,
    seen: Perception,
    uv: Float[Tensor, "frames objects 2"],
    visible: Bool[Tensor, "frames objects"],
    episode: Int32[np.ndarray, " frames"],
    seed: int,
) -> dict[str, tuple[float, float]]:
    """Intervals of the means over visible objects, from resampled episodes; NaN where nothing is visible."""
    assert encoder.perception is not None
    distance = object_errors(seen, uv, visible) * encoder.perception.image_size
    share = attention_share(seen.attention, uv, "sum_clamped").clamp(min=1e-8)
    rng = np.random.default_rng(seed)
    groups = [np.flatnonzero(episode == e) for e in np.unique(episode)]
    counts = np.array([int(visible[g].sum()) for g in groups])
    out = {}
    for name, values in (
        ("position_error_px", distance),
        ("attention_nll", -share.log()),
        ("attention_share", share),
    ):
        masked = torch.where(visible, values, 0.0).numpy()
        sums = np.array([masked[g].sum() for g in groups])
        picks = rng.integers(len(groups), size=(_RESAMPLES, len(groups)))
        weights = counts[picks].sum(axis=1)
        means = sums[picks].sum(axis=1)[weights > 0] / weights[weights > 0]
        low, high = np.quantile(means, [0.025, 0.975]) if len(means) else (math.nan, math.nan)
        out[name] = (float(low), float(high))
    return out


def object_errors(
    seen: Perception, uv: Float[Tensor, "frames objects 2"], visible: Bool[Tensor, "frames objects"]
) -> Float[Tensor, "frames objects"]:
    """Distance of each object from its matched slot's prediction, in image units."""
    _, matching = best_matching(seen.uv, uv, visible)
    at_objects = seen.uv.gather(1, matching.unsqueeze(2).expand(-1, -1, 2))
    return (at_objects - uv).norm(dim=2)


def frame_rows(
    frames: LabelledFrames, result: PerceptionResult, objects: Sequence[str], *, matched_visibility: bool
) -> list[dict[str, Any]]:
    """One row for each object of each clean frame: where it is, where its slot says it is, whether it is in view."""
    seen, size = result.clean, frames.rgb.shape[1]
    uv = torch.from_numpy(np.array(frames.uv))
    errors = object_errors(seen, uv, torch.from_numpy(frames.visible)).numpy() * size
    share = attention_share(seen.attention, uv, "sum_clamped").numpy()
    matching = result.matching
    logits = seen.visible_logits.numpy()
    chance = 1 / (1 + np.exp(-(np.take_along_axis(logits, matching, axis=1) if matched_visibility else logits)))
    predicted = seen.uv.numpy()
    rows = []
    for frame in range(len(frames.rgb)):
        for index, name in enumerate(objects):
            slot = int(matching[frame, index])
            shown = bool(frames.visible[frame, index])
            rows.append(
                {
                    "episode": frames.episode[frame],
                    "step": frames.step[frame],
                    "object": name,
                    "visible": int(shown),
                    "visible_predicted": chance[frame, index],
                    "u": frames.uv[frame, index, 0],
                    "v": frames.uv[frame, index, 1],
                    "slot": slot if shown else None,
                    "u_predicted": predicted[frame, slot, 0],
                    "v_predicted": predicted[frame, slot, 1],
                    "error_px": errors[frame, index] if shown else None,
                    "attention_share": share[frame, index] if shown else None,
                }
            )
    return rows


def summary(result: PerceptionResult) -> dict[str, Any]:
    """Plain values of everything but the frames."""
    return {
        "quality": {name: dataclasses.asdict(quality) for name, quality in result.quality.items()},
        "intervals_95": result.intervals,
        "swaps": {
            kind: {
                name: {
                    "rate": rate.rate,
                    "num_swaps": rate.num_swaps,
                    "num_pairs": rate.num_pairs,
                    "by_episode": {str(seed): counts for seed, counts in rate.by_episode.items()},
                }
                for name, rate in rates.items()
            }
            for kind, rates in (
                ("by_position", result.swaps_by_position),
                ("by_attention", result.swaps_by_attention),
            )
        },
    }
