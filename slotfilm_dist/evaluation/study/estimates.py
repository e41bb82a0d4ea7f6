"""What seeds say together: interquartile mean, stratified bootstrap, probability of improvement, area under a curve.

The estimators follow Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice" (2021).
With a handful of seeds every interval is rough, and a bootstrap of fewer than five is too narrow: always read the
number of seeds and the points beside it.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from slotfilm_dist.evaluation.statistics import causal_mean

NUM_RESAMPLES = 2000
SEED_OF_RESAMPLES = 0
"""The same runs always give the same intervals."""

Scores = Float64[np.ndarray, "*resamples seeds"]
Others = Float64[np.ndarray, "*resamples others"]
Drawn = Sequence[Float64[np.ndarray, "*resamples _"]]
Statistic = Callable[[Drawn], Float64[np.ndarray, " *resamples"]]
"""Takes one array for each stratum, seeds last, and gives a value for each resample."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Estimate:
    """A number over seeds with its uncertainty."""

    value: float
    interval: tuple[float, float]
    """95 % stratified bootstrap interval; NaN where a stratum has a single seed, which says nothing of its spread."""
    num_seeds: int
    """Seeds of the first stratum."""


def iqm(scores: Scores) -> Float64[np.ndarray, " *resamples"]:
    """Interquartile mean over the last axis: the mean of the middle half of the scores.

    A score that the quartile cuts through counts in part, so that exactly half of the weight is dropped whatever the
    number of scores; one or two scores give their mean.

    Raises:
        ValueError: no scores.
    """
    count = scores.shape[-1]
    if count == 0:
        raise ValueError("scores is empty: an interquartile mean needs at least one")
    places = np.arange(count)
    cut = count / 4
    weights = np.clip(np.minimum(places + 1, count - cut) - np.maximum(places, cut), 0.0, None)
    return np.asarray((np.sort(scores, axis=-1) * weights).sum(axis=-1) / weights.sum())


def improvement(ours: Scores, theirs: Others) -> Float64[np.ndarray, " *resamples"]:
    """Probability that a seed of ours scores higher than one of theirs; a tie counts half."""
    above = (ours[..., :, None] > theirs[..., None, :]).mean(axis=(-2, -1))
    level = (ours[..., :, None] == theirs[..., None, :]).mean(axis=(-2, -1))
    return np.asarray(above + 0.5 * level)


def stratified_bootstrap(
    strata: Sequence[Float64[np.ndarray, " _"]], statistic: Statistic, rng: np.random.Generator
) -> tuple[float, float]:
    """95 % percentile interval of a statistic of several variants, each variant's seeds drawn anew by themselves.

    A variant is a stratum: a resample has as many of its seeds as there are, so that no variant ever drops out.

    Returns:
        Both ends; NaN where any stratum has fewer than two seeds.

    Raises:
        ValueError: a stratum without scores.
    """
    if not strata or any(len(stratum) == 0 for stratum in strata):
        raise ValueError("strata: every variant needs at least one score")
    if any(len(stratum) < 2 for stratum in strata):
        return math.nan, math.nan
    drawn = [stratum[rng.integers(len(stratum), size=(NUM_RESAMPLES, len(stratum)))] for stratum in strata]
    low, high = np.quantile(statistic(drawn), [0.025, 0.975])
    return float(low), float(high)


def estimate_iqm(scores: Sequence[float]) -> Estimate:
    """Interquartile mean of one variant's seeds, with its interval."""
    values = np.array(scores, dtype=np.float64)
    interval = stratified_bootstrap([values], lambda drawn: iqm(drawn[0]), np.random.default_rng(SEED_OF_RESAMPLES))
    return Estimate(value=float(iqm(values)), interval=interval, num_seeds=len(values))


def estimate_improvement(ours: Sequence[float], theirs: Sequence[float]) -> Estimate:
    """Probability that a seed of ours beats one of theirs, with its interval over both variants' seeds."""
    strata = [np.array(ours, dtype=np.float64), np.array(theirs, dtype=np.float64)]

    def statistic(drawn: Drawn) -> Float64[np.ndarray, " *resamples"]:
        return improvement(drawn[0], drawn[1])

    interval = stratified_bootstrap(strata, statistic, np.random.default_rng(SEED_OF_RESAMPLES))
    return Estimate(value=float(statistic(strata)), interval=interval, num_seeds=len(strata[0]))


def area_under_curve(
    steps: Float64[np.ndarray, " episodes"], values: Float64[np.ndarray, " episodes"], start: float, end: float
) -> float:
    """Mean height of a curve of episodes between two steps: its area divided by the steps between.

    An episode's value holds from the episode before it, or from `start`, up to its own end, so that episodes of unequal
    length weigh what they lasted. Episodes that ended between the same two reports carry the same step; their mean
    holds. Dividing lets runs of unequal lengths be cut to the shortest and compared.

    Args:
        steps: environment steps at each episode's end, never falling.
        values: of each episode.
        start: first step that counts.
        end: last step that counts.

    Raises:
        ValueError: an empty range, or a curve that ends before the range does.
    """
    if not start < end:
        raise ValueError(f"start = {start}, end = {end}: the area needs a range of steps")
    if len(steps) == 0 or steps[-1] < end:
        raise ValueError(f"end = {end}: the curve ends before; cut to the shortest of the curves")
    ends, place = np.unique(steps, return_inverse=True)
    means = np.bincount(place, values) / np.bincount(place)
    edges = np.clip(np.concatenate([[start], ends]), start, end)
    return float((means * np.diff(edges)).sum() / (end - start))


def mean_of_last(values: Float64[np.ndarray, " episodes"], count: int) -> float:
    """Mean of the last `count` values, or of all if there are fewer; raises ``ValueError`` without any."""
    if len(values) == 0:
        raise ValueError("values is empty: the run has no episode of its own policy")
    return float(values[-count:].mean())


def held_curve(
    steps: Float64[np.ndarray, " episodes"],
    values: Float64[np.ndarray, " episodes"],
    grid: Float64[np.ndarray, " grid"],
    window: int,
) -> Float64[np.ndarray, " grid"]:
    """A curve at common steps: at each the mean of the last `window` episodes that had ended by then.

    Causal: no point knows of an episode that ends after it. NaN before the first episode, and after the last one.
    """
    if len(steps) == 0:
        return np.full(len(grid), math.nan)
    smooth = causal_mean(values, window)
    place = np.searchsorted(steps, grid, side="right") - 1
    return np.where((place >= 0) & (grid <= steps[-1]), smooth[np.maximum(place, 0)], math.nan)


def curve_band(
    curves: Float64[np.ndarray, "seeds grid"],
) -> tuple[Float64[np.ndarray, " grid"], Float64[np.ndarray, " grid"], Float64[np.ndarray, " grid"]]:
    """Interquartile mean over seeds at each step, and both ends of its pointwise 95 % bootstrap interval.

    NaN wherever a seed has no value, so that no point rests on fewer seeds than the legend says; the interval is NaN
    throughout for a single seed.
    """
    middle = np.where(np.isnan(curves).any(axis=0), math.nan, iqm(curves.T))
    if len(curves) < 2:
        blank = np.full(curves.shape[1], math.nan)
        return middle, blank, blank
    rng = np.random.default_rng(SEED_OF_RESAMPLES)
    picks = rng.integers(len(curves), size=(NUM_RESAMPLES // 4, len(curves)))
    low, high = np.quantile(iqm(np.moveaxis(curves[picks], 1, 2)), [0.025, 0.975], axis=0)
    return middle, low, high
