"""Attention, positions and visibility of one picture after another, drawn and timed (Figure 6)."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from PIL import Image, ImageDraw, ImageFont

from slotfilm_dist.evaluation.video import SLOT_COLORS, attention_overlay
from slotfilm_dist.nets.encoder import SlotFusionEncoder

_BACKGROUND, _TEXT, _MUTED = (18, 20, 24), (235, 237, 240), (150, 156, 165)
_MARGIN_PX, _TITLE_PX, _FOOT_PX = 8, 24, 28


@dataclass(frozen=True, kw_only=True, slots=True)
class Seen:
    """What the encoder sees in one picture."""

    rgb: UInt8[np.ndarray, "size size 3"]
    """The picture as the encoder got it."""
    attention: Float32[np.ndarray, "slots tokens"]
    uv: Float32[np.ndarray, "slots 2"]
    """Position that each slot predicts, in image units."""
    visible: Float32[np.ndarray, " logits"]
    """Chance of being in view, of each object, or of each slot with `encoder.vis_head = matched`."""
    latency_ms: float
    """From the picture in memory to these numbers in memory."""


@torch.inference_mode()
def perceive_picture(encoder: SlotFusionEncoder, rgb: UInt8[np.ndarray, "size size 3"]) -> Seen:
    """Run the encoder on one picture of its own size."""
    started = time.perf_counter()
    pictures = torch.from_numpy(np.array(rgb)[None]).to(encoder.proprio_mean.device)
    seen = encoder.perceive(encoder.tokens(pictures))
    attention, uv, visible = (x[0].cpu().numpy() for x in (seen.attention, seen.uv, seen.visible_logits.sigmoid()))
    return Seen(rgb=rgb, attention=attention, uv=uv, visible=visible, latency_ms=1000 * (time.perf_counter() - started))


def draw_seen(
    seen: Seen, labels: Sequence[str], note: str = "", panel_px: int = 256
) -> UInt8[np.ndarray, "rows columns 3"]:
    """The picture with each slot's predicted position (x), beside every slot's attention; visibility below.

    Args:
        seen: one picture's perception.
        labels: of the chances in `seen.visible`.
        note: shown at the right of the last line.
        panel_px: edge of each panel.
    """
    num_panels = 1 + len(seen.attention)
    width = num_panels * panel_px + (num_panels + 1) * _MARGIN_PX
    height = _TITLE_PX + panel_px + _FOOT_PX
    canvas = Image.new("RGB", (width + width % 2, height + height % 2), _BACKGROUND)
    draw = ImageDraw.Draw(canvas)
    picture = Image.fromarray(seen.rgb).resize((panel_px, panel_px), Image.Resampling.BICUBIC)
    canvas.paste(picture, (_MARGIN_PX, _TITLE_PX))
    draw.text((_MARGIN_PX, _TITLE_PX / 2), "camera   x predicted", _TEXT, _font(13), anchor="lm")
    radius = max(panel_px // 40, 4)
    for slot, position in enumerate(seen.uv):
        x, y = np.array([_MARGIN_PX, _TITLE_PX]) + np.clip(position, 0, 1) * panel_px
        for color, line_px in (((0, 0, 0), 5), (SLOT_COLORS[slot % len(SLOT_COLORS)], 3)):
            draw.line((x - radius, y - radius, x + radius, y + radius), color, line_px)
            draw.line((x - radius, y + radius, x + radius, y - radius), color, line_px)
    for slot, attention in enumerate(seen.attention):
        left = _MARGIN_PX + (slot + 1) * (panel_px + _MARGIN_PX)
        canvas.paste(Image.fromarray(attention_overlay(seen.rgb, attention, panel_px)), (left, _TITLE_PX))
        color = SLOT_COLORS[slot % len(SLOT_COLORS)]
        peak = f"slot {slot}   peak {100 * float(attention.max()):.0f} %"
        draw.text((left, _TITLE_PX / 2), peak, color, _font(13), anchor="lm")
    foot = _TITLE_PX + panel_px + _FOOT_PX / 2
    chances = "   ".join(f"{name} {p:.0%}" for name, p in zip(labels, seen.visible, strict=True))
    draw.text((_MARGIN_PX, foot), f"in view: {chances}", _TEXT, _font(13), anchor="lm")
    draw.text((width - _MARGIN_PX, foot), note, _MUTED, _font(13), anchor="rm")
    return np.asarray(canvas)


@dataclass(kw_only=True, slots=True)
class FrameRate:
    """Pictures a second, over all and over the last second or so."""

    started_s: float = field(default_factory=time.monotonic)
    count: int = 0
    _last_s: float | None = None
    _smooth_s: float = 0.0

    def add(self) -> None:
        """One more picture is done."""
        now = time.monotonic()
        if self._last_s is not None:
            gap = now - self._last_s
            self._smooth_s = gap if self._smooth_s == 0 else 0.9 * self._smooth_s + 0.1 * gap
        self._last_s = now
        self.count += 1

    @property
    def recent_hz(self) -> float:
        """The rate now; 0 before the second picture."""
        return 1 / self._smooth_s if self._smooth_s > 0 else 0.0

    @property
    def mean_hz(self) -> float:
        """The rate since the beginning."""
        return self.count / max(time.monotonic() - self.started_s, 1e-9)


def seen_row(index: int, seen: Seen, labels: Sequence[str]) -> dict[str, Any]:
    """One picture's numbers as a table's row."""
    row: dict[str, Any] = {"picture": index, "latency_ms": seen.latency_ms}
    row |= {f"in_view_{name}": p for name, p in zip(labels, seen.visible, strict=True)}
    for slot, (u, v) in enumerate(seen.uv):
        row |= {f"slot_{slot}_u": u, f"slot_{slot}_v": v, f"slot_{slot}_peak": seen.attention[slot].max()}
    return row


def _font(size_px: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size_px)
