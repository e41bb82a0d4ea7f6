"""Figures of one run, drawn from its files: pre-training, return, success, reward components, learner, throughput.

Smoothing is causal everywhere: no curve rises before the event that made it rise.
"""

from collections.abc import Callable
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

from slotfilm_dist.evaluation.figure_style import (
    BLUE,
    GREEN,
    GREY,
    LINES,
    ORANGE,
    RED,
    SKY,
    STYLE,
    steps_axis,
    values_axis,
)
from slotfilm_dist.evaluation.record import Points, RunRecord
from slotfilm_dist.evaluation.statistics import causal_mean
from slotfilm_dist.metrics import METRICS

_EPISODE_WINDOW = 100
_Line = Callable[[Any], Any]
"""Of a number or an array."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RunFigure:
    """A figure that was drawn."""

    path: Path
    title: str
    text: str
    """What it shows, for a caption and for who cannot see it."""


def draw_figures(record: RunRecord, folder: Path) -> tuple[list[RunFigure], list[str]]:
    """Draw every figure that the run has numbers for, as PNG files.

    Returns:
        The figures drawn, and one sentence for each that could not be.
    """
    folder.mkdir(parents=True, exist_ok=True)
    drawn, missing = [], []
    for stem, title, draw in _FIGURES:
        with rc_context(STYLE):
            figure = Figure(layout="constrained")
            FigureCanvasAgg(figure)
            text = draw(record, figure)
            if not text:
                missing.append(f"Figure “{title}”: the run has written nothing to draw it from yet.")
                continue
            figure.savefig(folder / f"{stem}.png", dpi=150)
        drawn.append(RunFigure(path=folder / f"{stem}.png", title=title, text=text))
    return drawn, missing


def _draw_pretraining(record: RunRecord, figure: Figure) -> str:
    axis = "pretrain_steps_total"
    pixels = record.config is not None and record.config.pretrain.uv_units == "pixels"
    panels = (
        ("pretrain_position_loss", "(a) position", "loss (px)" if pixels else "loss (image units)"),
        ("pretrain_attention_loss", "(b) attention alignment", "negative log attention (nats)"),
        ("pretrain_visibility_loss", "(c) visibility", "cross-entropy (nats)"),
    )
    if not any(len(record.series(key, axis)[0]) for key, _, _ in panels):
        return ""
    figure.set_size_inches(10, 6.4)
    grid = figure.subplots(2, 2).ravel()
    for axes, (key, title, label) in zip(grid, panels, strict=False):
        steps, values = record.series(key, axis)
        axes.plot(steps, values, color=BLUE, alpha=0.25, linewidth=0.8)
        axes.plot(steps, causal_mean(values, _window(values)), color=BLUE)
        axes.set(title=title, ylabel=label)
        steps_axis(axes, "gradient steps")
        axes.set_ylim(bottom=min(0, values.min(initial=0)))
    return "Losses of slot pre-training over gradient steps. " + _draw_pixel_error(record, grid[3], axis)


def _draw_pixel_error(record: RunRecord, axes: Axes, axis: str) -> str:
    steps, error = record.series("pretrain_position_error_px", axis)
    base_steps, baseline = record.series("pretrain_baseline_error_px", axis)
    axes.set(title="(d) position error, held-out frames", ylabel="mean distance (px)")
    if not len(error):
        axes.text(0.5, 0.5, "not measured yet", transform=axes.transAxes, ha="center", color=GREY)
        return "The held-out position error was not measured yet."
    axes.plot(steps, error, color=BLUE, label="slots")
    if len(baseline):
        axes.plot(base_steps, baseline, color=RED, linestyle="--", label="predicting the mean")
    axes.set_ylim(bottom=0)
    axes.legend()
    steps_axis(axes, "gradient steps")
    against = f", where predicting the mean position gives {baseline[-1]:.1f} px" if len(baseline) else ""
    return f"The held-out position error ends at {error[-1]:.1f} px{against}."


def _window(values: Float64[np.ndarray, " points"]) -> int:
    return max(1, len(values) // 25)


def _episode_window(record: RunRecord) -> int:
    return min(_EPISODE_WINDOW, max(1, len(record.learning_episodes) // 5))


def _draw_return(record: RunRecord, figure: Figure) -> str:
    trained = record.of_agent
    if not record.learning_episodes and not trained:
        return ""
    figure.set_size_inches(10, 5)
    axes = figure.subplots()
    window = _episode_window(record)
    if record.learning_episodes:
        steps = np.array([e.env_steps for e in record.learning_episodes], dtype=np.float64)
        returns = np.array([e.summary.episode_return for e in record.learning_episodes])
        axes.scatter(steps, returns, s=8, color=GREY, alpha=0.5, linewidths=0, label="training episode")
        axes.plot(steps, causal_mean(returns, window), color=BLUE, label=f"mean of the last {window} episodes")
        _episode_axis(axes, steps)
    if trained:
        means = [e.mean_return for e in trained]
        spread = [e.std_return for e in trained]
        places = [e.env_steps for e in trained]
        axes.errorbar(
            places, means, spread, fmt="D", color=ORANGE, capsize=3, markersize=5, label="evaluation, mean ± s.d."
        )
    text = f"Return of every training episode over environment steps, with the mean of the last {window}."
    random = record.evaluation("random")
    if random:
        axes.axhline(random.mean_return, color=RED, linestyle="--", label=f"random policy, {random.mean_return:.1f}")
        text += f" The random policy's mean return is {random.mean_return:.1f}."
    axes.set_ylabel("return of an episode (unscaled)")
    if record.config:
        start = record.config.schedule.random_steps
        axes.axvline(start, color=GREY, linestyle=":", linewidth=1.2, label="random collection ends")
        scale = record.config.sac.reward_scale
        right = axes.secondary_yaxis(
            "right", functions=(lambda y: np.multiply(y, scale), lambda y: np.divide(y, scale))
        )
        right.set_ylabel(f"return at reward scale {scale:g}")
    steps_axis(axes)
    axes.legend(loc="upper left")
    return text


def _episode_axis(axes: Axes, steps: Float64[np.ndarray, " episodes"]) -> None:
    if steps.any():
        axes.secondary_xaxis("top", functions=episode_counts(steps)).set_xlabel("episodes")


def episode_counts(steps: Float64[np.ndarray, " episodes"]) -> tuple[_Line, _Line]:
    """Functions from steps to the number of this run's episodes that had ended by then, and back.

    They go through every episode, whatever its length, and on at the mean length beyond the last.

    Args:
        steps: at the end of each episode, in order; several may have ended at the same one.
    """
    ends, counts = np.unique(np.append(0.0, steps), return_counts=True)
    numbers = np.cumsum(counts) - 1.0
    return _through(ends, numbers), _through(numbers, ends)


def _through(x: Points, y: Points) -> _Line:
    """Linear between rising points, and with their mean slope before the first and after the last."""
    slope = y[-1] / x[-1]
    return lambda at: np.interp(at, x, y) + slope * (at - np.clip(at, x[0], x[-1]))


def _draw_success(record: RunRecord, figure: Figure) -> str:
    trained = record.of_agent
    if not record.learning_episodes and not trained:
        return ""
    figure.set_size_inches(10, 4.2)
    axes = figure.subplots()
    window = _episode_window(record)
    steps = [e.env_steps for e in record.learning_episodes]
    curves = (
        ("grasped at some step", [e.summary.grasped_once for e in record.learning_episodes]),
        ("solved at some step", [e.summary.success_once for e in record.learning_episodes]),
        ("solved at the end", [e.summary.success_at_end for e in record.learning_episodes]),
    )
    for (label, flags), (color, line) in zip(curves, ((SKY, ":"), (GREEN, "-."), (BLUE, "-")), strict=True):
        if flags:
            axes.plot(steps, causal_mean(np.array(flags, dtype=np.float64), window), color=color, ls=line, label=label)
    if trained:
        rate = np.array([e.success_rate for e in trained])
        ends = np.array([e.success_interval for e in trained]).T
        bars = np.abs(ends - rate)
        places = [e.env_steps for e in trained]
        axes.errorbar(
            places,
            rate,
            bars,
            fmt="D",
            color=ORANGE,
            capsize=3,
            markersize=5,
            label="evaluation, solved at the end, 95 %",
        )
    axes.set(ylabel=f"share of the last {window} episodes", ylim=(-0.02, 1.02))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    steps_axis(axes)
    axes.legend(loc="upper left")
    return f"Share of the last {window} training episodes with a grasp and solved; evaluations with Wilson intervals."


def _draw_reward_terms(record: RunRecord, figure: Figure) -> str:
    names = record.reward_term_names
    if not record.learning_episodes or len(names) < 2:
        return ""
    figure.set_size_inches(10, 4.2)
    left, right = figure.subplots(1, 2)
    window = _episode_window(record)
    steps = np.array([e.env_steps for e in record.learning_episodes], dtype=np.float64)
    sums = np.array([e.summary.reward_terms for e in record.learning_episodes], dtype=np.float64)
    lengths = np.array([e.summary.length for e in record.learning_episodes], dtype=np.float64)[:, None]
    smooth = np.stack([causal_mean(column, window) for column in (sums / np.maximum(lengths, 1)).T])
    for (color, line), name, curve in zip(LINES * len(names), names, smooth, strict=False):
        left.plot(steps, curve, color=color, ls=line, label=name)
    left.set(title="(a) reward of a step", ylabel="mean, unscaled", ylim=(0, None))
    left.legend(ncols=2)
    share = smooth / np.maximum(smooth.sum(axis=0), 1e-12)
    colors = [color for color, _ in LINES * len(names)][: len(names)]
    right.stackplot(steps, share, colors=colors, labels=names, alpha=0.85, edgecolor="white", linewidth=0.6)
    right.set(title="(b) share of the reward", ylim=(0, 1))
    right.yaxis.set_major_formatter(PercentFormatter(1.0))
    right.margins(x=0)
    right.grid(False)
    for axes in (left, right):
        steps_axis(axes)
    order = ", ".join(names)
    return f"Components of the reward ({order}; in (b) from bottom to top), mean of the last {window} episodes."


def _draw_panels(record: RunRecord, figure: Figure, panels: tuple[tuple[str, tuple[str, ...], bool], ...]) -> list[str]:
    """Small plots of metrics over environment steps; gives the titles of those that have numbers."""
    found = [(title, keys, log) for title, keys, log in panels if any(len(record.series(k)[0]) for k in keys)]
    if not found:
        return []
    columns = min(3, len(found))
    rows = -(-len(found) // columns)
    figure.set_size_inches(10, 2.7 * rows + 0.4)
    cells = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, (title, keys, log) in zip(cells, found, strict=False):
        for (color, line), key in zip(LINES, keys, strict=False):
            steps, values = record.series(key)
            words = key if len({METRICS[k].role for k in keys}) > 1 else key.split("_", 1)[1]
            label = words.replace("_", " ") if len(keys) > 1 else None
            if len(steps):
                axes.plot(steps, causal_mean(values, _window(values)), color=color, ls=line, label=label)
                if np.ptp(values) == 0 and values[0]:
                    axes.set_ylim(*sorted((0.0, 2 * values[0])))
        axes.set(title=title, ylabel=unit if (unit := METRICS[next(iter(keys))].unit) != "1" else "value")
        if log:
            axes.set_yscale("log")
        if len(keys) > 1:
            axes.legend(fontsize=8)
        steps_axis(axes)
    for axes in cells[len(found) :]:
        axes.remove()
    return [title for title, _, _ in found]


def _draw_learner(record: RunRecord, figure: Figure) -> str:
    gradients = tuple(f"learner_{part}_gradient_norm" for part in ("critic", "value", "actor", "encoder"))
    panels = (
        ("critic and value loss", ("learner_critic_loss", "learner_value_loss"), True),
        ("actor loss", ("learner_actor_loss",), False),
        ("Q, V and target", ("learner_q_mean", "learner_value_mean", "learner_target_mean"), False),
        ("entropy", ("learner_entropy_nats",), False),
        ("temperature", ("learner_temperature",), False),
        ("gradient norms", gradients, True),
        ("FiLM gain and shift", ("learner_film_gain", "learner_film_shift"), False),
        ("age of the acting weights", ("weights_age_updates",), False),
        ("age of sampled steps", ("replay_sample_age_steps",), False),
    )
    titles = _draw_panels(record, figure, panels)
    return f"Health of the learner over environment steps: {', '.join(titles)}." if titles else ""


def _draw_throughput(record: RunRecord, figure: Figure) -> str:
    panels = (
        ("environment", ("worker_env_steps_per_s",), False),
        ("learner", ("learner_updates_per_s",), False),
        ("updates per step", ("limiter_ratio", "limiter_target_ratio"), False),
        ("time spent waiting", ("worker_wait_share", "learner_wait_share"), False),
        ("memory", ("run_memory_bytes", "replay_stored_bytes"), False),
        ("replay", ("replay_stored_steps",), False),
    )
    titles = _draw_panels(record, figure, panels)
    for axes in figure.axes:
        values_axis(axes)
    return f"Speed and balance of the run over environment steps: {', '.join(titles)}." if titles else ""


_FIGURES: tuple[tuple[str, str, Callable[[RunRecord, Figure], str]], ...] = (
    ("return", "Return", _draw_return),
    ("success", "Success", _draw_success),
    ("pretraining", "Pre-training", _draw_pretraining),
    ("reward_terms", "Reward components", _draw_reward_terms),
    ("learner", "Learner health", _draw_learner),
    ("throughput", "Throughput", _draw_throughput),
)
