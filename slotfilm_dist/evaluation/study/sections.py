"""All parts of a study's report, in order. Every figure and table of the paper has exactly one, shown or missing."""

from collections.abc import Iterator

from slotfilm_dist.evaluation import page_parts as html
from slotfilm_dist.evaluation.study.blocks import Block, Commands, Missing, Section, Table, Text
from slotfilm_dist.evaluation.study.draft import NONE, Draft
from slotfilm_dist.evaluation.study.how_to import train_commands
from slotfilm_dist.evaluation.study.measured_items import (
    components_section,
    probes_section,
    robustness_section,
    windows_section,
)
from slotfilm_dist.evaluation.study.numbers import training_returns
from slotfilm_dist.evaluation.study.paper import ITEMS, Item
from slotfilm_dist.evaluation.study.picture_items import picture_section, pretraining_section
from slotfilm_dist.evaluation.study.return_items import curve_section, extra_curves, results_section
from slotfilm_dist.evaluation.study.table_items import settings_rows, table_section

PAPER_STEPS = 1_200_000
_FEW_SEEDS = 5


def write_sections(draft: Draft) -> list[Section]:
    """The whole report; draws its figures and fills the draft's tables on the way."""
    items = [item_section(draft, item) for item in ITEMS]
    return [
        _overview(draft, items),
        results_section(draft),
        *items,
        *(section for section in _beyond(draft) if section.blocks),
        _settings(draft),
        _runs(draft),
    ]


def item_section(draft: Draft, item: Item) -> Section:
    """The part of one figure or table of the paper."""
    if item.kind == "curves":
        return curve_section(draft, item)
    if item.kind == "pictures":
        return picture_section(draft, item)
    if item.kind == "pretraining":
        return pretraining_section(draft, item)
    if item.kind == "components":
        return components_section(draft, item)
    if item.number == "Table 2":
        return windows_section(draft, item)
    return probes_section(draft, item) if item.number == "Table 3" else table_section(draft, item)


def _overview(draft: Draft, items: list[Section]) -> Section:
    """What was run, how far it is from the paper's budget, and which items it supports."""
    study, reference = draft.study, draft.study.reference
    schedule, env = reference.config.schedule, reference.config.env
    seeds = sorted({len(study.of(name)) for name in study.variants})
    counts = "No run is over yet"
    if seeds:
        many = (
            "1 seed" if seeds == [1] else f"{seeds[0]} seeds" if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]} seeds"
        )
        counts = f"Over, with {many} each: {', '.join(study.variants)}"
    section = Section(anchor="overview", title="What was run")
    share = html.percent(schedule.total_steps / PAPER_STEPS, 1 if schedule.total_steps < PAPER_STEPS / 10 else 0)
    text = (
        f"{counts}. A run has {html.number(schedule.total_steps, 0)} environment steps, {share} "
        f"of the paper's {html.number(PAPER_STEPS, 0)}, in episodes of {env.max_steps} steps (the paper's have 400). "
    )
    section.blocks.append(Text(text=text + _caution(seeds, schedule.total_steps)))
    section.blocks.append(
        Text(
            text="The measures were fixed before any run: the mean return of the last 100 training episodes and the "
            "area under the return's curve, over seeds as interquartile mean with a 95 % stratified bootstrap "
            "interval; success of deterministic episodes on held-out seeds with a Wilson interval. The paper's numbers "
            "come from a single run of each variant and have no interval."
        )
    )
    if study.unfinished:
        names = ", ".join(run.path.name for run in study.unfinished)
        section.blocks.append(Text(text=f"Not over, drawn dotted and in no number: {names}."))
    rows = tuple((part.title, _coverage(part), " ".join(m.text for m in part.missing) or NONE) for part in items)
    num_shown = sum(part.is_shown for part in items)
    caption = f"{num_shown} of the paper's {len(items)} figures and tables can be shown from these runs."
    section.blocks.append(Table(caption=caption, head=("item", "here", "what is missing"), rows=rows))
    commands = list(dict.fromkeys(c for part in items for m in part.missing for c in m.commands))
    if untrained := _untrained(draft):
        commands = [*train_commands(study, untrained), *(c for c in commands if c.split()[1] not in ("grid", "train"))]
    if commands:
        section.blocks.append(Commands(text="What would make the missing ones", commands=tuple(commands)))
    return section


def _caution(seeds: list[int], total_steps: int) -> str:
    words = []
    if seeds and seeds[0] < _FEW_SEEDS:
        words.append("With fewer than five seeds, intervals are too narrow and no ranking is settled.")
    if total_steps < PAPER_STEPS:
        words.append("Returns at this budget cannot confirm or refute the paper's final ones.")
    return " ".join(words)


def _coverage(part: Section) -> str:
    if not part.is_shown:
        return "missing"
    return "in part" if part.missing else "shown"


def _untrained(draft: Draft) -> list[str]:
    """Variants that some figure or table wants and that have no run."""
    wanted = dict.fromkeys(name for item in ITEMS for name in item.variants)
    return [name for name in wanted if not draft.study.of(name)]


def _beyond(draft: Draft) -> Iterator[Section]:
    """Comparisons that the paper does not make."""
    yield extra_curves(
        draft,
        "fair-baselines",
        "Beyond the paper: pixel baselines that see the state",
        "The paper's pixel baselines do not see the robot's state. These do, beside those that do not.",
        ("slotfilm", "cnn", "cnn_state", "drq", "drq_state", "drqv2", "drqv2_state"),
        needs=("cnn_state", "drq_state", "drqv2_state"),
    )
    yield extra_curves(
        draft,
        "slots",
        "Beyond the paper: number and competition of slots",
        "The paper shows pictures of four slots (Figures 14 and 15) but no return.",
        ("slotfilm", "slots_4", "slots_competitive"),
        needs=("slots_4", "slots_competitive"),
    )
    yield extra_curves(
        draft,
        "validation",
        "Beyond the paper: an agent that is told where the objects are",
        "Validates task and learner; no part of the study.",
        ("slotfilm", "state_only", "oracle_state"),
        needs=("oracle_state",),
    )
    yield robustness_section(draft)


def _settings(draft: Draft) -> Section:
    section = Section(anchor="settings", title="Settings")
    rows = settings_rows(draft.study.reference.config)
    if not rows:
        section.blocks.append(Text(text="Every field has the value that the project reads from the paper."))
        return section
    caption = (
        f"Fields of {draft.study.reference.variant} that differ from the project's reading of the paper; variants "
        "differ from it as `slotfilm variants` says."
    )
    section.blocks.append(Table(caption=caption, head=("field", "the paper's reading", "here"), rows=rows))
    return section


def _runs(draft: Draft) -> Section:
    """Every run with its numbers, what was left out and why."""
    study = draft.study
    section = Section(anchor="runs", title="Runs")
    by_path = {r.run.path: r for n in draft.numbers for r in n.runs}
    rows = []
    for run in (*study.runs, *study.unfinished):
        r = by_path.get(run.path)
        rows.append(
            (
                f"{run.variant}, seed {run.seed}",
                run.path.name,
                "over" if run.is_over else "not over",
                html.number(run.env_steps, 0),
                str(len(training_returns(run)[0])),
                html.number(r.last_return, 0) if r else NONE,
                html.number(r.area, 0) if r else NONE,
                f"{r.num_solved} of {r.num_evaluated}" if r else NONE,
            )
        )
    caption = "Episodes are those of the learning policy; returns at reward scale 10."
    head = ("variant, seed", "directory", "state", "env steps", "episodes", "last 100", "area", "solved at end")
    blocks: list[Block] = [Table(caption=caption, head=head, rows=tuple(rows))]
    short = [run for run in study.runs if 0 < len(training_returns(run)[0]) < 100]
    if short:
        text = "Some runs have fewer than 100 episodes of their own policy; “last 100” is then the mean of all of them."
        blocks.append(Text(text=text))
    blocks += [Missing(text=line) for line in study.left_out]
    blocks.append(draft.made_by(run.record for run in (*study.runs, *study.unfinished)))
    section.blocks.extend(blocks)
    return section
