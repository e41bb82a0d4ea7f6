"""A Ray cluster for the tests of this folder, and runs on the toy environment that take seconds."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slotfilm_dist.cluster.backend import RayBackend
from slotfilm_dist.cluster.session import Session
from slotfilm_dist.config import RunConfig
from slotfilm_dist.envs.toy import ToyEnv, make_toy_env
from slotfilm_dist.learning.learner import dataset_hash, dataset_schema
from slotfilm_dist.policy import RandomPolicy
from slotfilm_dist.presets import smoke
from slotfilm_dist.replay.dataset_writer import FrameDatasetWriter
from slotfilm_dist.rollout import RolloutLoop
from slotfilm_dist.variants import apply_variant

RANDOM_STEPS = 200


@pytest.fixture(scope="module")
def session() -> Iterator[Session]:
    # More than there may be: room for workers beyond the first ones; on few cores everything is only slower.
    cluster = Session(num_cpus=8)
    yield cluster
    cluster.close()


@pytest.fixture
def config() -> RunConfig:
    """State only, on the toy environment: a step and an update take milliseconds."""
    base = apply_variant("state_only", smoke())
    return replace(
        base,
        schedule=replace(base.schedule, total_steps=100_000, random_steps=RANDOM_STEPS, updates_per_step=0.5),
        replay=replace(base.replay, capacity=40_000, min_steps=100, num_shards=2),
        runtime=replace(base.runtime, mode="ray", num_workers=2, block_steps=16, learner_threads=1, device="cpu"),
        evaluation=replace(base.evaluation, episodes=2),
    )


@pytest.fixture(scope="session")
def make_dataset(tmp_path_factory: pytest.TempPathFactory) -> Callable[[RunConfig], Path]:
    made: dict[str, Path] = {}

    def make(config: RunConfig) -> Path:
        name = dataset_hash(config)
        if name not in made:
            env = ToyEnv(config, camera=config.encoder.uses_image)
            policy = RandomPolicy(env.action_dim, np.random.SeedSequence(0))
            loop = RolloutLoop(env, policy, np.random.SeedSequence(1))
            made[name] = tmp_path_factory.mktemp("data") / name
            with FrameDatasetWriter(made[name], dataset_schema(config, env.action_dim), name) as writer:
                while writer.num_steps < config.schedule.random_steps:
                    writer.append(loop.collect(16))
                writer.finish()
        return made[name]

    return make


@pytest.fixture
def start(session: Session) -> Iterator[Callable[..., RayBackend]]:
    """Starts backends and closes them after the test."""
    started: list[RayBackend] = []

    def make(config: RunConfig, run: Path, **options: object) -> RayBackend:
        run.mkdir(parents=True, exist_ok=True)
        started.append(RayBackend(config, run, **({"make_env": make_toy_env} | options)))
        started[-1].prepare()
        return started[-1]

    yield make
    for backend in started:
        backend.close()
