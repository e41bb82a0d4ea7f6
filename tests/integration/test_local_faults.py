"""Faults of a run in one process, on the toy environment."""

import logging
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from slotfilm_dist.backend import EvaluationFailedError, RunFailedError, TrainReport
from slotfilm_dist.chaos.black_picture import black_picture
from slotfilm_dist.chaos.faulty_env import BROKEN_STEPS, make_faulty_env
from slotfilm_dist.chaos.switches import Switches
from slotfilm_dist.config import RunConfig
from slotfilm_dist.envs.toy import make_toy_env
from slotfilm_dist.learning.learner import Learner
from slotfilm_dist.learning.off_policy import TrainingDivergedError
from slotfilm_dist.local import LocalBackend
from slotfilm_dist.local_envs import MAX_BROKEN
from slotfilm_dist.messages import SampleBatch

MakeDataset = Callable[[RunConfig], Path]


@pytest.fixture
def local(config: RunConfig) -> RunConfig:
    return replace(
        config,
        schedule=replace(config.schedule, total_steps=600),
        runtime=replace(config.runtime, mode="local"),
    )


@pytest.fixture
def switches(tmp_path: Path) -> Switches:
    return Switches(tmp_path / "switches")


def begun(config: RunConfig, dataset: Path, folder: Path, resume_from: Path | None = None) -> LocalBackend:
    backend = LocalBackend(config, partial(make_faulty_env, folder=folder, make_env=make_toy_env))
    backend.begin_training(dataset, None, resume_from)
    return backend


def last_report(backend: LocalBackend) -> TrainReport:
    return list(backend.train(lambda: False))[-1]


def test_broken_steps_are_counted_and_do_not_reach_the_learner(
    local: RunConfig, make_dataset: MakeDataset, tmp_path: Path, switches: Switches
) -> None:
    backend = begun(local, make_dataset(local), tmp_path / "switches")
    switches.arm("nan_reward", count=3)
    switches.arm("nan_state", count=2)
    report = last_report(backend)
    assert report.env_steps == 600
    assert report.metrics["worker_nonfinite_total"] == 5
    assert report.metrics["worker_cut_episodes_total"] == 5
    assert report.metrics["learner_nonfinite_total"] == 0
    assert report.updates == 200


def test_broken_environment_is_replaced_and_the_run_reaches_its_end(
    local: RunConfig, make_dataset: MakeDataset, tmp_path: Path, switches: Switches
) -> None:
    backend = begun(local, make_dataset(local), tmp_path / "switches")
    switches.arm("nan_reward", count=BROKEN_STEPS)
    report = last_report(backend)
    assert (report.env_steps, report.updates) == (600, 200)
    assert report.metrics["worker_restarts_total/nonfinite"] == 1
    assert report.metrics["worker_nonfinite_total"] == BROKEN_STEPS


@pytest.mark.parametrize("fault", ["nan_reward", "nan_state"])
def test_episode_that_cannot_be_judged_by_fails_its_evaluation_alone(
    local: RunConfig, make_dataset: MakeDataset, tmp_path: Path, switches: Switches, fault: str
) -> None:
    backend = begun(local, make_dataset(local), tmp_path / "switches")
    switches.arm(fault)
    with pytest.raises(EvaluationFailedError, match=r"a step of the episode of seed 7 .*slotfilm doctor"):
        list(backend.play("agent", [7], lambda: False))
    (episode,) = backend.play("agent", [7], lambda: False)
    assert np.isfinite(episode.episode_return)
    backend.close()


def test_run_stops_when_every_environment_breaks(
    local: RunConfig, make_dataset: MakeDataset, tmp_path: Path, switches: Switches
) -> None:
    backend = begun(local, make_dataset(local), tmp_path / "switches")
    switches.arm("nan_reward", count=BROKEN_STEPS * MAX_BROKEN)
    with pytest.raises(RunFailedError, match=f"{MAX_BROKEN} environments were given up, .*--resume"):
        last_report(backend)


def test_updates_that_a_return_to_a_checkpoint_loses_are_made_again_and_every_step_is_counted(
    local: RunConfig, make_dataset: MakeDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset, checkpoints = make_dataset(local), tmp_path / "checkpoints"
    early = replace(local, schedule=replace(local.schedule, total_steps=232))
    first = begun(early, dataset, tmp_path / "switches")
    last_report(first)
    first.save(checkpoints, {}, with_replay=True)
    backend = begun(local, dataset, tmp_path / "switches", resume_from=checkpoints)
    made, update = [0], Learner.update

    def diverges_once(learner: Learner, batch: SampleBatch) -> None:
        made[0] += 1
        if made[0] == 150:
            raise TrainingDivergedError("made to diverge")
        update(learner, batch)

    monkeypatch.setattr(Learner, "update", diverges_once)
    report = last_report(backend)
    assert report.metrics["learner_rollbacks_total"] == 1
    assert (report.env_steps, report.updates) == (600, 200)
    assert backend._store.num_steps() == 600
    assert made[0] == 184 + 149 + 1  # those still due after 16, those made in vain, and the one that diverged


def test_steps_after_a_fallback_to_an_older_checkpoint_are_stored_although_replay_is_ahead_of_it(
    local: RunConfig, make_dataset: MakeDataset, tmp_path: Path
) -> None:
    folder, dataset = tmp_path / "checkpoints", make_dataset(local)
    for total_steps in (280, 400):
        part = replace(local, schedule=replace(local.schedule, total_steps=total_steps))
        backend = begun(part, dataset, tmp_path / "switches", folder if folder.exists() else None)
        last_report(backend)
        backend.save(folder, {}, with_replay=True)
    newest = max(folder.glob("updates-*")) / "tensors.safetensors"
    newest.write_bytes(newest.read_bytes()[:-1])
    backend = begun(local, dataset, tmp_path / "switches", folder)
    stored = backend._store.num_steps()
    report = last_report(backend)
    assert (report.env_steps, report.updates) == (600, 200)
    assert stored == 400
    assert backend._store.num_steps() == 400 + (600 - 280)


def test_reports_come_where_something_is_due_and_episodes_carry_their_own_step_whatever_the_clock_says(
    local: RunConfig, make_dataset: MakeDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = make_dataset(local)

    def run(report_s: float) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
        monkeypatch.setattr("slotfilm_dist.local.REPORT_S", report_s)
        marks, due, episodes = [300, 450], [], []
        backend = begun(local, dataset, tmp_path / "switches")
        for report in backend.train(lambda: False, lambda env_steps, _: bool(marks) and env_steps >= marks[0]):
            episodes += [(episode.summary.seed, episode.env_steps) for episode in report.episodes]
            if report.settled and marks and report.env_steps >= marks[0]:
                due.append((report.env_steps, report.updates))
                del marks[0]
        assert not marks
        return due, episodes

    due, episodes = run(report_s=1e-9)
    assert (due, episodes) == run(report_s=3600.0)
    steps = [env_steps for _, env_steps in episodes]
    assert steps == sorted(set(steps)), "one episode ends at a time"


def test_stop_does_not_wait_for_ever_for_the_end_of_a_slow_episode(
    local: RunConfig, make_dataset: MakeDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("slotfilm_dist.local.STOP_PATIENCE_S", 0.0)
    first = begun(local, make_dataset(local), tmp_path / "switches")
    (stopped,) = first.train(lambda: first._limiter.updates_owed() > 0)
    assert first._limiter.updates_owed() > 0, "in the middle of things"
    first.save(tmp_path / "checkpoints", {}, with_replay=True)
    again = begun(local, make_dataset(local), tmp_path / "switches", tmp_path / "checkpoints")
    report = last_report(again)
    assert stopped.env_steps < report.env_steps == 600
    assert report.updates == 200


def test_ratio_of_one_update_for_many_steps_is_kept(
    local: RunConfig, make_dataset: MakeDataset, tmp_path: Path
) -> None:
    seldom = replace(local, schedule=replace(local.schedule, updates_per_step=0.005))
    report = last_report(begun(seldom, make_dataset(seldom), tmp_path / "switches"))
    assert (report.env_steps, report.updates) == (600, 2)


def test_passed_over_checkpoint_is_told(
    local: RunConfig, make_dataset: MakeDataset, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder, dataset = tmp_path / "checkpoints", make_dataset(local)
    backend = begun(local, dataset, tmp_path / "switches")
    backend.save(folder, {}, with_replay=False)
    last_report(backend)
    backend.save(folder, {}, with_replay=False)
    damaged = folder / "updates-000000200" / "tensors.safetensors"
    damaged.write_bytes(damaged.read_bytes()[:-1])
    with caplog.at_level(logging.WARNING):
        begun(local, dataset, tmp_path / "switches", folder)
    assert f"an older checkpoint is used: {damaged}" in caplog.text
    strict = replace(local, checkpoint=replace(local.checkpoint, strict=True))
    with pytest.raises(ValueError, match=r"--checkpoint\.no_strict goes back"):
        begun(strict, dataset, tmp_path / "switches", folder)


def test_altered_data_of_the_random_policy_are_refused(
    local: RunConfig, make_dataset: MakeDataset, tmp_path: Path
) -> None:
    import shutil

    dataset = make_dataset(local)
    copy = tmp_path / dataset.name
    shutil.copytree(dataset, copy)
    column = next(copy.glob("*proprio*"))
    content = bytearray(column.read_bytes())
    content[-1] ^= 1
    column.write_bytes(content)
    with pytest.raises(ValueError, match="is corrupt: its SHA-256"):
        begun(local, copy, tmp_path / "switches")


def test_black_pictures_are_not_stored(tmp_path: Path) -> None:
    seen = black_picture(tmp_path, np.random.default_rng(0))
    assert seen.holds, seen.figure
