"""Faults of a run in one process, on the toy environment."""

import logging
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from slotfilm_dist.backend import RunFailedError, TrainReport
from slotfilm_dist.chaos.black_picture import black_picture
from slotfilm_dist.chaos.faulty_env import BROKEN_STEPS, make_faulty_env
from slotfilm_dist.chaos.switches import Switches
from slotfilm_dist.config import RunConfig
from slotfilm_dist.envs.toy import make_toy_env
from slotfilm_dist.local import LocalBackend
from slotfilm_dist.local_envs import MAX_BROKEN

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


def test_run_stops_when_every_environment_breaks(
    local: RunConfig, make_dataset: MakeDataset, tmp_path: Path, switches: Switches
) -> None:
    backend = begun(local, make_dataset(local), tmp_path / "switches")
    switches.arm("nan_reward", count=BROKEN_STEPS * MAX_BROKEN)
    with pytest.raises(RunFailedError, match=f"{MAX_BROKEN} environments were given up, .*--resume"):
        last_report(backend)


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
