"""What `slotfilm grid` says before it starts anything."""

import json
import shlex
from pathlib import Path

import pytest

from slotfilm_dist.commands.grid import main
from slotfilm_dist.config import RunConfig
from slotfilm_dist.presets import smoke
from slotfilm_dist.tuning.grid_file import check_same_settings, write_grid_file
from slotfilm_dist.tuning.jobs import build_jobs, build_trials
from slotfilm_dist.tuning.ledger import Ledger


@pytest.fixture(autouse=True)
def _own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)


def plan(capsys: pytest.CaptureFixture[str], *words: str) -> dict:
    assert main(["smoke", "--dry-run", "--json", *words]) == 0
    return json.loads(capsys.readouterr().out)


def test_dry_run_lists_what_is_to_do_and_writes_nothing(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    told = plan(capsys, "--only", "slotfilm,state_only", "--seeds", "2")
    assert (told["trials"], told["to_do"]) == (4, 4)
    assert [row["name"] for row in told["jobs"]].count("encoder") == 2
    assert told["hours"] > 0
    assert told["disk_bytes"] > 0
    assert list(tmp_path.iterdir()) == []


def test_dry_run_leaves_out_what_is_over(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    jobs = build_jobs(build_trials(smoke(), ["state_only"], 1))
    Ledger(tmp_path / "runs" / "grid-smoke").end(jobs[-1], "done")
    assert plan(capsys, "--only", "state_only", "--seeds", "1")["to_do"] == 0
    assert plan(capsys, "--only", "state_only", "--seeds", "2")["to_do"] == 1


def test_table_is_readable(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["smoke", "--dry-run", "--only", "drq", "--seeds", "2"]) == 0
    told = capsys.readouterr().out
    assert "2 trials, 0 of them over, 2 to do" in told
    assert "drq" in told


def test_other_settings_are_another_grid_and_places_are_not_settings(capsys: pytest.CaptureFixture[str]) -> None:
    name = Path(plan(capsys)["grid"]).name
    assert name == "grid-smoke"
    assert Path(plan(capsys, "--runtime.mode", "local", "--seed", "3", "--checkpoint.keep", "5")["grid"]).name == name
    other = Path(plan(capsys, "--schedule.total_steps", "500")["grid"]).name
    assert other.startswith("grid-smoke-")
    assert Path(plan(capsys, "--schedule.total_steps", "500")["grid"]).name == other


def test_directory_of_another_grid_is_refused(tmp_path: Path) -> None:
    write_grid_file(tmp_path, smoke(), ("grid", "smoke"))
    write_grid_file(tmp_path, smoke(), ("grid", "smoke", "--seeds", "2"))
    check_same_settings(tmp_path, smoke())
    commands = json.loads((tmp_path / "grid.json").read_text())["commands"]
    assert commands == ["slotfilm grid smoke", "slotfilm grid smoke --seeds 2"]
    with pytest.raises(ValueError, match=r"other settings \(.*schedule\.total_steps.*--name"):
        check_same_settings(tmp_path, RunConfig())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--only", "state_onyl"], "did you mean 'state_only'"),
        (["--exclude", "cnn", "--only", "cnn"], "leaves no variant"),
        (["--seeds", "0"], "--seeds 0"),
        (["--retries", "-1"], "--retries -1"),
        (["--max-concurrent", "-1"], "--max-concurrent -1"),
        (["--cpus-per-trial", "0"], "--cpus-per-trial 0"),
        (["--name", "a/b"], "--name 'a/b'"),
        (["--schedule.total_stepz", "5"], "did you mean --schedule.total_steps"),
        (["--runs", "/x/runtime_resources/working_dir_files/y/runs"], "every node sees"),
    ],
)
def test_mistake_is_refused_before_anything_starts(words: list[str], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        main(["smoke", "--dry-run", *words])
    assert list(tmp_path.iterdir()) == []


def test_recorded_command_can_be_pasted(tmp_path: Path) -> None:
    command = ("grid", "quick", "--runs", "/home/o'brien/my runs")
    write_grid_file(tmp_path, smoke(), command)
    (recorded,) = json.loads((tmp_path / "grid.json").read_text())["commands"]
    assert tuple(shlex.split(recorded)) == ("slotfilm", *command)
