"""The learner as roles see it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from slotfilm_dist.learning.learner import Learner
from slotfilm_dist.messages import SampleBatch
from slotfilm_dist.nets.encoder import SlotFusionEncoder
from slotfilm_dist.presets import smoke
from slotfilm_dist.variants import apply_variant


def test_end_to_end_learner_leaves_batchnorm_in_eval_mode_and_its_statistics_alone() -> None:
    base = apply_variant("end_to_end", smoke())
    config = replace(base, sac=replace(base.sac, hidden=(16,), batch_size=2))
    learner = Learner(config, 7, torch.device("cpu"))
    learner.begin_rl(None)
    rng = np.random.default_rng(0)
    state, goal, no = np.zeros((2, config.obs.state_dim), np.float32), np.zeros((2, 3), np.float32), np.zeros(2, bool)
    before = {name: value.clone() for name, value in learner.encoder.state_dict().items()}
    learner.update(
        SampleBatch(
            visual=rng.integers(0, 256, (2, 128, 128, 3), dtype=np.uint8),
            next_visual=rng.integers(0, 256, (2, 128, 128, 3), dtype=np.uint8),
            proprio=state,
            next_proprio=state,
            goal=goal,
            next_goal=goal,
            action=np.zeros((2, 7), np.float32),
            reward=np.ones(2, np.float32),
            discount=np.full(2, 0.99, np.float32),
            terminated=no,
            truncated=no,
        )
    )
    changed = {n for n, value in learner.encoder.state_dict().items() if not torch.equal(value, before[n])}
    assert "perception.backbone.trunk.conv1.weight" in changed
    assert not [name for name in changed if "running" in name or "num_batches" in name]


def test_rl_begins_with_frozen_pictures_and_film_at_zero_or_not_at_all() -> None:
    config = replace(smoke(), sac=replace(smoke().sac, hidden=(16,), batch_size=2))
    learner, moved = (Learner(config, 7, torch.device("cpu")) for _ in range(2))
    learner.begin_rl(None)
    assert learner.encoder.visual_kind == "tokens"
    assert not learner.encoder.training
    assert isinstance(moved.encoder, SlotFusionEncoder)
    assert moved.encoder.fusion is not None
    torch.nn.init.ones_(moved.encoder.fusion.film.bias)
    with pytest.raises(AssertionError, match="FiLM"):
        moved.begin_rl(None)


def test_updates_are_not_compiled_without_a_c_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    config = replace(smoke(), runtime=replace(smoke().runtime, compiled=True))
    with pytest.raises(ValueError, match=r"runtime\.compiled = True: needs a C compiler"):
        Learner(config, 7, torch.device("cuda"))
    assert Learner(config, 7, torch.device("cpu")).updates == 0, "on a CPU nothing is compiled"
