"""A report while it is being put together: the study, its numbers, and where pictures and tables go."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from slotfilm_dist.evaluation import page_parts as html
from slotfilm_dist.evaluation.record import RunRecord
from slotfilm_dist.evaluation.study.blocks import Commands
from slotfilm_dist.evaluation.study.collection import Study
from slotfilm_dist.evaluation.study.estimates import Estimate
from slotfilm_dist.evaluation.study.numbers import VariantNumbers

NONE = "-"
"""A cell that has nothing to say."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Draft:
    """What the parts of a report are written from and into."""

    study: Study
    out: Path
    numbers: Sequence[VariantNumbers]
    costs: Sequence[Mapping[str, Any]]
    """Rows of `slotfilm cost --json`."""
    tables: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    """Rows of every CSV file, by its name without suffix."""

    def picture(self, name: str) -> Path:
        """Where a figure of that name goes."""
        return self.out / "figures" / f"{name}.png"

    def numbers_of(self, variants: Sequence[str]) -> list[VariantNumbers]:
        """Numbers of those variants that have any, in the order given."""
        by_name = {n.variant: n for n in self.numbers}
        return [by_name[name] for name in variants if name in by_name]

    def made_by(self, records: Iterable[RunRecord]) -> Commands:
        """What made these runs and jobs: their grids, or each one's own command."""
        commands = self.study.commands_of(records)
        return Commands(text="Made by", commands=commands or ("the runs' versions.json name no command",))


def shown(estimate: Estimate, digits: int = 0) -> str:
    """A number and its interval; the number alone where a single seed leaves no interval."""
    low, high = estimate.interval
    if not math.isfinite(estimate.value):
        return NONE
    digits = max(digits, 1) if abs(estimate.value) < 100 else digits
    value = html.number(estimate.value, digits)
    return f"{value}\N{NO-BREAK SPACE}{html.interval(low, high, digits=digits)}" if math.isfinite(low) else value


def mean_and_deviation(values: Sequence[float | None], digits: int = 3) -> str:
    """Mean ± standard deviation with n - 1 over the values that are defined; the mean alone of a single one."""
    finite = [value for value in values if value is not None and math.isfinite(value)]
    if not finite:
        return NONE
    mean = sum(finite) / len(finite)
    if len(finite) == 1:
        return html.number(mean, digits)
    deviation = math.sqrt(sum((v - mean) ** 2 for v in finite) / (len(finite) - 1))
    return f"{html.number(mean, digits)} ± {html.number(deviation, digits)}"
