"""Reward components (Figure 9, Table 2), probes (Table 3), and success with a corrupted camera, which is new."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from slotfilm_dist.evaluation import page_parts as html
from slotfilm_dist.evaluation.figure_style import LINES
from slotfilm_dist.evaluation.reward_windows import TABLE_TERMS, WINDOWS, component_rows, window_rows
from slotfilm_dist.evaluation.statistics import wilson_interval
from slotfilm_dist.evaluation.study import paper
from slotfilm_dist.evaluation.study.blocks import Block, Commands, Missing, Picture, Printed, Section, Table
from slotfilm_dist.evaluation.study.collection import StudyRun
from slotfilm_dist.evaluation.study.curves import draw_lines
from slotfilm_dist.evaluation.study.draft import NONE, Draft, mean_and_deviation, shown
from slotfilm_dist.evaluation.study.estimates import curve_band, estimate_iqm, held_curve
from slotfilm_dist.evaluation.study.how_to import measure_command, measured_otherwise, train_commands
from slotfilm_dist.evaluation.study.measurements import Measurement, in_one_way, measured
from slotfilm_dist.variants import VARIANTS


def components_section(draft: Draft, item: paper.Item) -> Section:
    """Figure 9: reach, post-grasp and place over training, of the proposed agent."""
    section = Section(anchor=item.anchor, title=f"{item.number}: {item.title}")
    runs = [run for run in draft.study.of("slotfilm") if _has_terms(run)]
    if runs:
        by_run = [(run, component_rows(run.record)) for run in runs]
        grid = np.linspace(0, max(rows[-1]["env_steps"] for _, rows in by_run), 200)

        def draw(axes: Axes) -> None:
            for name, (color, line) in zip(TABLE_TERMS, LINES, strict=False):
                curves = np.stack([_component(rows, name, grid) for _, rows in by_run])
                middle, low, high = curve_band(curves)
                axes.fill_between(grid, low, high, color=color, alpha=0.15, linewidth=0)
                axes.plot(grid, middle, color=color, linestyle=line, label=name.replace("_", " "))
            axes.set_ylim(bottom=0)
            axes.legend(loc="upper left")

        panel = ("", "mean of a step, largest = 1", draw)
        path = draw_lines([panel], draft.picture(item.anchor), xlabel="environment steps")
        text = (
            f"Components divided by their largest value, exponential moving average, of slotfilm; interquartile mean "
            f"over seeds ({len(runs)} at hand) with a 95 % bootstrap band, which a single seed does not have."
        )
        section.blocks.extend(
            [Picture(path=path, title=item.title, text=text), draft.made_by(run.record for run in runs)]
        )
        draft.tables[item.anchor] = [{"seed": run.seed} | row for run, rows in by_run for row in rows]
    section.blocks.append(Printed(lines=item.printed))
    if not runs:
        section.blocks.append(_no_components(draft))
    return section


def windows_section(draft: Draft, item: paper.Item) -> Section:
    """Table 2: shares of the components in three thirds of training, of the proposed agent."""
    section = Section(anchor=item.anchor, title=f"{item.number}: {item.title}")
    runs = [run for run in draft.study.of("slotfilm") if _has_terms(run)]
    of_run = [(run, [r for r in window_rows(run.record) if r["share_of"] == "table_2"]) for run in runs]
    draft.tables[item.anchor] = [{"seed": run.seed} | row for run, rows in of_run for row in rows]
    rows, absent = [], []
    for window in WINDOWS:
        for term in TABLE_TERMS:
            here = [r for _, rs in of_run for r in rs if (r["window"], r["component"]) == (window, term)]
            mean, deviation = paper.TABLE_2[window, term]
            if not here:
                absent.append(window)
                continue
            values = [r["mean_percent"] for r in here]
            rows.append(
                (
                    f"{window}, {term.replace('_', ' ')}",
                    f"{mean} ± {deviation}",
                    shown(estimate_iqm(values), 1),
                    html.number(float(np.mean([r["std_percent"] for r in here]))),
                    ", ".join(html.number(value) for value in values),
                )
            )
    if rows:
        caption = (
            "Percent of reach, post-grasp and place together, of slotfilm. Here: windows are thirds of the planned "
            "steps, means and deviations are over episodes (the paper's over steps, so its deviations are larger)."
        )
        head = ("window, component", "the paper", "here, IQM over seeds", "deviation within a run", "each seed")
        section.blocks.extend(
            [Table(caption=caption, head=head, rows=tuple(rows)), draft.made_by(run.record for run in runs)]
        )
    lines = () if rows else tuple(_window_in_words(window) for window in WINDOWS)
    section.blocks.append(Printed(lines=(*item.printed, *lines)))
    if not runs:
        section.blocks.append(_no_components(draft))
    elif absent:
        text = f"No episode in the window {', '.join(dict.fromkeys(absent))}: the data was collected by another run."
        section.blocks.append(Missing(text=text))
    return section


def probes_section(draft: Draft, item: paper.Item) -> Section:
    """Table 3: linear probes of the four variants, beside the paper's."""
    section = Section(anchor=item.anchor, title=f"{item.number}: {item.title}")
    runs = [run for name in item.variants for run in draft.study.of(name)]
    found, left_out = in_one_way(measured(runs, "probe/*/probes.json"))
    draft.tables[item.anchor] = [line for m in found for line in _probe_lines(m)]
    labels = [label for _, label in paper.PROBE_SCORES]
    rows: list[tuple[str, ...]] = []
    for name in item.variants:
        printed = (*paper.TABLE_3[name], NONE, NONE)
        of_variant = [m for m in found if m.run.variant == name]
        if found:
            rows.append((f"{name}, the paper", "3", *printed, NONE))
        for latent in ("policy_input", "visual"):
            if probes := [p for m in of_variant if (p := m.values.get("probes", {}).get(latent))]:
                rows.append((f"{name}, {latent.replace('_', ' ')}", str(len(probes)), *_probe_cells(probes)))
    if found:
        caption = (
            f"Mean ± standard deviation over seeds, on the frames “{found[0].folder.name}”. The paper's “policy input” "
            "or “visual” is not said; both are given. |x|: printed without its sign. Null: AUROC with shuffled labels."
        )
        head = ("variant, latent", "seeds", *labels, "null")
        commands = tuple(measure_command(m.run, "probe RUN", m.options) for m in found)
        table = Table(caption=caption, head=head, rows=tuple(rows))
        section.blocks.extend([table, Commands(text="Measured by", commands=commands)])
        section.blocks.extend(measured_otherwise(left_out, found[0], "probe RUN"))
    lines = () if found else tuple(_in_words(name, labels, paper.TABLE_3[name]) for name in item.variants)
    section.blocks.append(Printed(lines=(*item.printed, *lines)))
    section.blocks.extend(_unprobed(draft, item, found, left_out))
    return section


def robustness_section(draft: Draft) -> Section:
    """Success of policies with a corrupted camera, by variant; empty without measurements."""
    section = Section(anchor="robustness", title="Success with a corrupted camera")
    runs = [run for name in VARIANTS for run in draft.study.of(name)]
    found, left_out = in_one_way(measured(runs, "robustness/policy.json"))
    pooled: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for m in found:
        for name, episodes in m.values.get("episodes", {}).items():
            pooled.setdefault((m.run.variant, name), []).extend(episodes)
    rows = []
    for (variant, corruption), episodes in pooled.items():
        solved = sum(bool(e.get("success_at_end")) for e in episodes)
        low, high = wilson_interval(solved, len(episodes))
        returns = 10 * float(np.mean([e.get("episode_return", 0.0) for e in episodes]))
        share = f"{html.percent(solved / len(episodes))} {html.interval(100 * low, 100 * high, ' %')}"
        rows.append((f"{variant}, {corruption}", f"{solved} of {len(episodes)}", share, html.number(returns, 0)))
    if rows:
        caption = "All seeds together, with 95 % Wilson intervals; return at reward scale 10. Not in the paper."
        head = ("variant, pictures", "solved at end", "share", "return")
        command = "evaluate RUN --what robustness"
        commands = tuple(measure_command(m.run, command, m.options) for m in found)
        table = Table(caption=caption, head=head, rows=tuple(rows))
        section.blocks.extend([table, Commands(text="Measured by", commands=commands)])
        section.blocks.extend(measured_otherwise(left_out, found[0], command))
        draft.tables["robustness"] = [
            {"variant": m.run.variant, "seed": m.run.seed} | row for m in found for row in m.values.get("rows", [])
        ]
    return section


def _in_words(name: str, labels: Sequence[str], values: Sequence[str]) -> str:
    """A printed row for a table that cannot be shown."""
    return f"{name}: " + ", ".join(f"{label} {value}" for label, value in zip(labels, values, strict=False))


def _window_in_words(window: str) -> str:
    values = [f"{mean} ± {std} %" for mean, std in (paper.TABLE_2[window, term] for term in TABLE_TERMS)]
    return _in_words(window, [term.replace("_", " ") for term in TABLE_TERMS], values)


def _has_terms(run: StudyRun) -> bool:
    try:
        return bool(window_rows(run.record))
    except ValueError:
        return False


def _no_components(draft: Draft) -> Missing:
    if draft.study.of("slotfilm"):
        return Missing(text="The task's reward has no components reach, post-grasp and place.")
    commands = train_commands(draft.study, ["slotfilm"])
    return Missing(text="No run of slotfilm is over; the components are its.", commands=commands)


def _component(rows: Sequence[dict[str, Any]], name: str, grid: np.ndarray) -> np.ndarray:
    steps = np.array([row["env_steps"] for row in rows], dtype=np.float64)
    return held_curve(steps, np.array([row.get(f"{name}_smoothed", np.nan) for row in rows]), grid, 1)


def _probe_cells(probes: Sequence[dict[str, Any]]) -> list[str]:
    scores = [[value.get("value") for value in _scores(probes, key)] for key, _ in paper.PROBE_SCORES]
    nulls = [p["contact_auroc"].get("null") for p in probes]
    return [*(mean_and_deviation(values) for values in scores), mean_and_deviation(nulls)]


def _scores(probes: Sequence[dict[str, Any]], key: str) -> list[dict[str, Any]]:
    """A score of each probe as `probes.json` has it."""
    change = key.removeprefix("auroc_change_")
    return [p["auroc_change"].get(change, {}) if change != key else p.get(key, {}) for p in probes]


def _probe_lines(m: Measurement) -> list[dict[str, Any]]:
    return [
        {"variant": m.run.variant, "seed": m.run.seed, "latent": latent, "score": key}
        | {"value": score.get("value"), "null": score.get("null")}
        for latent, probes in m.values.get("probes", {}).items()
        if probes
        for key, _ in paper.PROBE_SCORES
        for score in _scores([probes], key)
    ]


def _unprobed(
    draft: Draft, item: paper.Item, found: Sequence[Measurement], left_out: Sequence[Measurement]
) -> list[Block]:
    """What the table lacks: variants without a run, and runs of variants without any probe."""
    blocks: list[Block] = []
    untrained = [name for name in item.variants if not draft.study.of(name)]
    if untrained:
        text = f"No run that is over: {', '.join(untrained)}."
        blocks.append(Missing(text=text, commands=train_commands(draft.study, untrained)))
    probed = {m.run.variant for m in (*found, *left_out)}
    waiting = [run for name in item.variants if name not in probed for run in draft.study.of(name)]
    if waiting:
        commands = tuple(measure_command(run, "probe RUN", found[0].options if found else None) for run in waiting)
        names = ", ".join(dict.fromkeys(run.variant for run in waiting))
        text = f"Not probed: {names}." if found else "No agent was probed."
        blocks.append(Missing(text=text, commands=commands))
    return blocks
