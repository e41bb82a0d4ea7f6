"""What a fault should do, what it did, and the table of both."""

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass


class UnexpectedError(Exception):
    """Something that should have followed a fault did not; the message says what."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Observation:
    """What followed a fault."""

    observed: str
    """In words."""
    figure: str
    """The measured numbers, with their limits."""
    holds: bool
    """All of it is as expected."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Outcome:
    """One row of the table."""

    fault: str
    expected: str
    observed: str
    figure: str
    holds: bool


def as_line(outcome: Outcome) -> str:
    """A row as soon as it is known."""
    return f"{'holds' if outcome.holds else 'FAILS'}  {outcome.fault}: {outcome.observed}; {outcome.figure}"


def as_text(outcomes: Sequence[Outcome]) -> str:
    """The table for a terminal: a few lines for each fault."""
    lines: list[str] = []
    for outcome in outcomes:
        lines += [
            f"{'holds' if outcome.holds else 'FAILS':<6} {outcome.fault}",
            f"         expected  {outcome.expected}",
            f"         observed  {outcome.observed}",
            f"         figure    {outcome.figure}",
        ]
    failed = sum(not outcome.holds for outcome in outcomes)
    return "\n".join([*lines, f"{len(outcomes)} faults, {failed} not as expected"])


def as_markdown(outcomes: Sequence[Outcome]) -> str:
    """The table for a page."""
    rows = [
        f"| {o.fault} | {o.expected} | {o.observed} | {o.figure} | {'yes' if o.holds else '**no**'} |" for o in outcomes
    ]
    return "\n".join(["| fault | expected | observed | figure | holds |", "|---|---|---|---|---|", *rows])


def as_json(outcomes: Sequence[Outcome], seed: int) -> str:
    """The table for a program."""
    return json.dumps({"seed": seed, "outcomes": [dataclasses.asdict(outcome) for outcome in outcomes]}, indent=1)
