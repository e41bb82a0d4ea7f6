"""Tables of a report: evaluations, reward components, episodes, metrics."""

import numpy as np

from slotfilm_dist.evaluation import page_parts as html
from slotfilm_dist.evaluation.record import Evaluation, RunRecord
from slotfilm_dist.metrics import METRICS

_STAGES = ("early third", "middle third", "late third")


def success_interval(evaluation: Evaluation) -> str:
    """Wilson's interval of the evaluation's success, in %."""
    low, high = evaluation.success_interval
    return html.interval(100 * low, 100 * high, " %")


def share(evaluation: Evaluation, flag: str) -> str:
    """Share of the evaluation's episodes with that flag of `EpisodeSummary`, in %."""
    return html.percent(sum(getattr(e, flag) for e in evaluation.episodes) / max(len(evaluation.episodes), 1))


def evaluation_table(record: RunRecord) -> str:
    """Every evaluation of the run, oldest policy first."""
    head = ("evaluation", "policy", "env steps", "episodes", "return ± s.d.", "solved at end, 95 %")
    rows = [
        (
            e.name,
            e.policy,
            html.number(e.env_steps, 0),
            str(len(e.episodes)),
            f"{html.number(e.mean_return)} ± {html.number(e.std_return)}",
            f"{html.percent(e.success_rate)} {success_interval(e)}",
            share(e, "success_once"),
            share(e, "placed_at_end"),
            share(e, "grasped_once"),
        )
        for e in record.evaluations
    ]
    return html.table((*head, "solved once", "placed at end", "grasped"), rows, "Evaluations on held-out seeds.")


def reward_table(record: RunRecord) -> str:
    """How the reward is made up early, midway and late in training (Table 2)."""
    names = record.reward_term_names
    if len(names) < 2 or len(record.learning_episodes) < len(_STAGES):
        return ""
    sums = np.array([e.summary.reward_terms for e in record.learning_episodes], dtype=np.float64)
    percents = 100 * sums / np.maximum(sums.sum(axis=1, keepdims=True), 1e-12)
    rows = [
        (stage, *(f"{part[:, i].mean():.1f} ± {part[:, i].std():.1f}" for i in range(len(names))))
        for stage, part in zip(_STAGES, np.array_split(percents, len(_STAGES)), strict=True)
    ]
    return html.table(
        ("training", *names), rows, "Share of each component in an episode's reward, in %, mean ± s.d. over episodes."
    )


def episode_table(record: RunRecord) -> str:
    """Every episode of the newest evaluation beside the random policy on the same seed."""
    best = record.best_known
    if best is None:
        return ""
    random = record.evaluation("random")
    theirs = random.returns_by_seed if random else {}
    rows = [
        (
            str(e.seed),
            html.number(e.episode_return),
            html.number(theirs[e.seed]) if e.seed in theirs else "not played",
            str(e.length),
            *("yes" if flag else "no" for flag in (e.success_at_end, e.success_once, e.placed_at_end, e.grasped_once)),
        )
        for e in best.episodes
    ]
    head = ("seed", "return", "random policy", "steps", "solved at end", "solved once", "placed at end", "grasped")
    return html.folded(f"Every episode of the evaluation “{best.name}”", html.table(head, rows))


def metric_table(record: RunRecord) -> str:
    """The last value of every metric, with its meaning."""
    keys = dict.fromkeys(key for line in record.lines for key in line)
    rows = []
    for key in sorted(keys, key=lambda k: list(METRICS).index(k.split("/")[0]) if k.split("/")[0] in METRICS else -1):
        metric, value = METRICS.get(key.split("/")[0]), record.last(key)
        if metric and value is not None:
            rows.append((key, html.short(value), metric.unit, metric.help))
    return html.folded("Last value of every metric", html.table(("metric", "value", "unit", "meaning"), rows))
