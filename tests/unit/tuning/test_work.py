"""A job's thread, on the toy environment and without Ray."""

import json
import threading
from dataclasses import replace
from pathlib import Path

import pytest
from filelock import FileLock

from slotfilm_dist.config import RunConfig
from slotfilm_dist.envs.toy import make_toy_env
from slotfilm_dist.local import LocalBackend
from slotfilm_dist.presets import smoke
from slotfilm_dist.tuning.jobs import Job, build_jobs
from slotfilm_dist.tuning.ledger import Ledger
from slotfilm_dist.tuning.resources import job_resources
from slotfilm_dist.tuning.work import STOP_FILE, Orders, Work
from slotfilm_dist.variants import apply_variant

LIMIT_S = 60.0


class ToyBackend(LocalBackend):
    """One process, without the simulator."""

    def __init__(self, config: RunConfig) -> None:
        super().__init__(config, make_toy_env)


class BrokenBackend(ToyBackend):
    def prepare(self) -> None:
        raise ValueError("the gripper is stuck\nreally")


def jobs_of(total_steps: int = 200) -> list[Job]:
    base = apply_variant("state_only", smoke())
    config = replace(
        base,
        env=replace(base.env, max_steps=20),
        schedule=replace(base.schedule, total_steps=total_steps, random_steps=100),
        replay=replace(base.replay, min_steps=80),
        sac=replace(base.sac, hidden=(16,)),
        runtime=replace(base.runtime, mode="local", learner_threads=1, metrics_port=0),
    )
    return build_jobs([config])


def orders_for(folder: Path, jobs: list[Job], backend: type[ToyBackend] = ToyBackend) -> Orders:
    return Orders(
        grid=folder / "grid",
        artifacts=folder / "artifacts",
        jobs={job.key: job for job in jobs},
        resources={job.key: job_resources(job, [{"CPU": 2.0}]) for job in jobs},
        make_backend=lambda config, run, resources: backend(config),
        command=("grid", "smoke"),
    )


def work_on(job: Job, orders: Orders) -> Work:
    orders.grid.mkdir(exist_ok=True)
    work = Work(job, orders)
    work.start()
    return work


@pytest.fixture(autouse=True)
def _own_command(monkeypatch: pytest.MonkeyPatch) -> None:
    """A job sets the words of its process's command."""
    monkeypatch.setattr("sys.argv", ["slotfilm"])
    monkeypatch.setenv("LP_NUM_THREADS", "0")


def test_data_and_trial_leave_their_results_and_their_records(tmp_path: Path) -> None:
    data, trial = jobs_of()
    orders = orders_for(tmp_path, [data, trial])
    for job in (data, trial):
        work = work_on(job, orders)
        assert work.wait(LIMIT_S)
        assert work.standing()["state"] == "done"
    assert data.artifact_is_there(orders.artifacts)
    record = Ledger(orders.grid).read(trial)
    assert (record.state, record.num_starts) == ("done", 1)
    final = json.loads((orders.directory(trial) / "evaluation" / "final.json").read_text())
    assert record.result["mean_return"] == final["mean_return"]
    versions = json.loads((orders.directory(trial) / "versions.json").read_text())
    assert versions["command"] == "slotfilm grid smoke"


def test_failure_is_raised_and_recorded(tmp_path: Path) -> None:
    jobs = jobs_of()
    orders = orders_for(tmp_path, jobs, BrokenBackend)
    work = work_on(jobs[-1], orders)
    assert work.wait(LIMIT_S)
    with pytest.raises(ValueError, match="the gripper is stuck"):
        work.standing()
    record = Ledger(orders.grid).read(jobs[-1])
    assert (record.state, record.error) == ("failed", "ValueError: the gripper is stuck")
    assert "BrokenBackend" not in record.error
    assert "Traceback" in record.trace


@pytest.mark.parametrize(
    ("by", "state", "keeps_replay"),
    [("signal", "stopped", True), ("asha", "pruned", False), ("an error of the driver", "stopped", True)],
)
def test_stop_keeps_replay_for_later_and_pruning_drops_it(
    tmp_path: Path, by: str, state: str, keeps_replay: bool
) -> None:
    jobs = jobs_of(total_steps=100_000)
    orders = orders_for(tmp_path, jobs)
    work = work_on(jobs[-1], orders)
    training = threading.Event()
    for _ in range(int(LIMIT_S * 20)):
        if work.standing().get("env_steps", 0) > 100:
            training.set()
            break
        assert not work.wait(0.05)
    assert training.is_set()
    if by == "signal":
        (orders.grid / STOP_FILE).touch()
    if by == "asha":
        orders.prune_mark(jobs[-1].key).parent.mkdir()
        orders.prune_mark(jobs[-1].key).touch()
    if by != "signal":
        work.end()
    assert work.wait(LIMIT_S)
    assert work.standing()["state"] == Ledger(orders.grid).read(jobs[-1]).state == state
    checkpoints = orders.directory(jobs[-1]) / "checkpoints"
    assert any(checkpoints.glob("updates-*"))
    assert (checkpoints / "replay").exists() is keeps_replay


def test_pruning_while_the_grid_stops_is_a_stop(tmp_path: Path) -> None:
    jobs = jobs_of(total_steps=100_000)
    orders = orders_for(tmp_path, jobs)
    orders.grid.mkdir()
    (orders.grid / STOP_FILE).touch()
    work = work_on(jobs[-1], orders)
    work.end()
    assert work.wait(LIMIT_S)
    assert Ledger(orders.grid).read(jobs[-1]).state == "stopped"


def test_job_waits_while_another_process_makes_its_artifact(tmp_path: Path) -> None:
    data, _ = jobs_of()
    orders = orders_for(tmp_path, [data])
    orders.artifacts.mkdir()
    with FileLock(orders.artifacts / f".{data.key}.lock"):
        work = work_on(data, orders)
        for _ in range(int(LIMIT_S * 20)):
            if "another run is making" in work.standing().get("note", ""):
                break
            assert not work.wait(0.05)
        assert "another run is making" in work.standing()["note"]
        assert not data.artifact_is_there(orders.artifacts)
    assert work.wait(LIMIT_S)
    assert data.artifact_is_there(orders.artifacts)
