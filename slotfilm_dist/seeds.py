"""One root seed, an independent random stream for every role, worker and incarnation."""

from enum import IntEnum

import numpy as np


class Role(IntEnum):
    """Who draws; the numbers are part of every run's reproducibility."""

    ENCODER = 0
    PRETRAIN = 1
    LEARNER = 2
    REPLAY = 3
    RANDOM_ACTIONS = 4
    RANDOM_EPISODES = 5
    ACTIONS = 6
    EPISODES = 7
    EVALUATION = 8


def role_seed(seed: int, role: Role, worker: int = 0, incarnation: int = 0, already: int = 0) -> np.random.SeedSequence:
    """The stream of one role; a restarted worker (next incarnation) never repeats what it drew before.

    Args:
        seed: of the run.
        role: who draws.
        worker: number of the worker.
        incarnation: how often it had been restarted.
        already: steps that are there, where a collection goes on that another run may have begun.
    """
    return np.random.SeedSequence(seed, spawn_key=(int(role), worker, incarnation, *((already,) if already else ())))


def role_number(seed: int, role: Role) -> int:
    """A 31-bit seed for libraries that take a plain number."""
    return int(role_seed(seed, role).generate_state(1)[0] >> 1)
