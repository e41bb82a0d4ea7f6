"""Pieces of HTML that a report is put together from; every text is escaped, every file travels inside the page."""

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

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
        quality: `good`, `bad` or empty; shown as a mark in words too, never by colour alone.
    """
    lines = "".join(f"<li>{escape(note)}</li>" for note in notes)
    return (
        f'<div class="card {quality}"><h3>{escape(title)}</h3><p class="value">{escape(value)}</p><ul>{lines}</ul></div>'
    )


def table(head: Sequence[str], rows: Sequence[Sequence[str]], caption: str = "") -> str:
    """A table whose first column names the row; cells that start with a digit or sign align to the right."""
    if not rows:
        return ""
    top = "".join(f'<th scope="col">{escape(h)}</th>' for h in head)
    body = "".join(f"<tr>{_cells(row)}</tr>" for row in rows)
    title = f"<caption>{escape(caption)}</caption>" if caption else ""
    return f'<div class="wide"><table>{title}<thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def _cells(row: Sequence[str]) -> str:
    first = f'<th scope="row">{escape(row[0])}</th>'
    return first + "".join(
        f'<td class="number">{escape(cell)}</td>' if cell[:1].isdigit() or cell[:1] in "+−" else f"<td>{escape(cell)}</td>"
        for cell in row[1:]
    )


def folded(title: str, body: str) -> str:
    """A part that is closed until it is asked for; printed open."""
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
    """A video with controls; printed as its poster where it has one."""
    still = f' poster="{data_uri(poster)}"' if poster else ""
    label = escape(text, quote=True)
    return (
        f'<figure><video controls muted loop playsinline preload="metadata" aria-label="{label}"{still}'
        f' src="{data_uri(path)}"></video><figcaption>{escape(text)}</figcaption></figure>'
    )


def number(value: float | int, digits: int = 1) -> str:
    """A number for people: thousands separated, a true minus sign."""
    return f"{value:,.{digits}f}".replace("-", "−").replace(",", "\u00a0")


def signed(value: float | int, digits: int = 1) -> str:
    """A difference, with its sign."""
    return ("+" if value >= 0 else "") + number(value, digits)


def percent(share: float | int, digits: int = 0) -> str:
    """A share as percentage."""
    return f"{100 * share:.{digits}f} %"


def duration(seconds: float | int) -> str:
    """A time span in the two units that matter."""
    minutes, hours = seconds / 60, seconds / 3600
    if hours >= 48:
        return f"{int(hours // 24)} d {int(hours % 24)} h"
    if hours >= 1:
        return f"{int(hours)} h {int(minutes % 60)} min"
    return f"{int(minutes)} min {int(seconds % 60)} s" if minutes >= 1 else f"{seconds:.0f} s"
