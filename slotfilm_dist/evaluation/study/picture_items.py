"""Pictures: pre-training (Figure 3), attention and positions (4, 5, 14, 15), a real camera (6), an episode (8)."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from slotfilm_dist.evaluation import page_parts as html
from slotfilm_dist.evaluation.figure_style import BLUE
from slotfilm_dist.evaluation.record import RunRecord
from slotfilm_dist.evaluation.statistics import causal_mean
from slotfilm_dist.evaluation.study.blocks import Block, Commands, Missing, Picture, Printed, Section, Table
from slotfilm_dist.evaluation.study.collection import StudyRun
from slotfilm_dist.evaluation.study.curves import draw_lines
from slotfilm_dist.evaluation.study.draft import NONE, Draft
from slotfilm_dist.evaluation.study.how_to import measure_command, measured_otherwise, train_commands
from slotfilm_dist.evaluation.study.measurements import Measurement, in_one_way, measured, take_picture
from slotfilm_dist.evaluation.study.paper import Item

_QUALITY = (
    ("position_error_px", "position error (px)", 1),
    ("baseline_error_px", "predicting the mean (px)", 1),
    ("attention_nll", "attention NLL (nats)", 2),
    ("visibility_bce", "visibility BCE (nats)", 3),
    ("visibility_auroc", "visibility AUROC", 3),
)
_LOSSES = (
    ("pretrain_position_loss", "(a) position", "loss"),
    ("pretrain_attention_loss", "(b) attention", "nats"),
    ("pretrain_visibility_loss", "(c) visibility", "nats"),
)
_MOST_FILMS = 3
_PERCEPTION = "evaluate RUN --what perception"
_PREFERRED = ("-pretrained", "-last")


def picture_section(draft: Draft, item: Item) -> Section:
    """A figure of pictures that a measurement of one run has left."""
    section = Section(anchor=item.anchor, title=f"{item.number}: {item.title}")
    runs = _runs(draft, item)
    find = {
        "Figure 4": lambda: _perceived(draft, item, runs, "attention.png"),
        "Figure 14": lambda: _perceived(draft, item, runs, "attention.png"),
        "Figure 5": lambda: _perceived(draft, item, runs, "positions.png"),
        "Figure 15": lambda: _perceived(draft, item, runs, "positions.png"),
        "Figure 6": lambda: _camera(draft, item, runs),
        "Figure 8": lambda: _films(draft, item, runs),
    }[item.number]
    blocks = find() if runs else []
    section.blocks.extend([*blocks, Printed(lines=item.printed)])
    if not blocks:
        section.blocks.append(_lacking(draft, item, runs))
    return section


def pretraining_section(draft: Draft, item: Item) -> Section:
    """Figure 3: the losses of every pre-training at hand, and the errors on held-out frames."""
    section = Section(anchor=item.anchor, title=f"{item.number}: {item.title}")
    runs = _runs(draft, item)
    records = [r for r in (*draft.study.makers, *(run.record for run in runs)) if _pretrained(r)]
    if records:
        section.blocks.append(_losses(draft, item, records))
    found, left_out = in_one_way(measured(runs, "perception/*/quality.json"), _PREFERRED)
    if found:
        section.blocks.extend([_quality_table(draft, found), _perception_command(found)])
        section.blocks.extend(measured_otherwise(left_out, found[0], _PERCEPTION))
    if records:
        section.blocks.append(draft.made_by(records))
    section.blocks.append(Printed(lines=item.printed))
    if not records:
        text = "No run at hand has logged pre-training; those that took an encoder from the artifacts have not."
        commands = train_commands(draft.study, item.variants)
        section.blocks.append(Missing(text=text, commands=(*commands[:1],)))
    if not found:
        text = "Errors on held-out frames: perception of the proposed agent was not measured."
        commands = (measure_command(runs[0], _PERCEPTION),) if runs else ()
        section.blocks.append(Missing(text=text, commands=commands))
    return section


def _runs(draft: Draft, item: Item) -> list[StudyRun]:
    """Runs of the item's first variant; those that are over first."""
    unfinished = [run for run in draft.study.unfinished if run.variant == item.variants[0]]
    return [*draft.study.of(item.variants[0]), *unfinished]


def _lacking(draft: Draft, item: Item, runs: Sequence[StudyRun]) -> Missing:
    if not runs:
        text = f"No run of {item.variants[0]} has trained."
        return Missing(text=text, commands=train_commands(draft.study, item.variants[:1]))
    what, command = {
        "Figure 6": ("A real camera was not looked at", "perceive SOURCE --checkpoint RUN --out RUN/perceive/NAME.png"),
        "Figure 8": ("No film strip was made", "evaluate RUN --what film_strips"),
    }.get(item.number, ("Perception was not measured", _PERCEPTION))
    text = f"{what} with any run of {item.variants[0]}."
    return Missing(text=text, commands=(measure_command(runs[0], command),))


def _perceived(draft: Draft, item: Item, runs: Sequence[StudyRun], name: str) -> list[Block]:
    found, _ = in_one_way([m for m in measured(runs, "perception/*/quality.json") if _there(m, name)], _PREFERRED)
    if not found:
        return []
    first = found[0]
    path = take_picture(first.folder / name, draft.picture(item.anchor))
    quality = first.values.get("quality", {}).get("clean", {})
    swaps = first.values.get("swaps", {}).get("by_position", {}).get("clean", {}).get("rate")
    numbers = f" Position error {_cell(quality.get('position_error_px'), 1)} px; "
    numbers += f"predicting the mean gives {_cell(quality.get('baseline_error_px'), 1)} px"
    if swaps is not None:
        numbers += f"; slots swap in {html.percent(swaps, 1)} of the steps"
    text = f"{_who(first)}, held-out frames “{first.folder.name}”.{numbers}."
    return [Picture(path=path, title=item.title, text=text), _perception_command(found[:1])]


def _there(measurement: Measurement, name: str) -> bool:
    return (measurement.folder / name).is_file()


def _who(measurement: Measurement) -> str:
    run, steps = measurement.run, measurement.values.get("env_steps")
    after = f" after {html.number(steps, 0)} steps" if isinstance(steps, int) and steps else ""
    return f"{run.variant}, seed {run.seed}{after}"


def _perception_command(found: Sequence[Measurement]) -> Commands:
    commands = tuple(measure_command(m.run, _PERCEPTION, m.options) for m in found)
    return Commands(text="Measured by", commands=commands)


def _camera(draft: Draft, item: Item, runs: Sequence[StudyRun]) -> list[Block]:
    """Pictures below `perceive/` of a run: single ones, or the first of each folder."""
    for run in runs:
        folder = run.path / "perceive"
        pictures = [*sorted(folder.glob("*.png")), *(next(iter(sorted(f.glob("*.png")))) for f in _folders(folder))]
        blocks: list[Block] = []
        for index, source in enumerate(pictures[:_MOST_FILMS]):
            path = take_picture(source, draft.picture(f"{item.anchor}-{index + 1}"))
            text = f"{run.variant}, seed {run.seed}, {source.relative_to(folder)}: picture, attention, positions."
            blocks.append(Picture(path=path, title=item.title, text=text))
        if blocks:
            command = measure_command(run, "perceive SOURCE --checkpoint RUN --out RUN/perceive/NAME")
            return [*blocks, Commands(text="Made by", commands=(command,))]
    return []


def _folders(folder: Path) -> list[Path]:
    return [f for f in sorted(folder.glob("*")) if f.is_dir() and any(f.glob("*.png"))]


def _films(draft: Draft, item: Item, runs: Sequence[StudyRun]) -> list[Block]:
    strips = [(run, path) for run in runs for path in sorted(run.path.glob("film_strips/agent-*.png"))]
    blocks: list[Block] = []
    commands: list[str] = []
    for index, (run, source) in enumerate(strips[:_MOST_FILMS]):
        path = take_picture(source, draft.picture(f"{item.anchor}-{index + 1}"))
        seed = source.stem.removeprefix("agent-")
        text = (
            f"{run.variant}, seed {run.seed}, in the episode of seed {seed}. Moments from left to right; each that was "
            "reached is named (reach, grasp, transport, place, hold), the others only numbered."
        )
        blocks.append(Picture(path=path, title="Episode of the trained agent", text=text))
        commands.append(measure_command(run, f"evaluate RUN --what film_strips --seed {seed} --episodes 1"))
    if not blocks:
        return []
    return [*blocks, Commands(text="Made by", commands=tuple(commands))]


def _pretrained(record: RunRecord) -> bool:
    return any(len(record.series(key, "pretrain_steps_total")[0]) for key, _, _ in _LOSSES)


def _losses(draft: Draft, item: Item, records: Sequence[RunRecord]) -> Picture:
    def panel(key: str) -> Callable[[Axes], Any]:
        def draw(axes: Axes) -> None:
            for record in records:
                steps, values = record.series(key, "pretrain_steps_total")
                axes.plot(steps, values, color=BLUE, alpha=0.2, linewidth=0.7)
                axes.plot(steps, causal_mean(values, max(1, len(values) // 25)), color=BLUE, linewidth=1.6)
            low, high = axes.get_ylim()
            axes.set_ylim(min(0.0, low), high + 0.05 * abs(high))

        return draw

    draft.tables[item.anchor] = [
        {"run": record.run_dir.name, "step": int(step), "loss": key.removeprefix("pretrain_"), "value": value}
        for record in records
        for key, _, _ in _LOSSES
        for step, value in zip(*record.series(key, "pretrain_steps_total"), strict=True)
    ]
    panels = [(title, label, panel(key)) for key, title, label in _LOSSES]
    path = draw_lines(panels, draft.picture(item.anchor), xlabel="gradient steps")
    ends = []
    for key, title, _ in _LOSSES:
        last = [v[-1] for v in (r.series(key, "pretrain_steps_total")[1] for r in records) if len(v)]
        ends.append(f"{title[4:]} {np.mean(last):.3g}")
    count = f"{len(records)} pre-trainings" if len(records) > 1 else "one pre-training"
    text = f"Losses of {count} over gradient steps, thin: as logged, bold: causal mean. At the end: {', '.join(ends)}."
    return Picture(path=path, title=item.title, text=text)


def _quality_table(draft: Draft, found: Sequence[Measurement]) -> Table:
    rows, lines = [], []
    for m in found:
        quality, intervals = m.values.get("quality", {}).get("clean", {}), m.values.get("intervals_95", {})
        cells = []
        for key, _, digits in _QUALITY:
            low, high = intervals.get("clean", {}).get(key, (None, None))
            spread = f" {html.interval(low, high, digits=digits)}" if low is not None else ""
            cells.append(_cell(quality.get(key), digits) + spread)
        rows.append((f"{m.run.variant}, seed {m.run.seed}", *cells))
        lines.append({"run": m.run.path.name, "variant": m.run.variant, "seed": m.run.seed} | quality)
    draft.tables["perception"] = lines
    caption = f"Held-out frames “{found[0].folder.name}”; 95 % bootstrap intervals over episodes."
    return Table(caption=caption, head=("run", *(label for _, label, _ in _QUALITY)), rows=tuple(rows))


def _cell(value: float | None, digits: int) -> str:
    return NONE if value is None else html.number(value, digits)
