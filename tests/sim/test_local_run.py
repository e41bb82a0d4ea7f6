"""A local run on the real simulator: reproducible, and the same after a stop."""

import io
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from rich.console import Console

from slotfilm_dist.config import RunConfig
from slotfilm_dist.envs.tasks import adapt_config
from slotfilm_dist.learning.checkpoint import CheckpointStore
from slotfilm_dist.learning.learner import learning_hash
from slotfilm_dist.local import LocalBackend
from slotfilm_dist.pipeline import Pipeline
from slotfilm_dist.presets import smoke
from slotfilm_dist.progress import Progress
from slotfilm_dist.runs import RunDirectory
from slotfilm_dist.stopping import Interrupted, StopFlag
from slotfilm_dist.variants import apply_variant

pytestmark = pytest.mark.sim


def config_of(task: str = "PickBanana-v1", seed: int = 0) -> RunConfig:
    base = smoke()
    base = replace(base, seed=seed, env=replace(base.env, task=task, max_steps=20))
    config = apply_variant("oracle_state", adapt_config(base))
    return replace(
        config,
        schedule=replace(config.schedule, total_steps=160, random_steps=60),
        replay=replace(config.replay, min_steps=40),
        evaluation=replace(config.evaluation, episodes=1, videos=0),
        runtime=replace(
            config.runtime, mode="local", device="cpu", learner_threads=1, block_steps=8, exact_resume=True
        ),
    )


class StopAfterQuestions(StopFlag):
    """A signal that comes while training, after so many questions for it."""

    def __init__(self, questions: int) -> None:
        super().__init__()
        self._left = questions

    def __call__(self) -> bool:
        self._left -= 1
        if self._left <= 0:
            self.signal_number = 2
        return super().__call__()


def execute(folder: Path, config: RunConfig, stop: StopFlag | None = None) -> dict[str, torch.Tensor]:
    """The tensors of the last checkpoint."""
    backend = LocalBackend(config)
    try:
        with RunDirectory(folder / "run", config) as run:
            quiet = Progress(Console(file=io.StringIO()))
            Pipeline(run, backend, folder / "artifacts", quiet, stop or StopFlag()).execute()
    finally:
        backend.close()
        found = CheckpointStore(folder / "run" / "checkpoints", 2).read_last(learning_hash(config))
    assert found is not None
    return found[0].tensors


def differing(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> Iterator[str]:
    assert first.keys() == second.keys()
    return (name for name in first if not torch.equal(first[name], second[name]))


def test_same_seed_gives_the_same_learner_also_when_it_was_stopped_half_way(tmp_path: Path) -> None:
    config = config_of()
    straight = execute(tmp_path / "a", config)
    with pytest.raises(Interrupted):
        execute(tmp_path / "b", config, StopAfterQuestions(3))
    status = RunDirectory(tmp_path / "b" / "run", config).read_status()
    assert 60 < status["env_steps"] < 160
    resumed = execute(tmp_path / "b", config)
    assert list(differing(straight, resumed)) == []
    other = execute(tmp_path / "c", config_of(seed=1))
    assert "critic.ensemble.weights.0" in set(differing(straight, other))


@pytest.mark.parametrize("task", ["PickCube-v1", "StackCube-v1"])
def test_stock_task_goes_through_the_whole_pipeline(tmp_path: Path, task: str) -> None:
    execute(tmp_path, config_of(task))
    assert (tmp_path / "run" / "evaluation" / "final.json").is_file()
    assert (tmp_path / "run" / "report.html").is_file()
