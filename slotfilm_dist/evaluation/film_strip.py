"""Film strips of an episode's moments: reach, grasp, transport, place, hold (Figure 8)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from slotfilm_dist.messages import Observation, StepResult

PANELS = 5
_GAP_PX = 4
_TITLE_PX = 40


@dataclass(frozen=True, kw_only=True, slots=True)
class Moment:
    """One step as a film strip needs it; the flags tell of the state that the picture shows."""

    rgb: UInt8[np.ndarray, "height width 3"]
    contact: bool
    grasped: bool
    placed: bool
    success: bool
    reward: float
    """Unscaled reward of the step that led here; 0 at the reset."""


class MomentRecorder:
    """Collects an episode's moments; give it to `play_episodes` as `watch`."""

    def __init__(self) -> None:
        self.moments: list[Moment] = []

    def __call__(self, observation: Observation, visual: np.ndarray, step: StepResult) -> None:
        """Take one step in: the picture after it, with what the simulator says of that instant."""
        if observation.rgb is None or step.final.rgb is None:
            raise ValueError("a film strip needs the camera: build the environment with camera=True")
        if not self.moments:
            self.moments.append(_moment(observation.rgb[0], None))
        self.moments.append(_moment(step.final.rgb[0], step))


def _moment(rgb: UInt8[np.ndarray, "height width 3"], step: StepResult | None) -> Moment:
    if step is None:
        return Moment(rgb=rgb, contact=False, grasped=False, placed=False, success=False, reward=0.0)
    return Moment(
        rgb=rgb,
        contact=bool(step.contact[0]),
        grasped=bool(step.grasped[0]),
        placed=bool(step.placed[0]),
        success=bool(step.success[0]),
        reward=float(step.reward[0]),
    )


def key_steps(moments: Sequence[Moment]) -> list[tuple[int, str]]:
    """Which moments to show, and what each shows.

    reach      half of the way to the grasp
    grasp      the first grasp that lasts until the object is placed, or the first one
    transport  halfway through the grasped moments between that and the placement, or the end
    place      first grasped and within the target region
    hold       the last moment, if still placed and grasped

    A moment that is several of these has the first of the names. In the place of what is then missing comes the moment
    furthest from all that are shown, named by its step: in an episode without a grasp they are evenly spaced.

    Raises:
        ValueError: no moments.
    """
    if not moments:
        raise ValueError("there are no moments: record an episode first")
    last = len(moments) - 1
    chosen: dict[int, str] = {}
    for step, name in _phases(moments):
        chosen.setdefault(step, name)
    if not chosen:
        chosen[0] = "step 0"
    chosen.setdefault(last, f"step {last}")
    while len(chosen) < min(PANELS, len(moments)):
        step = max(range(len(moments)), key=lambda i: min(abs(i - other) for other in chosen))
        chosen[step] = f"step {step}"
    return sorted(chosen.items())


def _phases(moments: Sequence[Moment]) -> Iterator[tuple[int, str]]:
    """Moments of the phases that the episode reached, in their order; none without a grasp."""
    grasped = [i for i, m in enumerate(moments) if m.grasped]
    if not grasped:
        return
    last = len(moments) - 1
    placed = next((i for i in grasped if moments[i].placed), None)
    grasp = grasped[0] if placed is None else _start_of_last_run([i for i in grasped if i <= placed])
    yield grasp // 2, "reach"
    yield grasp, "grasp"
    if held := [i for i in grasped if grasp < i < (last if placed is None else placed)]:
        yield held[len(held) // 2], "transport"
    if placed is not None:
        yield placed, "place"
        if moments[last].grasped and moments[last].placed:
            yield last, "hold"


def _start_of_last_run(indices: Sequence[int]) -> int:
    """First of the unbroken run of indices at the end."""
    start = indices[-1]
    for index in reversed(indices[:-1]):
        if index != start - 1:
            break
        start = index
    return start


def write_moments(moments: Sequence[Moment], path: Path, panel_px: int = 224) -> Path:
    """Write the key moments side by side as PNG; gives its path."""
    chosen = key_steps(moments)
    returns = np.cumsum([moment.reward for moment in moments])
    width = len(chosen) * (panel_px + _GAP_PX) - _GAP_PX
    canvas = Image.new("RGB", (width, panel_px + _TITLE_PX), (255, 255, 255))
    draw = ImageDraw.Draw(canvas)
    for index, (step, name) in enumerate(chosen):
        left = index * (panel_px + _GAP_PX)
        picture = Image.fromarray(moments[step].rgb).resize((panel_px, panel_px), Image.Resampling.BICUBIC)
        canvas.paste(picture, (left, 0))
        solved = "  solved" if moments[step].success else ""
        middle = left + panel_px / 2
        draw.text((middle, panel_px + 12), f"({chr(ord('a') + index)}) {name}", (20, 20, 20), _font(14), anchor="mm")
        note = f"step {step}  return {returns[step]:.1f}{solved}"
        draw.text((middle, panel_px + 29), note, (90, 90, 90), _font(12), anchor="mm")
    path.parent.mkdir(parents=True, exist_ok=True)
    canvas.save(path)
    return path


def moment_rows(moments: Sequence[Moment]) -> list[dict[str, Any]]:
    """One row for each step: what the simulator said, and which panel of the strip shows it."""
    panels = dict(key_steps(moments))
    return [
        {
            "step": step,
            "panel": panels.get(step),
            "contact": int(moment.contact),
            "grasped": int(moment.grasped),
            "placed": int(moment.placed),
            "success": int(moment.success),
            "reward": moment.reward,
        }
        for step, moment in enumerate(moments)
    ]


def _font(size_px: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size_px)
