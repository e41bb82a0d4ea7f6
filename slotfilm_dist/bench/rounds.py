"""Interleaved rounds: contenders take turns, so that what else the machine does meets all of them alike."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True, slots=True)
class Spread:
    """A median with the smallest and the largest value behind it."""

    median: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.median:.3g} ({self.low:.3g} to {self.high:.3g})"


class Rounds:
    """Rates of contenders, one a round.

    Args:
        rates: for each contender its rate in every round, the more the better; as many for all.
    """

    def __init__(self, rates: Mapping[str, list[float]]) -> None:
        lengths = {len(values) for values in rates.values()}
        assert len(lengths) == 1, "every contender takes part in every round"
        assert lengths != {0}, "one round at least"
        self._rates = {name: np.asarray(values, np.float64) for name, values in rates.items()}

    @property
    def num_rounds(self) -> int:
        """Rounds behind every number."""
        return len(next(iter(self._rates.values())))

    def rate(self, name: str) -> Spread:
        """A contender's rate."""
        return _spread(self._rates[name])

    def ratio(self, name: str, over: str) -> Spread:
        """How many times faster one is than another: the ratio in each round, then the median of the ratios."""
        return _spread(self._rates[name] / self._rates[over])

    def describe(self, name: str, over: str, unit: str) -> str:
        """Both rates and the ratio with their ranges, for `how`."""
        return (
            f"{name} {self.rate(name)} {unit}, {over} {self.rate(over)} {unit}; "
            f"ratio {self.ratio(name, over)} over {self.num_rounds} interleaved rounds"
        )


def interleave(contenders: Mapping[str, Callable[[], float]], num_rounds: int) -> Rounds:
    """Let contenders take turns; the order turns round from one round to the next.

    Args:
        contenders: each does a fixed piece of work when called and gives its rate; warmed up by one call beforehand.
        num_rounds: rounds that count.
    """
    names = list(contenders)
    for name in names:
        contenders[name]()
    rates: dict[str, list[float]] = {name: [] for name in names}
    for index in range(num_rounds):
        for name in names if index % 2 == 0 else reversed(names):
            rates[name].append(contenders[name]())
    return Rounds(rates)


def _spread(values: np.ndarray) -> Spread:
    return Spread(median=float(np.median(values)), low=float(values.min()), high=float(values.max()))
