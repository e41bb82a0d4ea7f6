"""Reward components over training: shares in three windows (Table 2) and curves (Figure 9), from a run's episodes.

The paper divides "the logged environment steps into three equal windows" and takes "the mean and standard deviation of
each component's fractional contribution to the total reward over all recorded environment steps". Its rows add up to
100 % over reach, post-grasp and place alone, so that is the total there; the shares of all five components are given
beside it. A run keeps sums over episodes, so mean and deviation here are over episodes, not over steps: the deviation
leaves out the variation within an episode and is smaller than the paper's.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from slotfilm_dist.envs.reward_bounds import largest_terms
from slotfilm_dist.evaluation.figure_style import LINES, STYLE, steps_axis
from slotfilm_dist.evaluation.record import RunRecord
from slotfilm_dist.messages import TrainingEpisode

TABLE_TERMS = ("reach", "post_grasp", "place")
"""Components of Table 2 and Figure 9, in the paper's order."""
WINDOWS = ("early", "mid", "late")
SMOOTHING = 0.98
"""What an exponential moving average keeps of its past at each episode (the paper gives no value)."""

Shares = Float64[np.ndarray, "episodes terms"]


def window_rows(record: RunRecord) -> list[dict[str, Any]]:
    """Table 2: one row for each window and component.

    The windows are thirds of the steps that the run is planned for; one that holds no episode yet gives no rows.
    Episodes of the random policy count nowhere.

    Raises:
        ValueError: the run has no training episodes, or no reward in components.
    """
    episodes, terms, names = _episode_terms(record)
    steps = np.array([e.env_steps for e in episodes])
    total = record.config.schedule.total_steps if record.config else int(steps.max())
    edges = np.linspace(0, total, len(WINDOWS) + 1)
    of_table = [names.index(name) for name in TABLE_TERMS]
    rows = []
    for window, low, high in zip(WINDOWS, edges[:-1], edges[1:], strict=True):
        inside = (steps > low) & (steps <= high)
        if not inside.any():
            continue
        for group, columns in (("table_2", of_table), ("all_components", list(range(len(names))))):
            shares = _shares(terms[inside][:, columns])
            for index, column in enumerate(columns):
                values = shares[:, index]
                rows.append(
                    {
                        "window": window,
                        "from_step": int(low),
                        "to_step": int(high),
                        "share_of": group,
                        "component": names[column],
                        "mean_percent": 100 * values.mean() if len(values) else math.nan,
                        "std_percent": 100 * values.std(ddof=1) if len(values) > 1 else math.nan,
                        "num_episodes": len(values),
                    }
                )
    return rows


def component_rows(record: RunRecord) -> list[dict[str, Any]]:
    """Figure 9: one row for each episode, components divided by their largest value, so that each lies in [0, 1].

    A component of weight 0 is left out.
    """
    if record.config is None:
        raise ValueError(f"{record.run_dir}: config.json is missing; the weights of the reward are unknown")
    episodes, terms, names = _episode_terms(record)
    largest = largest_terms(record.config.reward)
    lengths = np.array([e.summary.length for e in episodes], dtype=np.float64)
    columns = {}
    for index, name in enumerate(names):
        if largest[name] > 0:
            columns[name] = terms[:, index] / lengths / largest[name]
    smooth = {name: moving_average(values, SMOOTHING) for name, values in columns.items()}
    return [
        {"env_steps": episode.env_steps}
        | {name: values[i] for name, values in columns.items()}
        | {f"{name}_smoothed": values[i] for name, values in smooth.items()}
        for i, episode in enumerate(episodes)
    ]


def moving_average(values: Float64[np.ndarray, " points"], keep: float) -> Float64[np.ndarray, " points"]:
    """Exponential moving average of each point and its past, without the pull of a starting value."""
    out, total, weight = np.empty_like(values), 0.0, 0.0
    for i, value in enumerate(values):
        total, weight = keep * total + value, keep * weight + 1.0
        out[i] = total / weight
    return out


def draw_components(rows: Sequence[dict[str, Any]], path: Path) -> Path:
    """Figure 9: reach, post-grasp and place over the environment steps of training."""
    with rc_context(STYLE):
        figure = Figure(figsize=(7, 3.6), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots()
        steps = [row["env_steps"] for row in rows]
        for name, (color, style) in zip(TABLE_TERMS, LINES, strict=False):
            if name in rows[0]:
                axes.plot(steps, [row[name] for row in rows], color=color, alpha=0.2, linewidth=0.7)
                axes.plot(steps, [row[f"{name}_smoothed"] for row in rows], color=color, linestyle=style, label=name)
        axes.set(ylabel="mean of a step, largest = 1", ylim=(0, 1))
        steps_axis(axes)
        axes.legend()
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=150)
    return path


def _episode_terms(record: RunRecord) -> tuple[tuple[TrainingEpisode, ...], Shares, list[str]]:
    """Episodes that the learning policy played, steps at their ends, sums of their components, and those' names.

    The random policy's are left out: only the run that collected its data has them, not those that share it.
    """
    own = record.learning_episodes
    if not own:
        raise ValueError(f"{record.run_dir}: episodes.jsonl holds no training episode yet")
    names: list[str] = list(record.reward_term_names)
    if len(names) == len(_OWN_TERMS) and names[0] == "term 1":
        names = [*_OWN_TERMS]  # the run has not been evaluated yet, which names them
    missing = [name for name in TABLE_TERMS if name not in names]
    if missing:
        raise ValueError(f"{record.run_dir}: its task's reward has no component {', '.join(missing)}")
    return own, np.array([e.summary.reward_terms for e in own], dtype=np.float64), names


def _shares(terms: Shares) -> Float64[np.ndarray, "earning terms"]:
    """Fractions of each episode's total; an episode that earned nothing has none and is left out."""
    total = terms.sum(axis=1, keepdims=True)
    earned = total[:, 0] > 0
    return terms[earned] / total[earned]


_OWN_TERMS: tuple[str, ...] = ("reach", "grasp", "place", "post_grasp", "static")
