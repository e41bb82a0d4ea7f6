"""Back to the last checkpoint, with lower rates, a few times."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from slotfilm_dist.learning.checkpoint import CheckpointStore
from slotfilm_dist.learning.learner import Learner
from slotfilm_dist.learning.off_policy import MAX_SKIPPED, TrainingDivergedError
from slotfilm_dist.learning.recovery import MAX_ROLLBACKS, RATE_FACTOR, Recovery
from slotfilm_dist.messages import SampleBatch
from slotfilm_dist.presets import smoke
from slotfilm_dist.variants import apply_variant

ERROR = TrainingDivergedError("not finite")


def learner_of_rl() -> Learner:
    base = apply_variant("state_only", smoke())
    learner = Learner(replace(base, sac=replace(base.sac, hidden=(16,), batch_size=4)), 7, torch.device("cpu"))
    learner.begin_rl(None)
    return learner


def batch(reward: float) -> SampleBatch:
    state = np.random.default_rng(0).normal(size=(4, 35)).astype(np.float32)
    nothing, goal, no = np.empty((4, 0), np.float16), np.zeros((4, 3), np.float32), np.zeros(4, bool)
    return SampleBatch(
        visual=nothing,
        proprio=state,
        goal=goal,
        action=np.zeros((4, 7), np.float32),
        reward=np.full(4, reward, np.float32),
        discount=np.full(4, 0.99, np.float32),
        terminated=no,
        truncated=no,
        next_visual=nothing,
        next_proprio=state,
        next_goal=goal,
    )


def rates(learner: Learner) -> list[float]:
    return [g["lr"] for o in learner.rl._optimisers().values() for g in o.param_groups]


def test_diverged_learner_goes_back_to_its_checkpoint_and_learns_on_at_half_the_rates(tmp_path: Path) -> None:
    learner = learner_of_rl()
    learner.update(batch(1.0))
    saved = learner.checkpoint({})
    CheckpointStore(tmp_path, 2).write(saved, 1)
    before = rates(learner)
    for _ in range(3):
        learner.update(batch(1.0))
    recovery = Recovery(learner)
    recovery.use(tmp_path)
    for _ in range(MAX_SKIPPED - 1):
        learner.update(batch(np.nan))
    with pytest.raises(TrainingDivergedError) as diverged:
        learner.update(batch(np.nan))
    assert recovery.roll_back(diverged.value) == 3
    again = learner.checkpoint({}).tensors
    assert all(torch.equal(saved.tensors[name], again[name]) for name in saved.tensors)
    assert rates(learner) == [RATE_FACTOR * rate for rate in before]
    assert learner.rl.skipped_updates == MAX_SKIPPED
    learner.update(batch(1.0))
    assert learner.updates == 2


def test_recovery_gives_up_after_a_few_times(tmp_path: Path) -> None:
    learner = learner_of_rl()
    CheckpointStore(tmp_path, 2).write(learner.checkpoint({}), 0)
    recovery = Recovery(learner)
    recovery.use(tmp_path)
    for _ in range(MAX_ROLLBACKS):
        recovery.roll_back(ERROR)
    with pytest.raises(TrainingDivergedError, match=f"not finite; {MAX_ROLLBACKS} returns to a checkpoint did not"):
        recovery.roll_back(ERROR)


def test_without_a_checkpoint_there_is_nothing_to_go_back_to(tmp_path: Path) -> None:
    recovery = Recovery(learner_of_rl())
    with pytest.raises(TrainingDivergedError, match="no checkpoint to go back to"):
        recovery.roll_back(ERROR)
    recovery.use(tmp_path)
    with pytest.raises(TrainingDivergedError, match="no checkpoint to go back to"):
        recovery.roll_back(ERROR)
