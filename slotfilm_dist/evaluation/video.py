"""Pictures of what the agent sees and attends to: one frame, a video, a film strip (the paper's Figures 4, 5 and 8)."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image, ImageDraw, ImageFont

Color = tuple[int, int, int]

SLOT_COLORS: tuple[Color, ...] = ((64, 140, 255), (60, 220, 110), (240, 120, 240), (120, 235, 235))
"""Predicted position of each slot, drawn as x: blue and green as in the paper, then magenta and cyan."""

OBJECT_COLORS: tuple[Color, ...] = ((255, 165, 0), (255, 60, 50), (255, 255, 90), (255, 255, 255))
"""True position of each object, drawn as o: orange and red as in the paper, then yellow and white."""

_HEAT = np.array(
    [
        (0, 0, 4),
        (40, 11, 84),
        (101, 21, 110),
        (159, 42, 99),
        (212, 72, 66),
        (245, 125, 21),
        (250, 193, 39),
        (252, 255, 164),
    ]
)
"""Anchors of a colour map whose brightness rises evenly, so that it also reads in grey."""

_BACKGROUND: Color = (18, 20, 24)
_TEXT: Color = (235, 237, 240)
_MUTED: Color = (150, 156, 165)
_SOLVED: Color = (60, 220, 110)
_MARGIN_PX = 8
_TITLE_PX = 24
_STRIP_PX = 36
_COMPRESSIONS = (23, 28, 33, 38, 43)
"""x264's constant rate factors, best picture first."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RolloutFrame:
    """One step of a recorded episode."""

    rgb: UInt8[np.ndarray, "height width 3"]
    """What the wrist camera saw."""
    attention: Float[np.ndarray, "slots tokens"]
    """Each slot's attention, heads averaged, row by row; no rows for an agent without slots."""
    uv_predicted: Float[np.ndarray, "predictions 2"]
    """Each slot's predicted position in image units; no rows for an agent without UV head."""
    uv: Float[np.ndarray, "objects 2"]
    """The objects' true positions in image units."""
    visible: Bool[np.ndarray, " objects"]
    """Which of them are in view; only these are drawn."""
    reward: float
    """Unscaled reward of this step."""
    success: bool
    """The task is solved at this instant."""


def attention_overlay(
    rgb: UInt8[np.ndarray, "height width 3"], attention: Float[np.ndarray, " tokens"], size_px: int, alpha: float = 0.55
) -> UInt8[np.ndarray, "size size 3"]:
    """The picture under a heat map of one slot's attention, relative to its own peak.

    Args:
        rgb: the picture.
        attention: weights of a square grid of tokens, row by row.
        size_px: edge of the result.
        alpha: opacity of the heat map.

    Raises:
        ValueError: the number of tokens is not a square.
    """
    side = math.isqrt(attention.size)
    if side * side != attention.size:
        raise ValueError(f"attention has {attention.size} tokens: a square grid such as 8 x 8 = 64 is needed")
    grid = Image.fromarray(attention.reshape(side, side).astype(np.float32))
    heat = np.asarray(grid.resize((size_px, size_px), Image.Resampling.BILINEAR))
    level = np.clip(heat / max(float(attention.max()), 1e-12), 0, 1)
    anchors = np.linspace(0, 1, len(_HEAT))
    color = np.stack([np.interp(level, anchors, _HEAT[:, channel]) for channel in range(3)], axis=-1)
    picture = np.asarray(_upscaled(rgb, size_px), dtype=np.float64)
    return (picture * (1 - alpha) + color * alpha).round().astype(np.uint8)


def draw_frame(
    frame: RolloutFrame, *, step: int, num_steps: int, episode_return: float, panel_px: int = 256
) -> UInt8[np.ndarray, "rows columns 3"]:
    """The camera's picture with predicted (x) and true (o) positions, beside every slot's attention; the score above.

    Slots are exchangeable: which of them follows which object may differ from run to run, so an x has the colour of
    its slot and an o that of its object. Both edges of the result are even, as video needs.

    Args:
        frame: the step.
        step: its number, from 0.
        num_steps: steps of the episode.
        episode_return: unscaled return up to and with this step.
        panel_px: edge of each panel.
    """
    num_panels = 1 + len(frame.attention)
    width = num_panels * panel_px + (num_panels + 1) * _MARGIN_PX
    top = _STRIP_PX + _TITLE_PX
    title_y = _STRIP_PX + _TITLE_PX / 2
    height = top + panel_px + _MARGIN_PX
    canvas = Image.new("RGB", (width + width % 2, height + height % 2), _BACKGROUND)
    draw = ImageDraw.Draw(canvas)
    canvas.paste(_upscaled(frame.rgb, panel_px), (_MARGIN_PX, top))
    _draw_positions(draw, frame, (_MARGIN_PX, top), panel_px)
    crosses = "   x predicted  o true" if len(frame.uv_predicted) else ""
    draw.text((_MARGIN_PX, title_y), f"wrist camera{crosses}", _TEXT, _font(13), anchor="lm")
    for slot, attention in enumerate(frame.attention):
        left = _MARGIN_PX + (slot + 1) * (panel_px + _MARGIN_PX)
        canvas.paste(Image.fromarray(attention_overlay(frame.rgb, attention, panel_px)), (left, top))
        color = SLOT_COLORS[slot % len(SLOT_COLORS)]
        draw.text((left, title_y), f"slot {slot}", color, _font(13), anchor="lm")
        peak = f"peak {100 * float(attention.max()):.0f} %"
        draw.text((left + panel_px, title_y), peak, _MUTED, _font(12), anchor="rm")
    _draw_score(draw, frame, step, num_steps, episode_return, canvas.width)
    return np.asarray(canvas)


def _upscaled(rgb: UInt8[np.ndarray, "height width 3"], size_px: int) -> Image.Image:
    return Image.fromarray(rgb).resize((size_px, size_px), Image.Resampling.BICUBIC)


def _font(size_px: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size_px)


def _draw_positions(draw: ImageDraw.ImageDraw, frame: RolloutFrame, corner: tuple[int, int], panel_px: int) -> None:
    radius = max(panel_px // 40, 4)
    ring = radius + 4
    for index in np.flatnonzero(frame.visible):
        x, y = np.asarray(corner) + frame.uv[index] * panel_px
        box = (x - ring, y - ring, x + ring, y + ring)
        draw.ellipse(tuple(np.add(box, (-1, -1, 1, 1))), outline=(0, 0, 0), width=1)
        draw.ellipse(box, outline=OBJECT_COLORS[index % len(OBJECT_COLORS)], width=3)
    for slot, position in enumerate(frame.uv_predicted):
        x, y = np.asarray(corner) + np.clip(position, 0, 1) * panel_px
        # A dark outline first, so that the cross also shows on a background of its own colour.
        for color, line_px in (((0, 0, 0), 5), (SLOT_COLORS[slot % len(SLOT_COLORS)], 3)):
            draw.line((x - radius, y - radius, x + radius, y + radius), color, line_px)
            draw.line((x - radius, y + radius, x + radius, y - radius), color, line_px)


def _draw_score(
    draw: ImageDraw.ImageDraw,
    frame: RolloutFrame,
    step: int,
    num_steps: int,
    episode_return: float,
    width: int,
) -> None:
    middle = (_STRIP_PX - 8) / 2
    text = f"step {step + 1}/{num_steps}    reward {frame.reward:5.3f}    return {episode_return:.1f}"
    if width < 480:
        text = f"{step + 1}/{num_steps}   r {frame.reward:4.2f}   R {episode_return:.0f}"
    draw.text((_MARGIN_PX, middle), text, _TEXT, _font(14), anchor="lm")
    if frame.success:
        draw.text((width - _MARGIN_PX, middle), "SOLVED", _SOLVED, _font(15), anchor="rm")
    right = _MARGIN_PX + (width - 2 * _MARGIN_PX) * (step + 1) / num_steps
    draw.rectangle((_MARGIN_PX, _STRIP_PX - 6, width - _MARGIN_PX, _STRIP_PX - 4), fill=(50, 54, 60))
    draw.rectangle((_MARGIN_PX, _STRIP_PX - 6, right, _STRIP_PX - 4), fill=_SOLVED if frame.success else _MUTED)


def write_video(
    frames: Sequence[RolloutFrame], path: Path, *, fps: int = 20, panel_px: int = 256, max_bytes: int = 2_500_000
) -> Path:
    """Write an episode as H.264 video that every browser plays, and give its path.

    The picture is compressed harder until the file is small enough for a page; the file appears only when complete.

    Args:
        frames: the episode's steps, oldest first.
        path: file to write, `*.mp4`.
        fps: pictures a second; the control rate plays in real time.
        panel_px: edge of each panel.
        max_bytes: size aimed at; a file that exceeds it even with the strongest compression is kept.

    Raises:
        ValueError: no frames, or a path that is not an .mp4 file.
    """
    if not frames:
        raise ValueError("frames is empty: a video needs at least one step")
    if path.suffix != ".mp4":
        raise ValueError(f"path = {path}: must end in .mp4")
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.stem}.partial.mp4")
    try:
        for compression in _COMPRESSIONS:
            _encode(frames, partial, fps, panel_px, compression)
            if partial.stat().st_size <= max_bytes:
                break
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    return path


def _encode(frames: Sequence[RolloutFrame], path: Path, fps: int, panel_px: int, compression: int) -> None:
    returns = np.cumsum([frame.reward for frame in frames])
    with imageio.get_writer(
        path,
        fps=fps,
        codec="libx264",
        pixelformat="yuv420p",
        macro_block_size=2,
        output_params=["-crf", str(compression), "-movflags", "+faststart"],
    ) as writer:
        for step, frame in enumerate(frames):
            total = float(returns[step])
            picture = draw_frame(frame, step=step, num_steps=len(frames), episode_return=total, panel_px=panel_px)
            writer.append_data(picture)  # type: ignore[attr-defined]  # imageio's type leaves out what writers do


def write_film_strip(frames: Sequence[RolloutFrame], path: Path, *, num_frames: int = 6, panel_px: int = 224) -> Path:
    """Write evenly spaced pictures of an episode, first and last included, side by side as PNG; gives the path.

    Raises:
        ValueError: no frames, or fewer than one picture asked for.
    """
    if not frames or num_frames < 1:
        raise ValueError(f"{len(frames)} frames, num_frames = {num_frames}: both must be 1 or more")
    steps = np.unique(np.linspace(0, len(frames) - 1, num_frames).round().astype(int))
    returns = np.cumsum([frame.reward for frame in frames])
    gap = 4
    canvas = Image.new("RGB", (len(steps) * (panel_px + gap) - gap, panel_px + _TITLE_PX), (255, 255, 255))
    draw = ImageDraw.Draw(canvas)
    for index, step in enumerate(steps):
        left = index * (panel_px + gap)
        canvas.paste(_upscaled(frames[step].rgb, panel_px), (left, 0))
        solved = "  solved" if frames[step].success else ""
        text = f"({chr(ord('a') + index % 26)})  step {step + 1}  return {returns[step]:.0f}{solved}"
        draw.text((left + panel_px / 2, panel_px + _TITLE_PX / 2), text, (20, 20, 20), _font(13), anchor="mm")
    path.parent.mkdir(parents=True, exist_ok=True)
    canvas.save(path)
    return path
