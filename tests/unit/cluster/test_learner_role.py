"""The learner's threads on a real hub and a real replay, without Ray."""

import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from slotfilm_dist.chaos.faulty_links import PoisonedReplay
from slotfilm_dist.chaos.switches import Switches
from slotfilm_dist.cluster import learning_loops
from slotfilm_dist.cluster.hub import Hub, build_limiter
from slotfilm_dist.cluster.learner_role import LearnerRole
from slotfilm_dist.cluster.messages import BlockKey, BlockNotice
from slotfilm_dist.config import RunConfig
from slotfilm_dist.envs.toy import ToyEnv
from slotfilm_dist.learning import learner as learner_module
from slotfilm_dist.learning.checkpoint import CheckpointStore, read_checkpoint
from slotfilm_dist.learning.graphed_sac import GraphedSac
from slotfilm_dist.learning.learner import dataset_hash, dataset_schema, learning_hash
from slotfilm_dist.messages import SampleBatch, TransitionBlock
from slotfilm_dist.policy import RandomPolicy
from slotfilm_dist.presets import smoke
from slotfilm_dist.replay.dataset_writer import FrameDatasetWriter
from slotfilm_dist.replay.schema import ReplaySchema
from slotfilm_dist.replay.shard import ReplayShard
from slotfilm_dist.replay.sharded import ShardedReplay
from slotfilm_dist.rollout import RolloutLoop
from slotfilm_dist.variants import apply_variant

STEPS = 100


class Store:
    """Replay as a learner on a cluster sees it: several threads may ask."""

    def __init__(self, schema: ReplaySchema) -> None:
        self._schema, self._lock = schema, threading.Lock()
        self.lose()

    def lose(self) -> None:
        """Forget everything."""
        with self._lock:
            self._replay = ShardedReplay([ReplayShard(self._schema, 1000, 0, block_steps=16)], 0)

    def insert_all(self, blocks: Iterable[TransitionBlock]) -> int:
        with self._lock:
            return sum(block.num_steps for block in blocks if self._replay.insert(block))

    def sample(self, num_batches: int, batch_size: int) -> list[SampleBatch]:
        with self._lock:
            return self._replay.sample(num_batches, batch_size)

    def num_steps(self) -> int:
        with self._lock:
            return self._replay.num_steps()


class Bench:
    """A learner that may make any number of updates once `allow` has let the steps for them in."""

    def __init__(self, folder: Path) -> None:
        base = apply_variant("state_only", smoke())
        self.config: RunConfig = replace(
            base,
            schedule=replace(base.schedule, random_steps=STEPS, updates_per_step=1.0),
            sac=replace(base.sac, hidden=(16,), batch_size=4),
            runtime=replace(base.runtime, publish_every=10, block_steps=16),
        )
        self.checkpoints, self.switches = folder / "checkpoints", Switches(folder / "switches")
        self.hub = Hub(build_limiter(1.0, STEPS, 16), 1_000_000, 1)
        self.dataset = folder / dataset_hash(self.config)
        self._write_dataset()
        self._sequence = 0
        self.role = self.start(None)
        self.hub.count_random_steps(STEPS)

    def start(self, resume_from: Path | None) -> LearnerRole:
        """A learner that is begun and connected."""
        role = LearnerRole(self.config, 7, torch.device("cpu"), self.hub)
        beginning = role.begin(self.dataset, None, resume_from)
        self.store = Store(beginning.schema)
        role.connect(PoisonedReplay(self.store, self.checkpoints.parent / "switches"))
        assert role.refill(self.dataset) == STEPS
        return role

    def allow(self, num_blocks: int) -> None:
        """Count steps of a worker, 16 a block, so that as many updates fall due."""
        for _ in range(num_blocks):
            key = BlockKey(worker_id=0, incarnation=0, sequence=self._sequence)
            notice = BlockNotice(key=key, num_steps=16, policy_version=0, episodes=())
            until(lambda n=notice: self.hub.admit_steps(n, [], 0.1).granted, "room for a block")
            self.hub.confirm([key])
            self._sequence += 1

    def _write_dataset(self) -> None:
        env = ToyEnv(self.config, camera=False)
        loop = RolloutLoop(env, RandomPolicy(7, np.random.SeedSequence(0)), np.random.SeedSequence(1))
        name = dataset_hash(self.config)
        with FrameDatasetWriter(self.dataset, dataset_schema(self.config, 7), name) as writer:
            while writer.num_steps < STEPS:
                writer.append(loop.collect(min(16, STEPS - writer.num_steps)))
            writer.finish()


def until(holds: Callable[[], bool], what: str, timeout_s: float = 60.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not holds():
        assert time.monotonic() < deadline, f"{what} did not happen"
        time.sleep(0.01)


@pytest.fixture(autouse=True)
def _a_request_a_grant(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is drawn ahead, so what is spoiled is what is learned from next."""
    monkeypatch.setattr(learning_loops, "GRANTS_AHEAD", 1)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path)
    yield made
    made.role.stop(10)


def test_learner_makes_just_the_updates_that_are_due_and_publishes(bench: Bench) -> None:
    bench.role.start()
    bench.allow(4)
    until(lambda: bench.role.status().updates == 64, "64 updates")
    assert bench.role.stop(10) == 64
    assert bench.hub.status().updates == 64
    assert bench.hub.newest_version() == 64


def test_diverged_learner_goes_back_its_updates_fall_due_again_and_versions_grow(bench: Bench) -> None:
    bench.role.start()
    bench.allow(2)
    until(lambda: bench.role.status().updates == 32, "32 updates")
    bench.role.save(bench.checkpoints, {}, best=False)
    bench.allow(2)
    until(lambda: bench.role.status().updates == 64, "64 updates")
    version = bench.hub.newest_version()
    bench.switches.arm("reward", math.nan, count=4)
    bench.allow(2)
    until(lambda: bench.role.status().metrics["learner_rollbacks_total"] >= 1, "a return to the checkpoint")
    bench.switches.disarm("reward")
    until(lambda: bench.role.status().updates == 96, "all updates that are due")
    assert bench.role.status().metrics["learner_nonfinite_total"] >= 10
    assert bench.role.stop(10) == 96
    assert bench.hub.status().updates == 96
    assert bench.hub.newest_version() > version


@pytest.fixture
def recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    """With the learner of a GPU, which finds out later that updates were skipped."""
    monkeypatch.setattr(learner_module, "SacLearner", GraphedSac)
    made = Bench(tmp_path)
    yield made
    made.role.stop(10)


def test_recorded_learner_that_goes_back_owes_what_the_hub_says(recorded: Bench) -> None:
    recorded.role.start()
    recorded.allow(2)
    until(lambda: recorded.role.status().updates == 32, "32 updates")
    recorded.role.save(recorded.checkpoints, {}, best=False)
    recorded.allow(2)
    until(lambda: recorded.role.status().updates == 64, "64 updates")
    recorded.switches.arm("reward", math.nan, count=4)
    recorded.allow(4)
    until(lambda: recorded.role.status().metrics["learner_rollbacks_total"] >= 1, "a return to the checkpoint")
    recorded.switches.disarm("reward")
    until(lambda: recorded.role.status().updates == 128, "all updates that are due")
    assert recorded.hub.status().updates == 128


def test_recorded_learner_makes_its_last_updates_again_that_turn_out_to_be_skipped(recorded: Bench) -> None:
    recorded.role.start()
    recorded.allow(1)
    until(lambda: recorded.role.status().updates == 16, "16 updates")
    recorded.switches.arm("first_reward", math.nan)
    recorded.allow(1)
    until(lambda: recorded.role.status().updates == 32, "all updates that are due")
    assert recorded.role.status().metrics["learner_nonfinite_total"] >= 1
    assert recorded.hub.status().updates == 32


def test_weights_are_published_under_the_updates_that_were_made(recorded: Bench) -> None:
    learner = recorded.role.learner
    batch = recorded.store.sample(1, 4)[0]
    for reward in (batch.reward, np.full_like(batch.reward, np.nan)):
        learner.update(replace(batch, reward=reward))
    assert learner.snapshot().version == 1


def test_learner_without_a_checkpoint_says_why_it_stopped(bench: Bench) -> None:
    bench.switches.arm("reward", math.nan, count=10)
    bench.role.start()
    bench.allow(1)
    until(lambda: bench.role.status().error != "", "an error")
    assert "10 times in a row at update 0" in bench.role.status().error
    assert "there is no checkpoint to go back to" in bench.role.status().error


def test_workers_fill_up_a_replay_that_was_lost(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learning_loops, "RESTORE_S", 3.0)
    bench.role.start()
    bench.allow(2)
    until(lambda: bench.role.status().updates == 32, "32 updates")
    bench.store.lose()
    bench.allow(1)
    until(lambda: "it holds 0" in bench.role.status().waiting_for, "a wait for steps")
    bench.allow(5)  # more than the limiter's slack: the learner makes no update meanwhile
    assert bench.role.status().updates == 32
    bench.role.refill(bench.dataset)
    bench.allow(8)
    until(lambda: bench.role.status().updates > 32, "updates again")
    assert not bench.role.status().error


def test_best_is_what_was_evaluated_however_far_the_learner_is_by_then(bench: Bench) -> None:
    bench.role.start()
    bench.allow(1)
    until(lambda: bench.role.status().updates == 16, "16 updates")
    evaluated = bench.role.hold_candidate()
    bench.allow(2)
    until(lambda: bench.role.status().updates == 48, "48 updates")
    _, updates = bench.role.save(bench.checkpoints, {"best_return": 1.0}, best=True)
    best = read_checkpoint(bench.checkpoints / "best")
    assert (updates, best.values["updates"], best.values["best_return"]) == (16, 16, 1.0)
    actor = {k.removeprefix("actor."): v for k, v in evaluated.arrays.items() if k.startswith("actor.")}
    assert actor
    assert all(np.array_equal(best.tensors[f"actor.{k}"].numpy(), v) for k, v in actor.items())


def test_passed_over_checkpoint_is_named_to_who_begins(bench: Bench) -> None:
    bench.role.start()
    for updates in (16, 32):
        bench.allow(1)
        until(lambda n=updates: bench.role.status().updates == n, "updates")
        bench.role.save(bench.checkpoints, {}, best=False)
    damaged = bench.checkpoints / "updates-000000032" / "tensors.safetensors"
    damaged.write_bytes(damaged.read_bytes()[:-1])
    version = bench.hub.newest_version()
    again = LearnerRole(bench.config, 7, torch.device("cpu"), bench.hub)
    beginning = again.begin(bench.dataset, None, bench.checkpoints)
    assert beginning.values["updates"] == 16
    assert str(damaged) in beginning.problems[0]
    assert bench.hub.newest_version() > version
    found = CheckpointStore(bench.checkpoints, 2).read_last(learning_hash(bench.config))
    assert found is not None


def test_learner_that_never_began_stops_too(tmp_path: Path) -> None:
    hub = Hub(build_limiter(1.0, STEPS, 16), 1_000, 1)
    assert LearnerRole(smoke(), 7, torch.device("cpu"), hub).stop(1.0) == 0


def test_best_is_the_learner_that_was_judged_or_nothing(tmp_path: Path) -> None:
    hub = Hub(build_limiter(1.0, STEPS, 16), 1_000, 1)
    with pytest.raises(OSError, match="the learner that was evaluated has been lost since"):
        LearnerRole(smoke(), 7, torch.device("cpu"), hub).save(tmp_path, {}, best=True)
