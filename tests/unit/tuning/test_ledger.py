import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from slotfilm_dist.presets import smoke
from slotfilm_dist.tuning.grid import jobs_to_do
from slotfilm_dist.tuning.jobs import Job, build_jobs, build_trials
from slotfilm_dist.tuning.ledger import Ledger, held_by_one_driver


def trial(seed: int = 0) -> Job:
    return Job(key=f"slotfilm-s{seed}-0", kind="trial", config=replace(smoke(), seed=seed))


def test_record_follows_a_job_from_start_to_end(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    assert ledger.read(trial()).state == "waiting"
    ledger.begin(trial())
    ledger.end(trial(), "failed", error="ValueError: no", trace="long")
    ledger.begin(trial())
    assert Ledger(tmp_path).read(trial()).state == "running"
    record = ledger.end(trial(), "done", result={"mean_return": 3.0})
    again = Ledger(tmp_path).read(trial())
    assert again == record
    assert (again.state, again.num_starts, again.error, again.result) == (
        "done",
        2,
        "ValueError: no",
        {"mean_return": 3.0},
    )
    assert 0 < again.worked_s < 60
    assert Ledger(tmp_path).read(trial(1)).state == "waiting"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda values: "{", "no record of a trial"),
        (lambda values: json.dumps(values | {"config_hash": "0"}), "record of another config"),
        (lambda values: json.dumps({"key": "x"}), "no record of a trial"),
    ],
)
def test_record_that_cannot_be_trusted_is_refused(tmp_path: Path, change, message: str) -> None:
    Ledger(tmp_path).begin(trial())
    path = next((tmp_path / "ledger").glob("*.json"))
    path.write_text(change(json.loads(path.read_text())))
    with pytest.raises(ValueError, match=message):
        Ledger(tmp_path).read(trial())


def test_only_one_driver_holds_a_grid_and_a_dead_one_has_let_go(tmp_path: Path) -> None:
    code = (
        "import os; from pathlib import Path; from slotfilm_dist.tuning.ledger import held_by_one_driver as h\n"
        f"with h(Path({str(tmp_path)!r})): print('held', flush=True); input(); os._exit(9)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdin=-1, stdout=-1, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(ValueError, match="is in use by another"), held_by_one_driver(tmp_path):
            pass
        other.communicate("\n")
    with held_by_one_driver(tmp_path):
        pass


def test_what_is_over_is_not_to_be_done_again_and_its_artifacts_are_not_wanted(tmp_path: Path) -> None:
    jobs = build_jobs(build_trials(smoke(), ["slotfilm", "state_only"], 1))
    grid, artifacts = tmp_path / "grid", tmp_path / "artifacts"
    ledger = Ledger(grid)
    assert jobs_to_do(jobs, ledger, artifacts) == jobs
    trials = {job.config.variant: job for job in jobs if job.kind == "trial"}
    ledger.end(trials["slotfilm"], "done")
    ledger.end(trials["state_only"], "failed")
    left = jobs_to_do(jobs, ledger, artifacts)
    assert [job.key for job in left] == [trials["state_only"].needs[0], trials["state_only"].key]
    ledger.end(trials["state_only"], "pruned")
    assert jobs_to_do(jobs, ledger, artifacts) == []


def test_encoder_that_is_there_is_not_made_again_and_one_that_is_not_brings_its_data(tmp_path: Path) -> None:
    jobs = build_jobs(build_trials(smoke(), ["slotfilm", "alpha_5"], 1))
    slotfilm, alpha = (job for job in jobs if job.kind == "trial")
    ledger = Ledger(tmp_path)
    ledger.end(slotfilm, "done")
    # The encoder is the one of slotfilm's data, which no trial that is left needs by itself.
    assert {job.key for job in jobs_to_do(jobs, ledger, tmp_path)} == {*slotfilm.needs, alpha.needs[0], alpha.key}
    (tmp_path / slotfilm.needs[1]).mkdir()
    assert {job.key for job in jobs_to_do(jobs, ledger, tmp_path)} == {alpha.needs[0], alpha.key}
