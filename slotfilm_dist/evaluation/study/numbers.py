"""The numbers of a study, fixed before any run: return of the last 100 episodes, area under the curve, success.

Return is shown at the paper's scale, ten times the unscaled reward, whatever `sac.reward_scale` a variant learns with.
Episodes of the random policy are in no number.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from slotfilm_dist.evaluation.statistics import causal_mean, wilson_interval
from slotfilm_dist.evaluation.study.collection import Study, StudyRun
from slotfilm_dist.evaluation.study.estimates import (
    Estimate,
    area_under_curve,
    estimate_improvement,
    estimate_iqm,
    mean_of_last,
)

SCALE = 10.0
"""The paper's reward scale."""
LAST_EPISODES = 100
"""Episodes that the final return is the mean of, and the window that curves are smoothed with."""
PAPER_STEPS = 400
"""Steps of the paper's episodes."""

Episodes = Float64[np.ndarray, " episodes"]


@dataclass(frozen=True, kw_only=True, slots=True)
class RunNumbers:
    """One run's numbers."""

    run: StudyRun
    last_return: float
    """Mean return of the last 100 training episodes."""
    highest: float
    """Highest mean return of 100 consecutive episodes; of all of them if there are fewer."""
    area: float
    """Mean height of the return's curve from the end of random collection to `until`."""
    until: int
    """Step that all of the variant's runs and all of the proposed agent's have reached."""
    num_solved: int
    """Episodes of the final evaluation that were solved at their end."""
    num_evaluated: int


@dataclass(frozen=True, kw_only=True, slots=True)
class VariantNumbers:
    """A variant's numbers over its seeds."""

    variant: str
    runs: tuple[RunNumbers, ...]
    last_return: Estimate
    highest: Estimate
    area: Estimate
    over_proposed: Estimate | None
    """Probability that a seed's last return is above one of `slotfilm`; None for itself, or without its runs."""
    area_over_proposed: Estimate | None
    """The same for the area under the curve."""

    @property
    def num_solved(self) -> int:
        """Solved episodes over all seeds."""
        return sum(run.num_solved for run in self.runs)

    @property
    def num_evaluated(self) -> int:
        """Episodes of the final evaluations over all seeds."""
        return sum(run.num_evaluated for run in self.runs)

    @property
    def success(self) -> tuple[float, float, float]:
        """Share of episodes solved at their end, and its 95 % Wilson interval over all episodes of all seeds.

        Episodes of one seed share a policy, so with few seeds the interval is narrower than the truth about the method.
        """
        return (
            self.num_solved / max(self.num_evaluated, 1),
            *wilson_interval(self.num_solved, self.num_evaluated),
        )


def training_returns(run: StudyRun) -> tuple[Episodes, Episodes]:
    """Steps at the end of each episode that the learning policy played, and its return at the paper's scale."""
    own = run.record.learning_episodes
    steps = np.array([e.env_steps for e in own], dtype=np.float64)
    return steps, SCALE * np.array([e.summary.episode_return for e in own], dtype=np.float64)


def study_numbers(study: Study) -> list[VariantNumbers]:
    """Every variant's numbers, in the study's order."""
    return compare(study.runs)


def compare(runs: Sequence[StudyRun]) -> list[VariantNumbers]:
    """Numbers of these runs by variant, in their order; a run without an episode of its own policy has none.

    A variant's area is taken up to the step that all of its runs and all of the proposed agent's have reached, and is
    compared with the proposed agent's area up to that very step.
    """
    by_variant: dict[str, list[StudyRun]] = {}
    for run in runs:
        if len(training_returns(run)[0]):
            by_variant.setdefault(run.variant, []).append(run)
    proposed = by_variant.get("slotfilm", [])
    return [_variant_numbers(name, of_variant, proposed) for name, of_variant in by_variant.items()]


def run_numbers(run: StudyRun, until: int) -> RunNumbers:
    """One run's numbers, with the area up to that step."""
    steps, returns = training_returns(run)
    window = min(LAST_EPISODES, len(returns))
    start = min(run.config.schedule.random_steps, until - 1)
    final = run.record.final
    episodes = final.episodes if final else ()
    return RunNumbers(
        run=run,
        last_return=mean_of_last(returns, LAST_EPISODES),
        highest=float(causal_mean(returns, window)[window - 1 :].max()),
        area=area_under_curve(steps, returns, start, until),
        until=until,
        num_solved=sum(e.success_at_end for e in episodes),
        num_evaluated=len(episodes),
    )


def _variant_numbers(name: str, runs: list[StudyRun], proposed: list[StudyRun]) -> VariantNumbers:
    until = int(min(training_returns(run)[0][-1] for run in (*runs, *proposed)))
    numbers = [run_numbers(run, until) for run in runs]
    rivals = [] if name == "slotfilm" else [run_numbers(run, until) for run in proposed]
    returns, areas = [n.last_return for n in numbers], [n.area for n in numbers]
    return VariantNumbers(
        variant=name,
        runs=tuple(numbers),
        last_return=estimate_iqm(returns),
        highest=estimate_iqm([n.highest for n in numbers]),
        area=estimate_iqm(areas),
        over_proposed=estimate_improvement(returns, [r.last_return for r in rivals]) if rivals else None,
        area_over_proposed=estimate_improvement(areas, [r.area for r in rivals]) if rivals else None,
    )
