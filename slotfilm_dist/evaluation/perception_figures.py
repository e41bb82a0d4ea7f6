"""Pictures of perception: attention maps (Figures 4 and 14), positions over frames (Figures 5 and 15), curves (3)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from slotfilm_dist.evaluation.figure_style import BLUE, GREY, ORANGE, STYLE
from slotfilm_dist.evaluation.labelled_frames import LabelledFrames
from slotfilm_dist.evaluation.perception import PerceptionResult
from slotfilm_dist.evaluation.video import OBJECT_COLORS, SLOT_COLORS, attention_overlay
from slotfilm_dist.learning.perception_quality import strongest_slots

_PANEL_PX = 192
_PANEL_IN = 1.35


def spread_frames(frames: LabelledFrames, count: int, seed: int) -> list[int]:
    """Randomly chosen frames, in order, as many as there are at most."""
    chosen = np.random.default_rng(seed).choice(len(frames.rgb), min(count, len(frames.rgb)), replace=False)
    return sorted(chosen.tolist())


def draw_attention(
    frames: LabelledFrames, result: PerceptionResult, chosen: Sequence[int], path: Path, shown_slots: int = 2
) -> Path:
    """Frames above the attention of their slots; with surplus slots the strongest of them (Figures 4 and 14)."""
    attention = result.clean.attention.numpy()
    slots = strongest_slots(attention, shown_slots)
    with rc_context(STYLE):
        figure = Figure(figsize=(_PANEL_IN * len(chosen), _PANEL_IN * (1 + len(slots)) + 0.3), layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.subplots(1 + len(slots), len(chosen), squeeze=False)
        for column, index in enumerate(chosen):
            grid[0, column].imshow(frames.rgb[index])
            for row, slot in enumerate(slots):
                grid[row + 1, column].imshow(attention_overlay(frames.rgb[index], attention[index, slot], _PANEL_PX))
        for row, label in enumerate(["picture", *(f"slot {slot}" for slot in slots)]):
            grid[row, 0].set_ylabel(label)
        _bare(grid)
        _save(figure, path)
    return path


def draw_positions(
    frames: LabelledFrames,
    result: PerceptionResult,
    chosen: Sequence[int],
    objects: Sequence[str],
    path: Path,
    shown_slots: int = 2,
) -> Path:
    """Frames with predicted (x, by slot) and true (o, by object) positions (Figures 5 and 15).

    With surplus slots the strongest are drawn, which needs no label. Objects out of view have no o.
    """
    size = frames.rgb.shape[1]
    slots = strongest_slots(result.clean.attention.numpy(), shown_slots)
    predicted = result.clean.uv.numpy() * size - 0.5
    with rc_context(STYLE):
        columns = min(4, len(chosen))
        rows = -(-len(chosen) // columns)
        figure = Figure(figsize=(1.9 * columns, 1.9 * rows + 0.5), layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.subplots(rows, columns, squeeze=False)
        _bare(grid)
        for axes in grid.ravel()[len(chosen) :]:
            axes.axis("off")
        for axes, index in zip(grid.ravel(), chosen, strict=False):
            axes.imshow(frames.rgb[index])
            for k in np.flatnonzero(frames.visible[index]).tolist():
                axes.plot(
                    *(frames.uv[index, k] * size - 0.5), "o", mfc="none", mew=2, ms=9, color=_hex(OBJECT_COLORS, k)
                )
            for slot in slots:
                axes.plot(*predicted[index, slot], "x", mew=2, ms=7, color=_hex(SLOT_COLORS, slot))
            axes.set(xlim=(-0.5, size - 0.5), ylim=(size - 0.5, -0.5))
        for k, name in enumerate(objects):
            grid[0, 0].plot([], [], "o", mfc="none", mew=2, color=_hex(OBJECT_COLORS, k), label=f"true {name}")
        for slot in slots:
            grid[0, 0].plot([], [], "x", mew=2, color=_hex(SLOT_COLORS, slot), label=f"slot {slot}")
        figure.legend(loc="outside lower center", ncols=len(objects) + len(slots))
        _save(figure, path)
    return path


def draw_corruptions(result: PerceptionResult, path: Path) -> Path:
    """Position error, attention and visibility under each corruption, with intervals over episodes."""
    names = list(result.quality)
    with rc_context(STYLE):
        figure = Figure(figsize=(10, 3), layout="constrained")
        FigureCanvasAgg(figure)
        panels = (
            ("position_error_px", "position error (px)"),
            ("attention_nll", "attention NLL (nats)"),
            ("visibility_auroc", "visibility AUROC"),
        )
        for axes, (key, label) in zip(figure.subplots(1, 3), panels, strict=True):
            values = np.array([getattr(result.quality[name], key) for name in names])
            axes.bar(names, values, color=[GREY if name == "clean" else BLUE for name in names])
            if key in result.intervals[names[0]]:
                bounds = np.array([result.intervals[name][key] for name in names])
                spread = np.abs(np.stack((values - bounds[:, 0], bounds[:, 1] - values)))
                axes.errorbar(names, values, spread, fmt="none", ecolor=ORANGE, capsize=3)
            axes.set_title(label)
            axes.tick_params(axis="x", rotation=30)
            axes.set_axisbelow(True)
        _save(figure, path)
    return path


def _bare(grid: np.ndarray) -> None:
    for axes in grid.ravel():
        axes.set(xticks=[], yticks=[])
        axes.grid(False)
        for spine in axes.spines.values():
            spine.set_visible(False)


def _hex(colors: Sequence[tuple[int, int, int]], index: int) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colors[index % len(colors)])


def _save(figure: Figure, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
