"""Writes a study's report: report.html, report.md, report.json, `figures/*.png` and `tables/*.csv` in one folder."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from slotfilm_dist.atomic import write_atomic
from slotfilm_dist.evaluation.result_files import write_csv, write_json
from slotfilm_dist.evaluation.study.blocks import Picture, Section
from slotfilm_dist.evaluation.study.collection import Study
from slotfilm_dist.evaluation.study.draft import Draft
from slotfilm_dist.evaluation.study.html_page import render_html
from slotfilm_dist.evaluation.study.markdown import render_markdown
from slotfilm_dist.evaluation.study.measurements import read_costs, read_object
from slotfilm_dist.evaluation.study.numbers import study_numbers
from slotfilm_dist.evaluation.study.paper import ITEMS
from slotfilm_dist.evaluation.study.sections import write_sections

SUMMARY = "report.json"


@dataclass(frozen=True, kw_only=True, slots=True)
class WrittenReport:
    """A report on disk."""

    page: Path
    summary: dict[str, Any]
    """What `report.json` holds."""


def write_study(study: Study, out: Path) -> WrittenReport:
    """Write the report of a study.

    Files of an earlier report that this one does not have are removed; nothing else in the folder is touched.

    Args:
        study: the runs.
        out: folder for the report.

    Raises:
        ValueError: the folder is a run's own, whose page it would replace.
    """
    if (out / "config.json").exists():
        raise ValueError(f"--out {out}: is a run's directory; give the study's report a folder of its own")
    out.mkdir(parents=True, exist_ok=True)
    draft = Draft(study=study, out=out, numbers=study_numbers(study), costs=read_costs(study.folder))
    sections = write_sections(draft)
    title = f"The study in {study.folder.name or study.folder.resolve().name}"
    subtitle = (
        f"{_count(study.runs, 'finished run')}, {_count(study.variants, 'variant')}, set beside “Multi-Slot Attention "
        "with State Guidance for Egocentric Robotic Manipulation” (Electronics 2026, 15, 1365)."
    )
    page = render_html(title, subtitle, sections)
    write_atomic(out / "report.html", [page.encode()])
    write_atomic(out / "report.md", [render_markdown(title, subtitle, sections, out).encode()])
    tables = [write_csv(out / "tables" / f"{name}.csv", rows) for name, rows in _filled(draft.tables).items()]
    pictures = [block.path for section in sections for block in section.blocks if isinstance(block, Picture)]
    files = sorted(path.relative_to(out).as_posix() for path in (*pictures, *tables))
    _remove(out, set(read_object(out / SUMMARY).get("files", ())) - set(files))
    summary = _summary(study, sections, files)
    write_json(out / SUMMARY, summary)
    return WrittenReport(page=out / "report.html", summary=summary)


def _count(things: Sequence[object], name: str) -> str:
    return f"{len(things)} {name}" if len(things) == 1 else f"{len(things)} {name}s"


def _filled(tables: Mapping[str, list[dict[str, Any]]]) -> dict[str, list[dict[str, Any]]]:
    """Tables that have rows, every row with the columns of all."""
    out = {}
    for name, rows in tables.items():
        columns = dict.fromkeys(column for row in rows for column in row)
        if rows:
            out[name] = [{column: row.get(column) for column in columns} for row in rows]
    return out


def _remove(out: Path, files: set[Any]) -> None:
    """Remove files that an earlier report had written to its own two folders."""
    for name in files:
        path = out / str(name)
        if path.parent in (out / "figures", out / "tables"):
            path.unlink(missing_ok=True)


def _summary(study: Study, sections: Sequence[Section], files: Sequence[str]) -> dict[str, Any]:
    by_anchor = {section.anchor: section for section in sections}
    items = []
    for item in ITEMS:
        section = by_anchor[item.anchor]
        missing = [{"text": m.text, "commands": list(m.commands)} for m in section.missing]
        items.append({"item": item.number, "title": item.title, "shown": section.is_shown, "missing": missing})
    return {
        "folder": str(study.folder),
        "runs": [{"variant": r.variant, "seed": r.seed, "run": r.path.name} for r in study.runs],
        "unfinished": [r.path.name for r in study.unfinished],
        "left_out": list(study.left_out),
        "items": items,
        "files": list(files),
    }
