"""Which steps of an environment are fit to learn from, and when an environment is given up."""

from collections import deque

import numpy as np
from jaxtyping import Bool

from slotfilm_dist.messages import Observation, StepResult

WINDOW_STEPS = 200
"""Steps over which the share of rejected ones is taken."""
MAX_REJECTED = 10
"""Rejected steps within the window that are put up with, 5 %; one more, and the environment is given up."""


class BrokenEnvironmentError(FloatingPointError):
    """An environment gave too many steps that nothing can be learned from."""


class StepCheck:
    """Rejects what is not finite and pictures that are all black, and counts it.

    A simulator that diverges gives NaN, a renderer that lost its device gives black. Neither may reach replay, where
    one bad step would spoil every batch that draws it.
    """

    def __init__(self) -> None:
        self.num_rejected = 0
        """Steps and first observations rejected so far."""
        self._recent: deque[bool] = deque(maxlen=WINDOW_STEPS)

    def accepted(self, step: StepResult) -> Bool[np.ndarray, " envs"]:
        """Which environments' step can be kept.

        Raises:
            BrokenEnvironmentError: more than `MAX_REJECTED` of the last `WINDOW_STEPS` could not.
        """
        good = np.isfinite(step.reward) & np.isfinite(step.reward_terms).all(axis=1)
        if step.reward_inputs is not None:
            good &= np.isfinite(step.reward_inputs).all(axis=1)
        good &= _sound(step.final) & _sound(step.observation)
        self._count(good, "a step")
        return good

    def accepts_start(self, observation: Observation) -> bool:
        """Whether an episode can begin here; raises `BrokenEnvironmentError` as `accepted` does."""
        good = _sound(observation)
        if not good.all():
            self._count(good, "the start of an episode")
        return bool(good.all())

    def _count(self, good: Bool[np.ndarray, " envs"], what: str) -> None:
        self._recent.extend(not g for g in good.tolist())
        self.num_rejected += int((~good).sum())
        if sum(self._recent) > MAX_REJECTED:
            raise BrokenEnvironmentError(
                f"{sum(self._recent)} of the environment's last {len(self._recent)} steps were not finite or had a "
                f"black picture, the last of them {what}"
            )


def _sound(observation: Observation) -> Bool[np.ndarray, " envs"]:
    """Which environments' state and goal are finite, and whose picture shows something."""
    finite = [np.all(np.isfinite(values), axis=1) for values in (observation.proprio, observation.goal)]
    good = np.logical_and(*finite)
    if observation.rgb is not None:
        good = good & np.any(observation.rgb.reshape(len(good), -1), axis=1)
    return good
