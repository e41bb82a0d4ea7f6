"""Intervals and curves: what turns episodes into statements with their uncertainty."""

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from jaxtyping import Bool, Float64

_NUM_RESAMPLES = 10_000


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval of a success rate, as two shares; (0, 1) without any trial.

    Unlike the normal approximation it stays inside [0, 1] and is honest about 0 or all of a few episodes.

    Raises:
        ValueError: counts that cannot be, or a confidence outside (0, 1).
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"successes = {successes}: must lie in [0, trials = {trials}]")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence = {confidence}: must lie between 0 and 1, such as 0.95")
    if trials == 0:
        return 0.0, 1.0
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    rate = successes / trials
    centre = rate + z**2 / (2 * trials)
    half = z * math.sqrt(rate * (1 - rate) / trials + z**2 / (4 * trials**2))
    scale = 1 + z**2 / trials
    return max(0.0, (centre - half) / scale), min(1.0, (centre + half) / scale)


def bootstrap_mean_interval(
    values: Float64[np.ndarray, " samples"], rng: np.random.Generator, confidence: float = 0.95
) -> tuple[float, float]:
    """Percentile bootstrap interval of the mean of independent samples, in their unit.

    Raises:
        ValueError: no samples.
    """
    if len(values) == 0:
        raise ValueError("values is empty: an interval needs at least one sample")
    picks = rng.integers(len(values), size=(_NUM_RESAMPLES, len(values)))
    low, high = np.quantile(values[picks].mean(axis=1), [(1 - confidence) / 2, (1 + confidence) / 2])
    return float(low), float(high)


@dataclass(frozen=True, kw_only=True, slots=True)
class PairedDifference:
    """How much better one policy did than another on the same seeds."""

    mean: float
    """Mean of the differences."""
    interval: tuple[float, float]
    """95 % bootstrap interval of the mean."""
    num_pairs: int
    """Seeds that both policies played."""
    num_better: int
    """Seeds on which the first policy did strictly better."""


def paired_difference(ours: dict[int, float], theirs: dict[int, float], rng: np.random.Generator) -> PairedDifference:
    """Compare two policies by the seeds that both played; luck of the draw cancels out.

    Args:
        ours: return by seed.
        theirs: return by seed.
        rng: draws the bootstrap's resamples.

    Raises:
        ValueError: no seed in common.
    """
    seeds = sorted(ours.keys() & theirs.keys())
    if not seeds:
        raise ValueError("the two policies have no seed in common: evaluate both with the same evaluation.seed")
    differences = np.array([ours[s] - theirs[s] for s in seeds], dtype=np.float64)
    return PairedDifference(
        mean=float(differences.mean()),
        interval=bootstrap_mean_interval(differences, rng),
        num_pairs=len(seeds),
        num_better=int((differences > 0).sum()),
    )


def causal_mean(values: Float64[np.ndarray, " points"], window: int) -> Float64[np.ndarray, " points"]:
    """Mean of each point and the `window - 1` before it: a curve that never shows a rise before it happened.

    The first points average what there is.

    Raises:
        ValueError: a window below 1.
    """
    if window < 1:
        raise ValueError(f"window = {window}: must be 1 or more points")
    sums = np.concatenate([[0.0], np.cumsum(values)])
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(ends - window, 0)
    return (sums[ends] - sums[starts]) / (ends - starts)


def not_superseded(steps: Float64[np.ndarray, " points"]) -> Bool[np.ndarray, " points"]:
    """Which points a resumed run has kept.

    A run that resumes from a checkpoint goes back some steps and writes them again; the points that a later one
    overtook on its way from behind are history that never happened to the final policy.
    """
    return steps <= np.minimum.accumulate(steps[::-1])[::-1]
