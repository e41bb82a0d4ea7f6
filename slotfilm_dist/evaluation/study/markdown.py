"""The report as Markdown, with its pictures as files beside it."""

import os
from collections.abc import Sequence
from pathlib import Path

from slotfilm_dist.evaluation.study.blocks import (
    Block,
    Commands,
    Missing,
    Picture,
    Printed,
    Section,
    Table,
    Text,
)


def render_markdown(title: str, subtitle: str, sections: Sequence[Section], folder: Path) -> str:
    """The report; pictures are named relative to the folder that it will lie in."""
    parts = [f"# {title}", subtitle]
    for section in sections:
        parts.append(f"## {section.title}")
        parts += [_body(block, folder) for block in section.blocks]
    return "\n\n".join(parts) + "\n"


def _body(block: Block, folder: Path) -> str:
    match block:
        case Text():
            return _plain(block.text)
        case Picture():
            place = Path(os.path.relpath(block.path, folder)).as_posix()
            return f"![{_plain(block.title)}]({place})\n\n*{_plain(block.text)}*"
        case Table():
            return f"{_plain(block.caption)}\n\n{_table(block)}"
        case Printed():
            return "The paper:\n\n" + "\n".join(f"- {_plain(line)}" for line in block.lines)
        case Commands():
            return f"{_plain(block.text)}:\n\n{_code(block.commands)}"
        case Missing():
            return f"**Missing:** {_plain(block.text)}" + (f"\n\n{_code(block.commands)}" if block.commands else "")


def _table(table: Table) -> str:
    lines = [_row(table.head), _row(["---"] * len(table.head)), *(_row(row) for row in table.rows)]
    return "\n".join(lines)


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(_plain(cell) for cell in cells) + " |"


def _plain(text: str) -> str:
    """Text whose signs mean nothing to Markdown, on one line."""
    for sign in ("\\", "|", "*", "_", "<"):
        text = text.replace(sign, f"\\{sign}")
    return " ".join(text.split("\n"))


def _code(lines: Sequence[str]) -> str:
    return "```sh\n" + "\n".join(lines) + "\n```"
