"""What a measurement says: a number, its goal, and in words what was compared."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, kw_only=True, slots=True)
class BenchResult:
    """One row of `slotfilm bench`."""

    name: str
    """What was measured, as `subject/quantity`."""
    measured: float | None
    """The number; None where it could not be measured here."""
    goal: float | None
    """What it should reach; None for a number that only informs."""
    holds: bool | None
    """Whether it does; None without a goal or a number."""
    unit: str
    """Of both numbers; `times` for ratios."""
    how: str
    """What was compared with what, and the range; of a row without a number, why and how to mend it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class BenchOptions:
    """What the command line asks of every subject."""

    rounds: int = 5
    """Interleaved rounds."""
    quick: bool = False
    """A tenth of the work, to see that everything runs; the numbers mean little."""

    def __post_init__(self) -> None:
        if self.rounds < 1:
            raise ValueError(f"--rounds {self.rounds}: must be 1 or more")

    def scaled(self, count: int) -> int:
        """So many repetitions, or a tenth of them with `quick`."""
        return max(1, count // 10) if self.quick else count


def at_least(name: str, measured: float, goal: float, unit: str, how: str) -> BenchResult:
    """A number that should be large."""
    return BenchResult(name=name, measured=measured, goal=goal, holds=measured >= goal, unit=unit, how=how)


def at_most(name: str, measured: float, goal: float, unit: str, how: str) -> BenchResult:
    """A number that should be small."""
    return BenchResult(name=name, measured=measured, goal=goal, holds=measured <= goal, unit=unit, how=how)


def for_information(name: str, measured: float, unit: str, how: str) -> BenchResult:
    """A number without a goal."""
    return BenchResult(name=name, measured=measured, goal=None, holds=None, unit=unit, how=how)


def not_measured(name: str, goal: float | None, unit: str, why: str) -> BenchResult:
    """A row that this machine cannot fill; says why and what would change that."""
    return BenchResult(name=name, measured=None, goal=goal, holds=None, unit=unit, how=f"not measured: {why}")


def worst_first(results: Sequence[BenchResult]) -> list[BenchResult]:
    """Rows that fall short first, then those not measured, those that hold, and those without a goal."""

    def rank(result: BenchResult) -> int:
        if result.holds is not None:
            return 2 if result.holds else 0
        return 1 if result.measured is None else 3

    return sorted(results, key=rank)


def as_json(results: Sequence[BenchResult]) -> dict[str, Any]:
    """The object that `--json` prints."""
    return {"results": [dataclasses.asdict(result) for result in results]}
