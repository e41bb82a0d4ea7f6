"""What a report is made of, before it becomes HTML or Markdown."""

from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True, kw_only=True, slots=True)
class Text:
    """A paragraph."""

    text: str


@dataclass(frozen=True, kw_only=True, slots=True)
class Table:
    """Rows of cells; the first column names the row."""

    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    folded: bool = False
    """Closed in the page until it is asked for; print and Markdown show it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Picture:
    """A figure in a file of its own."""

    path: Path
    title: str
    text: str
    """What it shows, for its caption and for who cannot see it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Printed:
    """What the paper printed about the thing beside it."""

    lines: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Commands:
    """Commands, each with what it is for."""

    text: str
    commands: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Missing:
    """Something that the runs at hand cannot show."""

    text: str
    commands: tuple[str, ...] = ()
    """What would make it."""


Block = Text | Table | Picture | Printed | Commands | Missing


@dataclass(frozen=True, kw_only=True, slots=True)
class Section:
    """A headed part of the report. One that stands for an item of the paper is shown or missing, never both."""

    anchor: str
    title: str
    blocks: list[Block] = field(default_factory=list)

    @property
    def is_shown(self) -> bool:
        """Whether the runs have something to show here."""
        return any(isinstance(block, Picture | Table) for block in self.blocks)

    @property
    def missing(self) -> tuple[Missing, ...]:
        """What this part lacks."""
        return tuple(block for block in self.blocks if isinstance(block, Missing))
