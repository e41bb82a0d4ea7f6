"""The report as one HTML page that holds its pictures itself and asks no server for anything."""

from collections.abc import Sequence
from pathlib import Path

from slotfilm_dist.evaluation import page_parts as html
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

_OPEN_COMMANDS = 3
"""More commands than these are folded."""
_STYLE = Path(__file__).parents[1] / "page.css"


def render_html(title: str, subtitle: str, sections: Sequence[Section]) -> str:
    """The page."""
    links = "".join(f'<li><a href="#{s.anchor}">{html.escape(_short(s))}</a></li>' for s in sections)
    parts = "\n".join(html.section(s.anchor, s.title, *_bodies(s)) for s in sections)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)}</title>\n<style>\n{_STYLE.read_text(encoding='utf-8')}</style>\n</head>\n<body>\n"
        f"<header><h1>{html.escape(title)}</h1>{html.paragraph(subtitle, 'muted')}</header>\n"
        f'<nav aria-label="Sections"><ul>{links}</ul></nav>\n<main>\n{parts}\n</main>\n</body>\n</html>\n'
    )


def _short(section: Section) -> str:
    """A section's name in the list of links: an item's number, else its title."""
    number, colon, _ = section.title.partition(": ")
    if colon and number.startswith(("Figure", "Table")):
        return number + ("" if section.is_shown else " (missing)")
    return section.title.removeprefix("Beyond the paper: ").capitalize()


def _bodies(section: Section) -> list[str]:
    return [_body(block, section.anchor) for block in section.blocks]


def _body(block: Block, anchor: str) -> str:
    match block:
        case Text():
            return html.paragraph(block.text)
        case Picture():
            return html.picture(block.path, block.title, block.text)
        case Table():
            if block.folded:
                return html.folded(block.caption, html.table(block.head, block.rows))
            return (
                _linked(html.table(block.head, block.rows, block.caption))
                if anchor == "overview"
                else (html.table(block.head, block.rows, block.caption))
            )
        case Printed():
            return (
                f'<aside class="printed" aria-label="The paper"><h3>The paper</h3>{html.bullets(block.lines)}</aside>'
            )
        case Commands():
            return _commands(block.text, block.commands)
        case Missing():
            commands = _commands("Would be made by", block.commands) if block.commands else ""
            return f'<div class="missing"><p>{html.escape(block.text)}</p>{commands}</div>'


def _commands(text: str, commands: Sequence[str]) -> str:
    code = html.code("\n".join(commands))
    if len(commands) > _OPEN_COMMANDS:
        return html.folded(f"{text}: {len(commands)} commands", code)
    return html.paragraph(f"{text}:", "muted") + code


def _linked(table: str) -> str:
    """The overview's table with every item's name as a link to its part."""
    out = []
    for part in table.split('<th scope="row">'):
        name, end, rest = part.partition("</th>")
        number = name.partition(": ")[0]
        is_item = bool(end) and number.startswith(("Figure", "Table"))
        link = f'<a href="#{number.lower().replace(" ", "-")}">{name}</a>' if is_item else name
        out.append(link + end + rest)
    return '<th scope="row">'.join(out)
