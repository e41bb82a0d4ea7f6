"""Back to the last checkpoint when updates stay non-finite, with lower rates; and no further than that."""

from pathlib import Path

from slotfilm_dist.learning.checkpoint import CheckpointStore
from slotfilm_dist.learning.learner import Learner, learning_hash
from slotfilm_dist.learning.off_policy import TrainingDivergedError

MAX_ROLLBACKS = 3
"""Returns to a checkpoint in one start of a run before it stops: by then every rate is an eighth."""
RATE_FACTOR = 0.5
"""What every rate is multiplied by each time."""


class Recovery:
    """Takes a diverged learner back to its last checkpoint.

    The rates stay lowered until the run is started again, and the checkpoint's noise goes on from where it was.

    Args:
        learner: whose updates may diverge.
    """

    def __init__(self, learner: Learner) -> None:
        self._learner = learner
        self._folder: Path | None = None
        self.num_rollbacks = 0

    def use(self, folder: Path) -> None:
        """Take the run's folder of checkpoints."""
        self._folder = folder

    def roll_back(self, error: TrainingDivergedError) -> int:
        """Load the last checkpoint; gives the updates lost by that.

        Raises:
            TrainingDivergedError: there is no checkpoint, or this has been tried `MAX_ROLLBACKS` times.
            ValueError: no checkpoint can be used.
        """
        learner = self._learner
        if self.num_rollbacks == MAX_ROLLBACKS:
            raise TrainingDivergedError(f"{error}; {MAX_ROLLBACKS} returns to a checkpoint did not help") from error
        config = learner.config
        store = CheckpointStore(self._folder, config.checkpoint.keep) if self._folder else None
        found = store.read_last(learning_hash(config)) if store else None
        if found is None:
            raise TrainingDivergedError(f"{error}; there is no checkpoint to go back to") from error
        self.num_rollbacks += 1
        before, skipped = learner.updates, learner.rl.skipped_updates
        learner.load_checkpoint(found[0])
        learner.rl.skipped_updates = skipped
        learner.rl.scale_rates(RATE_FACTOR)
        return before - learner.updates
