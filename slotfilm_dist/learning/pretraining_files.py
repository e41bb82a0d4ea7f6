"""Where a pre-training keeps its result, and what there is of it until then."""

import shutil
from pathlib import Path

from slotfilm_dist.learning.checkpoint import read_checkpoint, write_checkpoint
from slotfilm_dist.learning.learner import Learner


def continue_unfinished(learner: Learner, artifact: Path) -> None:
    """Go on where an interrupted pre-training for this result stopped, whichever variant it was made for."""
    unfinished = _unfinished(artifact)
    if unfinished.exists():
        learner.load_pretrain_state(read_checkpoint(unfinished, learner.pretrain_state().config_hash))


def save_unfinished(learner: Learner, artifact: Path) -> None:
    """Write what there is, beside the place of the result."""
    write_checkpoint(_unfinished(artifact), learner.pretrain_state())


def save_finished(learner: Learner, artifact: Path) -> None:
    """Write the result, and remove what there was of it."""
    write_checkpoint(artifact, learner.pretrain_state())
    shutil.rmtree(_unfinished(artifact), ignore_errors=True)


def _unfinished(artifact: Path) -> Path:
    return artifact.with_name(artifact.name + ".unfinished")
