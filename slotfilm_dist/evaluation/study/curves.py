"""Draws learning curves and per-seed points: one colour and line for a variant throughout the report."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from slotfilm_dist.evaluation.figure_style import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY, STYLE, steps_axis
from slotfilm_dist.evaluation.study.collection import StudyRun
from slotfilm_dist.evaluation.study.estimates import curve_band, held_curve
from slotfilm_dist.evaluation.study.numbers import LAST_EPISODES, VariantNumbers, training_returns
from slotfilm_dist.variants import VARIANTS

DPI = 110
_GRID_POINTS = 240
_LINES = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1)))
_COLORS = {
    "slotfilm": BLUE,
    "slotfilm_goal": SKY,
    "no_state": ORANGE,
    "film_clamp": GREEN,
    "concat_proj": RED,
    "concat_late": PURPLE,
    "state_only": GREY,
    "cnn": "#8c564b",
    "drq": "#000000",
    "drqv2": "#b5a100",
    "end_to_end": RED,
    "no_static": ORANGE,
}
"""Colours of the variants that share figures; the rest take them in turn."""
_TURNS = (ORANGE, GREEN, RED, PURPLE, SKY, "#8c564b", "#b5a100")


@dataclass(frozen=True, kw_only=True, slots=True)
class VariantCurve:
    """A variant's return over training."""

    variant: str
    num_seeds: int
    steps: Float64[np.ndarray, " grid"]
    seeds: Float64[np.ndarray, "seeds grid"]
    middle: Float64[np.ndarray, " grid"]
    low: Float64[np.ndarray, " grid"]
    high: Float64[np.ndarray, " grid"]


def smoothing_window(runs: Sequence[StudyRun]) -> int:
    """Episodes that curves of these runs are smoothed over: 100, or a fifth of the shortest run's where that is less.

    A window as long as the run would hide its learning.
    """
    shortest = min((len(training_returns(run)[0]) for run in runs), default=0)
    return max(1, min(LAST_EPISODES, shortest // 5))


def return_curves(runs: Sequence[StudyRun], window: int) -> list[VariantCurve]:
    """Smoothed returns of each variant's seeds at common steps, with their interquartile mean and its interval."""
    by_variant: dict[str, list[StudyRun]] = {}
    for run in runs:
        if len(training_returns(run)[0]):
            by_variant.setdefault(run.variant, []).append(run)
    if not by_variant:
        return []
    last = max(training_returns(run)[0][-1] for of_variant in by_variant.values() for run in of_variant)
    grid = np.linspace(0, last, _GRID_POINTS)
    curves = []
    for variant, of_variant in by_variant.items():
        seeds = np.stack([held_curve(*training_returns(run), grid, window) for run in of_variant])
        middle, low, high = curve_band(seeds)
        curves.append(
            VariantCurve(
                variant=variant, num_seeds=len(seeds), steps=grid, seeds=seeds, middle=middle, low=low, high=high
            )
        )
    return curves


def draw_returns(
    curves: Sequence[VariantCurve],
    unfinished: Sequence[VariantCurve],
    path: Path,
    *,
    episode_steps: int,
    random_steps: int,
) -> Path:
    """Return over environment steps: interquartile mean in bold, its interval as a band, each seed as a thin line.

    Args:
        curves: of runs that are over.
        unfinished: of runs that are not, dotted and thin.
        path: file to write.
        episode_steps: steps of an episode, for the axis of episodes.
        random_steps: where learning begins.
    """
    with new_figure(9.5, 4.4) as figure:
        axes = figure.subplots()
        for curve in curves:
            color, line = style_of(curve.variant)
            if curve.num_seeds > 1:
                axes.plot(curve.steps, curve.seeds.T, color=color, linewidth=0.7, alpha=0.45)
                axes.fill_between(curve.steps, curve.low, curve.high, color=color, alpha=0.15, linewidth=0)
            label = f"{curve.variant}, {_seeds(curve.num_seeds)}"
            axes.plot(curve.steps, curve.middle, color=color, linestyle=line, linewidth=2.2, label=label)
        for curve in unfinished:
            color, _ = style_of(curve.variant)
            axes.plot(curve.steps, curve.seeds.T, color=color, linewidth=0.9, linestyle=":")
            axes.plot([], [], color=color, linewidth=0.9, linestyle=":", label=f"{curve.variant}, not over")
        axes.axvline(random_steps, color=GREY, linestyle=":", linewidth=1)
        axes.set(ylabel="return of an episode, reward scale 10", ylim=(min(0.0, axes.get_ylim()[0]), None))
        steps_axis(axes)
        top = axes.secondary_xaxis(
            "top", functions=(lambda x: np.divide(x, episode_steps), lambda n: np.multiply(n, episode_steps))
        )
        top.set_xlabel(f"episodes of {episode_steps} steps")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
        save(figure, path)
    return path


def draw_points(
    numbers: Sequence[VariantNumbers],
    path: Path,
    *,
    xlabel: str,
    points: Callable[[VariantNumbers], Sequence[float]],
    middle: Callable[[VariantNumbers], tuple[float, float, float]],
    shares: bool = False,
) -> Path:
    """One row for each variant: its seeds as dots, and a value with its interval.

    Args:
        numbers: the variants, from the top down.
        path: file to write.
        xlabel: what is shown.
        points: the seeds' values.
        middle: value, lower and upper end; NaN ends draw no interval.
        shares: values are shares, shown as percentages from 0 to 100.
    """
    with new_figure(9.5, 0.8 + 0.36 * len(numbers)) as figure:
        axes = figure.subplots()
        for row, variant in enumerate(reversed(numbers)):
            color, _ = style_of(variant.variant)
            value, low, high = middle(variant)
            axes.plot(points(variant), np.full(len(variant.runs), row), "o", color=color, alpha=0.5, markersize=6)
            axes.plot([low, high], [row, row], color=color, linewidth=2.2, solid_capstyle="butt")
            axes.plot([value], [row], "|", color=color, markersize=17, markeredgewidth=2.6)
        axes.set_yticks(range(len(numbers)), [f"{n.variant} (n = {len(n.runs)})" for n in reversed(numbers)])
        axes.set(xlabel=xlabel, ylim=(-0.6, len(numbers) - 0.4))
        if shares:
            axes.set_xlim(-0.02, 1.02)
            axes.xaxis.set_major_formatter(PercentFormatter(1.0))
        else:
            axes.set_xlim(left=min(0.0, axes.get_xlim()[0]))
        save(figure, path)
    return path


def draw_lines(
    panels: Sequence[tuple[str, str, Callable[[Axes], Any]]], path: Path, *, height: float = 3.2, xlabel: str
) -> Path:
    """Panels side by side, each with title, label of its values, and a function that draws into it."""
    with new_figure(9.5, height) as figure:
        for axes, (title, label, draw) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
            draw(axes)
            axes.set(title=title, ylabel=label)
            steps_axis(axes, xlabel)
        save(figure, path)
    return path


def style_of(variant: str) -> tuple[str, Any]:
    """Colour and line of a variant, the same in every figure."""
    place = list(VARIANTS).index(variant) if variant in VARIANTS else 0
    color = _COLORS.get(variant, _TURNS[place % len(_TURNS)])
    return color, "-" if variant == "slotfilm" else _LINES[1 + place % (len(_LINES) - 1)]


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=DPI)


@contextmanager
def new_figure(width: float, height: float) -> Iterator[Figure]:
    """A figure in the report's style, of a size in inches, while the body draws it."""
    with rc_context(STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
        yield figure


def _seeds(count: int) -> str:
    return "1 seed" if count == 1 else f"{count} seeds"
