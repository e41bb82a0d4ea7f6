"""Pieces of HTML that a report is put together from; every text is escaped, every file travels inside the page."""

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

_MINUS = "\N{MINUS SIGN}"
_NO_BREAK = "\N{NO-BREAK SPACE}"
_MEDIA_TYPES = {".png": "image/png", ".mp4": "video/mp4"}


def data_uri(path: Path) -> str:
    """The file's content as a URI, so that the page needs no other file."""
    return f"data:{_MEDIA_TYPES[path.suffix]};base64,{base64.b64encode(path.read_bytes()).decode()}"


def section(anchor: str, title: str, *parts: str) -> str:
    """A section with a heading that links can reach; nothing when all of its parts are empty."""
    body = "\n".join(part for part in parts if part)
    return f'<section id="{anchor}">\n<h2>{escape(title)}</h2>\n{body}\n</section>' if body else ""


def paragraph(text: str, kind: str = "") -> str:
    """A paragraph of plain text."""
    return f'<p class="{kind}">{escape(text)}</p>' if kind else f"<p>{escape(text)}</p>"


def card(title: str, value: str, notes: Sequence[str], quality: str = "") -> str:
    """A number that matters, with what it must be compared to.

    Args:
        title: what it is.
        value: the number with its unit.
        notes: lines below it.
        quality: `good`, `bad` or empty; colours the edge, while the notes say it in words.
    """
    body = f'<p class="value">{escape(value)}</p>{bullets(notes)}'
    return f'<div class="card {quality}"><h3>{escape(title)}</h3>{body}</div>'


def table(head: Sequence[str], rows: Sequence[Sequence[str]], caption: str = "") -> str:
    """A table whose first column names the row; columns of numbers align to the right."""
    if not rows:
        return ""
    columns = list(zip(*rows, strict=True))
    kinds = ["", *(' class="number"' if all(map(_is_number, column)) else "" for column in columns[1:])]
    top = "".join(f'<th scope="col"{kind}>{escape(title)}</th>' for title, kind in zip(head, kinds, strict=True))
    lines = []
    for first, *cells in rows:
        line = "".join(f"<td{kind}>{escape(cell)}</td>" for cell, kind in zip(cells, kinds[1:], strict=True))
        lines.append(f'<tr><th scope="row">{escape(first)}</th>{line}</tr>')
    title = f"<caption>{escape(caption)}</caption>" if caption else ""
    body = "".join(lines)
    return f'<div class="wide"><table>{title}<thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def _is_number(cell: str) -> bool:
    return cell[:1].isdigit() or cell[:1] in ("+", _MINUS)


def folded(title: str, body: str) -> str:
    """A part that is closed until it is asked for."""
    return f"<details><summary>{escape(title)}</summary>\n{body}\n</details>" if body else ""


def code(text: str) -> str:
    """Text as it was typed or written."""
    return f"<pre><code>{escape(text)}</code></pre>"


def bullets(items: Sequence[str]) -> str:
    """A list of sentences."""
    return "<ul>" + "".join(f"<li>{escape(item)}</li>" for item in items) + "</ul>" if items else ""


def picture(path: Path, title: str, text: str) -> str:
    """A picture with its caption; the text also serves who cannot see it."""
    return (
        f'<figure><img src="{data_uri(path)}" alt="{escape(f"{title}. {text}", quote=True)}">'
        f"<figcaption><strong>{escape(title)}.</strong> {escape(text)}</figcaption></figure>"
    )


def video(path: Path, poster: Path | None, text: str) -> str:
    """A video with controls, shown as its poster until it plays."""
    still = f' poster="{data_uri(poster)}"' if poster else ""
    label = escape(text, quote=True)
    return (
        f'<figure><video controls muted loop playsinline preload="metadata" aria-label="{label}"{still}'
        f' src="{data_uri(path)}"></video><figcaption>{escape(text)}</figcaption></figure>'
    )


def number(value: float | int, digits: int = 1) -> str:
    """A number for people: thousands separated, a true minus sign."""
    return f"{value:,.{digits}f}".replace("-", _MINUS).replace(",", _NO_BREAK)


def short(value: float | int) -> str:
    """A number of unknown size, to six digits."""
    return f"{value:.6g}".replace("-", _MINUS)


def signed(value: float | int, digits: int = 1) -> str:
    """A difference, with its sign."""
    return ("+" if value >= 0 else "") + number(value, digits)


def interval(low: float, high: float, unit: str = "", digits: int = 1) -> str:
    """Both ends of an interval, never broken over two lines."""
    return f"[{number(low, digits)}, {number(high, digits)}]{unit}".replace(" ", _NO_BREAK)


def percent(share: float | int, digits: int = 0) -> str:
    """A share as percentage."""
    return f"{100 * share:.{digits}f}{_NO_BREAK}%"


def duration(seconds: float | int) -> str:
    """A time span in the two units that matter."""
    minutes, hours = seconds / 60, seconds / 3600
    if hours >= 48:
        return f"{int(hours // 24)} d {int(hours % 24)} h"
    if hours >= 1:
        return f"{int(hours)} h {int(minutes % 60)} min"
    return f"{int(minutes)} min {int(seconds % 60)} s" if minutes >= 1 else f"{seconds:.0f} s"
