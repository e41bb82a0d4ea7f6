"""Sums up episodes while they run."""

import numpy as np

from slotfilm_dist.messages import EpisodeSummary, StepResult


class EpisodeTracker:
    """Sums up the running episode of every environment.

    Args:
        seeds: of the episodes that have just begun.
        num_terms: components of the reward.
    """

    def __init__(self, seeds: list[int], num_terms: int) -> None:
        self._seeds = list(seeds)
        count = len(seeds)
        self._length = np.zeros(count, np.int64)
        self._return = np.zeros(count)
        self._success = np.zeros(count, bool)
        self._grasped = np.zeros(count, bool)
        self._terms = np.zeros((count, num_terms))

    @property
    def running_seeds(self) -> list[int]:
        """Seeds of the running episodes."""
        return list(self._seeds)

    @property
    def num_running_steps(self) -> int:
        """Steps taken in the running episodes."""
        return int(self._length.sum())

    def add(self, step: StepResult, next_seeds: list[int]) -> list[EpisodeSummary]:
        """Take one `StepResult` in; gives the summaries of the episodes that it ended."""
        self._length += 1
        self._return += step.reward
        self._success |= step.success
        self._grasped |= step.grasped
        self._terms += step.reward_terms
        ended = np.flatnonzero(step.terminated | step.truncated)
        return [self._finish(int(i), step, next_seeds[i]) for i in ended]

    def _finish(self, i: int, step: StepResult, next_seed: int) -> EpisodeSummary:
        summary = EpisodeSummary(
            seed=self._seeds[i],
            length=int(self._length[i]),
            episode_return=float(self._return[i]),
            success_once=bool(self._success[i]),
            success_at_end=bool(step.success[i]),
            placed_at_end=bool(step.placed[i]),
            grasped_once=bool(self._grasped[i]),
            reward_terms=tuple(float(x) for x in self._terms[i]),
        )
        self._seeds[i] = next_seed
        self._length[i] = 0
        self._return[i] = 0
        self._success[i] = self._grasped[i] = False
        self._terms[i] = 0
        return summary


def episode_metrics(
    episodes: list[EpisodeSummary], term_names: tuple[str, ...], reward_scale: float
) -> dict[str, float]:
    """Means over some episodes, by metric name; `episode_return_scaled` is the return times the reward scale."""
    mean_return = float(np.mean([e.episode_return for e in episodes]))
    terms = np.mean([e.reward_terms for e in episodes], axis=0)
    return {
        "episode_return": mean_return,
        "episode_return_scaled": mean_return * reward_scale,
        "episode_length_steps": float(np.mean([e.length for e in episodes])),
        "episode_success": float(np.mean([e.success_at_end for e in episodes])),
        "episode_success_once": float(np.mean([e.success_once for e in episodes])),
        "episode_placed": float(np.mean([e.placed_at_end for e in episodes])),
        "episode_grasped": float(np.mean([e.grasped_once for e in episodes])),
    } | {f"episode_reward_term/{name}": float(value) for name, value in zip(term_names, terms, strict=True)}
