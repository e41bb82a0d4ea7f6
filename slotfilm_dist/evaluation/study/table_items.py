"""Settings and machines beside the paper's: Table 1 and Tables A1 to A4, from configs, `versions.json` and costs."""

import dataclasses
import shlex
from collections.abc import Mapping
from typing import Any

import numpy as np

from slotfilm_dist.config import RunConfig
from slotfilm_dist.envs.tasks import TASKS
from slotfilm_dist.evaluation import page_parts as html
from slotfilm_dist.evaluation.study import paper
from slotfilm_dist.evaluation.study.blocks import Commands, Missing, Printed, Section, Table
from slotfilm_dist.evaluation.study.draft import NONE, Draft
from slotfilm_dist.evaluation.study.measurements import COST_FILE

_HEAD = ("what", "the paper", "here")


def table_section(draft: Draft, item: paper.Item) -> Section:
    """One of these tables."""
    section = Section(anchor=item.anchor, title=f"{item.number}: {item.title}")
    {
        "Table 1": _environment,
        "Table A1": _hyperparameters,
        "Table A2": _machines,
        "Table A3": _costs,
        "Table A4": _cameras,
    }[item.number](draft, section)
    if item.printed:
        section.blocks.append(Printed(lines=item.printed))
    return section


def _environment(draft: Draft, section: Section) -> None:
    config = draft.study.reference.config
    task = TASKS.get(config.env.task)
    here = {
        "Robot model": f"ManiSkill's {task.robot}" if task else NONE,
        "Camera setup": f"wrist camera, {config.env.image_size} x {config.env.image_size}, "
        f"render profile {config.env.render_profile}",
        "State vector": f"{config.obs.state_dim}-D: {', '.join(config.obs.state_fields)}",
        "Action space": f"{config.env.control_mode}",
        "Objects": f"{', '.join(task.objects) if task else config.obs.num_objects}, {config.env.assets} meshes; "
        f"goal {config.env.goal}",
        "Simulator": f"ManiSkill {draft.study.reference.record.versions.get('mani_skill', '?')}, {config.env.task}",
    }
    rows = tuple((name, printed, here.get(name, NONE)) for name, printed in paper.TABLE_1)
    caption = f"Of {draft.study.reference.variant}; read from the runs' configs."
    section.blocks.append(Table(caption=caption, head=_HEAD, rows=rows))


def _hyperparameters(draft: Draft, section: Section) -> None:
    config = draft.study.reference.config
    rows = []
    for name, printed, path in paper.TABLE_A1:
        value, theirs = value_at(config, path), value_at(RunConfig(), path)
        rows.append((name, printed, _plain(value), "same" if value == theirs else "differs", path))
    caption = (
        f"Of {draft.study.reference.variant}. Settings that the paper leaves open, and all others that differ from "
        "the project's reading of it, are listed under Settings."
    )
    head = ("parameter", "the paper", "here", "compared", "field")
    section.blocks.append(Table(caption=caption, head=head, rows=tuple(rows)))


def _machines(draft: Draft, section: Section) -> None:
    everyone = [run.record.versions for run in (*draft.study.runs, *draft.study.unfinished)]
    rows = []
    for name, printed, key in paper.TABLE_A2:
        found = dict.fromkeys(str(v[key]) for v in everyone if key and v.get(key))
        rows.append((name, printed, "; ".join(found) or NONE))
    if not any(everyone):
        text = "The runs have no versions.json, so their machine is unknown."
        section.blocks.append(Missing(text=text, commands=("slotfilm doctor",)))
        return
    section.blocks.append(Table(caption="As the runs noted when they began.", head=_HEAD, rows=tuple(rows)))


def _costs(draft: Draft, section: Section) -> None:
    command = f"slotfilm cost --json > {shlex.quote(str(draft.study.folder / COST_FILE))}"
    proposed = next((row for row in draft.costs if row.get("variant") == "slotfilm"), None)
    if proposed is None:
        text = f"The study's folder holds no {COST_FILE} with a row of slotfilm."
        lines = tuple(f"{name}: {printed}" for name, printed, _ in paper.TABLE_A3)
        section.blocks.extend([Printed(lines=lines), Missing(text=text, commands=(command,))])
        return
    draft.tables[section.anchor] = [dict(row) for row in draft.costs]
    rows = []
    for name, printed, key in paper.TABLE_A3:
        value = _quantity(proposed, key)
        if key == "latency_ms_mean" and "latency_ms_std" in proposed:
            value += f" ± {html.number(proposed['latency_ms_std'], 2)}"
        rows.append((name, printed, value))
    caption = f"slotfilm, measured on {proposed.get('device', 'an unnamed device')}; the paper on an RTX A6000. "
    caption += "Peak memory on a CPU is that of the whole process, libraries included."
    section.blocks.append(Table(caption=caption, head=_HEAD, rows=tuple(rows)))
    every = tuple(
        (str(row.get("variant")), *(_quantity(row, key) for _, _, key in paper.TABLE_A3), str(row.get("device", "")))
        for row in draft.costs
    )
    head = ("variant", *(name.replace(" (A.3)", "") for name, _, _ in paper.TABLE_A3), "device")
    section.blocks.append(Table(caption="Cost of every variant", head=head, rows=every, folded=True))
    section.blocks.append(Commands(text="Measured by", commands=(command,)))


def _cameras(draft: Draft, section: Section) -> None:
    env = draft.study.reference.config.env
    here = {
        "Field of view": f"{env.fov_deg:g}°",
        "Resolution": f"{env.image_size} x {env.image_size}",
        "Model": "pinhole, no distortion",
        "Near / far": f"{env.near_m:g} m / {env.far_m:g} m",
        "Mount": "wrist camera of the task's robot",
    }
    rows = tuple((name, wrist, here[name], phone) for name, wrist, phone in paper.TABLE_A4)
    head = ("what", "the paper's wrist camera", "here", "the paper's phone, Galaxy Note 20")
    caption = "The phone was used for Figure 6 alone; no phone was used here."
    section.blocks.append(Table(caption=caption, head=head, rows=rows))


def value_at(config: Any, path: str) -> Any:
    """The field of a config at a dotted path."""
    for name in path.split("."):
        config = getattr(config, name)
    return config


def _plain(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(str, value))
    if isinstance(value, int) and not isinstance(value, bool):
        return html.number(value, 0)
    return np.format_float_positional(value, trim="-") if isinstance(value, float) else str(value)


def _quantity(row: Mapping[str, Any], key: str) -> str:
    value = row.get(key)
    if not isinstance(value, int | float):
        return NONE
    if key.endswith("params"):
        return f"{value / 1e6:.2f} M" if value >= 1e4 else html.number(value, 0)
    return html.number(value, 2 if key.startswith("latency") else 1)


def settings_rows(config: RunConfig) -> tuple[tuple[str, str, str], ...]:
    """Fields that differ from the project's reading of the paper, but for places, seeds and evaluation."""
    paper_config = RunConfig()
    aside = ("variant", "seed", "runtime", "checkpoint", "evaluation")
    rows = []
    for section in (f.name for f in dataclasses.fields(config) if f.name not in aside):
        ours, theirs = getattr(config, section), getattr(paper_config, section)
        if not dataclasses.is_dataclass(ours):
            rows += [(section, _plain(theirs), _plain(ours))] if ours != theirs else []
            continue
        for field in dataclasses.fields(ours):
            a, b = getattr(theirs, field.name), getattr(ours, field.name)
            if a != b:
                rows.append((f"{section}.{field.name}", _plain(a), _plain(b)))
    return tuple(rows)
