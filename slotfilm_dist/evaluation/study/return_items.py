"""Learning curves and their numbers (Figures 7, 10 to 13, 16, A1), the same beyond the paper, and all results."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from slotfilm_dist.config import RunConfig
from slotfilm_dist.envs.reward_bounds import max_reward
from slotfilm_dist.evaluation import page_parts as html
from slotfilm_dist.evaluation.study.blocks import Block, Missing, Picture, Printed, Section, Table, Text
from slotfilm_dist.evaluation.study.curves import (
    VariantCurve,
    draw_points,
    draw_returns,
    return_curves,
    smoothing_window,
)
from slotfilm_dist.evaluation.study.draft import NONE, Draft, shown
from slotfilm_dist.evaluation.study.how_to import train_commands
from slotfilm_dist.evaluation.study.numbers import PAPER_STEPS, VariantNumbers
from slotfilm_dist.evaluation.study.paper import NOT_PRINTED, Item

_HEAD = ("variant", "seeds", "last 100 episodes", "highest", "area", "P(last > slotfilm)", "P(area > slotfilm)")
_OWN_REWARD = {"varpi_1", "varpi_10", "no_static", "alpha_5", "alpha_15"}
"""Variants whose return is measured with a reward of their own."""


def curve_section(draft: Draft, item: Item) -> Section:
    """A figure of returns, shown once a variant that it needs has run, be it not over."""
    section = Section(anchor=item.anchor, title=f"{item.number}: {item.title}")
    own = item.needs or tuple(name for name in item.variants if name != "slotfilm")
    present = [name for name in item.variants if draft.study.of(name)]
    begun = {run.variant for run in draft.study.unfinished}
    if any(name in present or name in begun for name in own):
        section.blocks.extend(_compared(draft, item.anchor, item.variants, {n: r for n, r, _ in item.returns}))
    section.blocks.extend(_printed(item))
    if absent := [name for name in item.variants if name not in present]:
        text = f"No run that is over: {', '.join(absent)}."
        section.blocks.append(Missing(text=text, commands=train_commands(draft.study, absent)))
    return section


def extra_curves(
    draft: Draft, anchor: str, title: str, text: str, variants: Sequence[str], needs: Sequence[str]
) -> Section:
    """A comparison that the paper does not make; empty unless one of the variants that it needs has run."""
    section = Section(anchor=anchor, title=title)
    if any(draft.study.of(name) for name in needs):
        section.blocks.append(Text(text=text))
        section.blocks.extend(_compared(draft, anchor, variants, {}))
    return section


def _printed(item: Item) -> list[Block]:
    lines = [
        f"{name}: {words}; no return is printed" if value == NOT_PRINTED else f"{name}: {value}, {words}"
        for name, value, words in item.returns
    ]
    return [Printed(lines=(*lines, *item.printed))] if lines or item.printed else []


def _compared(draft: Draft, name: str, variants: Sequence[str], printed: dict[str, str]) -> list[Block]:
    study = draft.study
    runs = [run for variant in variants for run in study.of(variant)]
    cut = [run for variant in variants for run in study.unfinished if run.variant == variant]
    window = smoothing_window(runs or cut)
    curves, dotted = return_curves(runs, window), return_curves(cut, window)
    draft.tables[f"{name}-curves"] = [row for curve in curves for row in _curve_rows(curve)]
    reference = study.reference.config
    path = draw_returns(
        curves,
        dotted,
        draft.picture(name),
        episode_steps=reference.env.max_steps,
        random_steps=reference.schedule.random_steps,
    )
    numbers = draft.numbers_of(variants)
    text = (
        f"Return of training episodes, each point the mean of the {window} episodes before it; bold: interquartile "
        "mean over seeds, band: its 95 % bootstrap interval, thin: the seeds. "
        + " ".join(f"{n.variant} ends at {shown(n.last_return)}." for n in numbers)
    )
    blocks: list[Block] = [Picture(path=path, title=name.replace("-", " ").capitalize(), text=text)]
    if numbers:
        blocks.append(returns_table(numbers, reference, printed))
    if _OWN_REWARD & {n.variant for n in numbers}:
        blocks.append(
            Text(
                text="These variants change the reward itself, and each return is in its own reward, as in the paper: "
                "it ranks them only roughly. Success, which is the same for all, is in the table of results."
            )
        )
    return [*blocks, draft.made_by(run.record for run in (*runs, *cut))]


def _curve_rows(curve: VariantCurve) -> list[dict[str, Any]]:
    kept = np.flatnonzero(np.isfinite(curve.seeds).any(axis=0))
    return [
        {
            "variant": curve.variant,
            "seeds": curve.num_seeds,
            "env_steps": int(curve.steps[i]),
            "iqm": curve.middle[i],
            "low": curve.low[i],
            "high": curve.high[i],
        }
        for i in kept
    ]


def returns_table(numbers: Sequence[VariantNumbers], reference: RunConfig, printed: dict[str, str]) -> Table:
    """Numbers of the variants, beside what the paper printed of each if it printed anything.

    Args:
        numbers: of the variants.
        reference: the config whose episodes and reward stand for all.
        printed: the paper's returns by variant.
    """
    rows = []
    for n in numbers:
        cells = [
            n.variant,
            str(len(n.runs)),
            shown(n.last_return),
            shown(n.highest),
            shown(n.area),
            shown(n.over_proposed, 2) if n.over_proposed else NONE,
            shown(n.area_over_proposed, 2) if n.area_over_proposed else NONE,
        ]
        rows.append(
            (*cells, printed.get(n.variant, NONE).replace(" ", "\N{NO-BREAK SPACE}")) if printed else tuple(cells)
        )
    episode_steps = reference.env.max_steps
    highest = html.number(10 * max_reward(reference.reward) * episode_steps, 0)
    bound = f"At most {highest} in an episode of {episode_steps} steps"
    other = f", {html.number(10 * PAPER_STEPS, 0)} in the paper's of {PAPER_STEPS}" if episode_steps != 400 else ""
    caption = (
        "Return at reward scale 10, interquartile mean over seeds with 95 % stratified bootstrap interval, which a "
        f"single seed does not have. {bound}"
        f"{other}. Area: mean height of the curve over the steps that the variant and slotfilm both have."
    )
    return Table(caption=caption, head=(*_HEAD, "the paper") if printed else _HEAD, rows=tuple(rows))


def results_section(draft: Draft) -> Section:
    """Every variant side by side: final return, area, success."""
    section = Section(anchor="results", title="Results of all variants")
    numbers = list(draft.numbers)
    if not numbers:
        section.blocks.append(Missing(text="No run is over yet, so there are no numbers, only curves."))
        return section
    draft.tables["variants"] = [_variant_row(n) for n in numbers]
    draft.tables["runs"] = [_run_row(n, i) for n in numbers for i in range(len(n.runs))]
    path = draw_points(
        numbers,
        draft.picture("final-return"),
        xlabel="mean return of the last 100 episodes, reward scale 10",
        points=lambda n: [r.last_return for r in n.runs],
        middle=lambda n: (n.last_return.value, *n.last_return.interval),
    )
    text = "Dots: seeds. Bar: interquartile mean; line: its 95 % stratified bootstrap interval, none for one seed."
    section.blocks.append(Picture(path=path, title="Final return", text=text))
    section.blocks.append(returns_table(numbers, draft.study.reference.config, {}))
    path = draw_points(
        numbers,
        draft.picture("success"),
        xlabel="episodes solved at their end, final evaluation",
        points=lambda n: [r.num_solved / max(r.num_evaluated, 1) for r in n.runs],
        middle=lambda n: n.success,
        shares=True,
    )
    text = "Dots: seeds. Bar: share of all episodes of all seeds; line: its 95 % Wilson interval."
    section.blocks.append(Picture(path=path, title="Success", text=text))
    section.blocks.append(_success_table(numbers))
    return section


def _success_table(numbers: Sequence[VariantNumbers]) -> Table:
    rows = []
    for n in numbers:
        rate, low, high = n.success
        once = sum(e.success_once for r in n.runs for e in _final(r))
        placed = sum(e.placed_at_end for r in n.runs for e in _final(r))
        total = max(n.num_evaluated, 1)
        seeds = ", ".join(html.percent(r.num_solved / max(r.num_evaluated, 1)) for r in n.runs)
        printed = {"slotfilm": "92 % of 50 (6.2)", "drqv2": "0 (A.5)"}.get(n.variant, NONE)
        rows.append(
            (
                n.variant,
                str(len(n.runs)),
                f"{n.num_solved} of {n.num_evaluated}",
                f"{html.percent(rate)} {html.interval(100 * low, 100 * high, ' %')}",
                html.percent(once / total),
                html.percent(placed / total),
                seeds,
                printed,
            )
        )
    caption = (
        "Deterministic episodes of the final policy on held-out seeds, with 95 % Wilson intervals over episodes. "
        "Episodes of one seed share a policy: with few seeds the interval says more of these policies than of the "
        "method."
    )
    head = ("variant", "seeds", "solved at end", "share", "solved once", "placed at end", "each seed", "the paper")
    return Table(caption=caption, head=head, rows=tuple(rows))


def _final(numbers: Any) -> Sequence[Any]:
    final = numbers.run.record.final
    return final.episodes if final else ()


def _variant_row(n: VariantNumbers) -> dict[str, Any]:
    row: dict[str, Any] = {"variant": n.variant, "seeds": len(n.runs)}
    estimates = {
        "last_return": n.last_return,
        "highest": n.highest,
        "area": n.area,
        "improvement_last_return": n.over_proposed,
        "improvement_area": n.area_over_proposed,
    }
    for name, estimate in estimates.items():
        low, high = estimate.interval if estimate else (None, None)
        row |= {name: estimate.value if estimate else None, f"{name}_low": low, f"{name}_high": high}
    rate, low, high = n.success
    return row | {
        "area_until_step": n.runs[0].until,
        "solved": n.num_solved,
        "evaluated": n.num_evaluated,
        "success": rate,
        "success_low": low,
        "success_high": high,
    }


def _run_row(n: VariantNumbers, index: int) -> dict[str, Any]:
    r = n.runs[index]
    return {
        "variant": n.variant,
        "seed": r.run.seed,
        "run": r.run.path.name,
        "env_steps": r.run.env_steps,
        "last_return": r.last_return,
        "highest": r.highest,
        "area": r.area,
        "area_until_step": r.until,
        "solved": r.num_solved,
        "evaluated": r.num_evaluated,
        "command": r.run.command,
    }
