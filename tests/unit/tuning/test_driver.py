"""What the driver makes of Tune's events, and a job in Tune's trainable, without a cluster."""

import io
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from ray import cloudpickle, tune
from ray.tune.experiment import Trial
from rich.console import Console

from slotfilm_dist.envs.toy import make_toy_env
from slotfilm_dist.local import LocalBackend
from slotfilm_dist.presets import smoke
from slotfilm_dist.tuning.board import Board
from slotfilm_dist.tuning.grid import STOP_LIMIT_S, Driver
from slotfilm_dist.tuning.jobs import Job, build_jobs, build_trials
from slotfilm_dist.tuning.ledger import Ledger
from slotfilm_dist.tuning.queue import JobTrainable
from slotfilm_dist.tuning.resources import job_resources
from slotfilm_dist.tuning.work import STOP_FILE, Orders


class Scene:
    """A driver with the jobs of one trial."""

    def __init__(self, folder: Path) -> None:
        base = smoke()
        self.jobs = [
            replace(job, config=replace(job.config, runtime=replace(base.runtime, mode="local", metrics_port=0)))
            for job in build_jobs(build_trials(base, ["state_only"], 1))
        ]
        self.data, self.trial = self.jobs
        self.orders = Orders(
            grid=folder,
            artifacts=folder / "artifacts",
            jobs={job.key: job for job in self.jobs},
            resources={job.key: job_resources(job, [{"CPU": 2.0}]) for job in self.jobs},
            make_backend=lambda config, run, resources: LocalBackend(config, make_toy_env),
            command=("grid",),
        )
        self.ledger, self.stopped, self.shown = Ledger(folder), False, io.StringIO()
        self.board = Board([(job, self.ledger.read(job)) for job in self.jobs], Console(file=self.shown, width=200))
        self.driver = Driver(self.orders, self.board, lambda: self.stopped)

    def tune_trial(self, job: Job, last_result: dict | None = None) -> Trial:
        trial = Trial("job", trial_id="t", config={"key": job.key}, stub=True)
        if last_result:
            trial.run_metadata.last_result = last_result
        return trial


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Scene(tmp_path)


def tell(event: Callable[..., None], trial: Trial, **values: object) -> None:
    event(iteration=1, trials=[trial], trial=trial, **values)


def test_process_that_died_without_a_word_is_recorded_by_the_driver(scene: Scene) -> None:
    trial = scene.tune_trial(scene.trial)
    tell(scene.driver.on_trial_start, trial)
    scene.ledger.begin(scene.trial)
    assert scene.board.rows[scene.trial.key].state == "running"
    tell(scene.driver.on_trial_error, trial)
    record = scene.ledger.read(scene.trial)
    assert (record.state, record.error) == ("failed", "its process died")
    assert scene.board.counts["failed"] == 1
    assert f"failed  {scene.trial.key}: its process died" in scene.shown.getvalue()


def test_what_a_job_wrote_of_its_failure_stays(scene: Scene) -> None:
    trial = scene.tune_trial(scene.trial)
    tell(scene.driver.on_trial_start, trial)
    scene.ledger.begin(scene.trial)
    scene.ledger.end(scene.trial, "failed", error="ValueError: no", trace="long")
    tell(scene.driver.on_trial_recover, trial)
    assert scene.ledger.read(scene.trial).trace == "long"
    assert scene.board.rows[scene.trial.key].error == "ValueError: no"


@pytest.mark.parametrize(("last", "shown"), [("done", "done"), ("running", "pruned"), ("stopped", "stopped")])
def test_end_of_a_job_is_shown_as_what_it_was(scene: Scene, last: str, shown: str) -> None:
    trial = scene.tune_trial(scene.trial, {"state": last})
    tell(scene.driver.on_trial_start, trial)
    tell(scene.driver.on_trial_complete, trial)
    assert scene.board.rows[scene.trial.key].state == shown


def test_stop_reaches_the_jobs_and_the_driver_waits_for_them(scene: Scene) -> None:
    trial = scene.tune_trial(scene.trial, {"state": "stopped"})
    tell(scene.driver.on_trial_start, trial)
    scene.driver.on_step_begin(1, [trial])
    assert not (scene.orders.grid / STOP_FILE).exists()
    assert not scene.driver.over()
    scene.stopped = True
    scene.driver.on_step_begin(2, [trial])
    assert (scene.orders.grid / STOP_FILE).exists()
    assert not scene.driver.over()
    tell(scene.driver.on_trial_complete, trial)
    assert scene.driver.over()


def test_driver_does_not_wait_for_ever(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    trial = scene.tune_trial(scene.trial)
    tell(scene.driver.on_trial_start, trial)
    scene.stopped = True
    scene.driver.on_step_begin(1, [trial])
    assert not scene.driver.over()
    later = time.monotonic() + STOP_LIMIT_S + 1
    monkeypatch.setattr("slotfilm_dist.tuning.grid.time.monotonic", lambda: later)
    assert scene.driver.over()


def test_notes_that_tune_writes_hold_no_board(scene: Scene) -> None:
    assert type(cloudpickle.loads(cloudpickle.dumps(scene.driver))) is tune.Callback


def test_job_in_tunes_trainable_reports_until_it_is_done(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["slotfilm"])
    monkeypatch.setenv("LP_NUM_THREADS", "0")
    orders = scene.orders

    class Placed(JobTrainable):
        def setup(self, config: dict) -> None:  # type: ignore[override]  # as tune.with_parameters makes it
            super().setup(config, orders)

    trainable = Placed(config={"key": scene.data.key})
    try:
        for _ in range(30):
            result = trainable.train()
            if result["done"]:
                break
        assert result["done"]
        assert result["state"] == "done"
        assert scene.data.artifact_is_there(orders.artifacts)
    finally:
        trainable.stop()
