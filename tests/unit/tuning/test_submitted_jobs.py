"""What the files of jobs/ make of their words."""

import importlib.util
import json
import os
from pathlib import Path
from types import ModuleType

import pytest

JOBS = Path(__file__).resolve().parents[3] / "jobs"


def job(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"submitted_{name}", JOBS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_paper_begins_then_goes_on_then_rests(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    given = ["--runs", str(runs), "--artifacts", str(tmp_path / "a"), "--seed", "3", "--sac.temperature", "0.2"]
    words = job("paper").words
    run = runs / "paper-s3"
    assert words(given) == [
        *["train", "paper", "--seed", "3", "--runs", str(runs), "--name", "paper-s3", "--artifacts", given[3]],
        *["--sac.temperature", "0.2"],
    ]
    run.mkdir(parents=True)
    (run / "config.json").touch()
    assert words(given) == ["train", "--resume", str(run), "--artifacts", given[3], "--sac.temperature", "0.2"]
    (run / "status.json").write_text(json.dumps({"phase": "done"}))
    assert words(given) == []


def test_paper_of_another_variant_has_a_directory_of_its_own_and_goes_on(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    places = ["--artifacts", str(tmp_path / "a")]
    given = ["--runs", str(runs), *places, "--variant", "no_state"]
    words = job("paper").words
    run = runs / "paper-no_state-s0"
    begun = ["train", "paper", "--variant", "no_state", "--seed", "0", "--runs", str(runs), "--name", run.name]
    assert words(given) == [*begun, *places]
    run.mkdir(parents=True)
    (run / "config.json").touch()
    assert words(given) == ["train", "--resume", str(run), *places]


def test_paper_refuses_a_directory_that_ray_deletes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as refusal:
        job("paper").words(["--runs", "runs", "--artifacts", str(tmp_path)])
    assert refusal.value.code == 2
    assert "runs is relative" in capsys.readouterr().err


def test_evaluation_is_done_again_only_after_a_newer_checkpoint(tmp_path: Path) -> None:
    is_there = job("evaluate").is_there
    checkpoint, result = tmp_path / "checkpoints" / "updates-1", tmp_path / "evaluation" / "agent-7-5.json"
    checkpoint.mkdir(parents=True)
    result.parent.mkdir()
    assert not is_there(tmp_path, 5, 7)
    result.touch()
    os.utime(checkpoint, (100, 100))
    assert is_there(tmp_path, 5, 7)
    assert not is_there(tmp_path, 6, 7)
    os.utime(result, (50, 50))
    assert not is_there(tmp_path, 5, 7)


@pytest.mark.parametrize("name", ["paper", "grid", "seeds", "evaluate"])
def test_every_job_says_how_it_is_submitted(name: str) -> None:
    doc = job(name).__doc__ or ""
    assert f"python jobs/{name}.py" in doc
    assert "ray job submit --working-dir ." in doc


def test_paper_does_not_go_on_with_another_run_under_its_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "runs" / "mine"
    run.mkdir(parents=True)
    (run / "config.json").write_text(json.dumps({"seed": 0, "variant": "slotfilm"}))
    given = ["--runs", str(run.parent), "--artifacts", str(tmp_path / "a"), "--name", "mine"]
    words = job("paper").words
    assert words(given)[:2] == ["train", "--resume"]
    for other, told in ((["--seed", "7"], "begun with seed 0"), (["--variant", "cnn"], "begun with variant slotfilm")):
        with pytest.raises(SystemExit):
            words([*given, *other])
        assert told in capsys.readouterr().err
    with pytest.raises(SystemExit):
        words([*given[:4], "--name", "../mine"])
