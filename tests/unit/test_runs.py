"""Run directories: names, the lock, what may change on resuming."""

import json
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from slotfilm_dist.config import RunConfig
from slotfilm_dist.config_files import load_config
from slotfilm_dist.messages import EpisodeSummary, TrainingEpisode
from slotfilm_dist.runs import RunDirectory, describe_machine, new_run_directory, resumed_config

CONFIG = RunConfig()


def test_name_is_preset_variant_seed_and_the_first_free_number(tmp_path: Path) -> None:
    config = replace(CONFIG, seed=3)
    assert new_run_directory(tmp_path, config, "quick").name == "quick-slotfilm-s3-001"
    (tmp_path / "quick-slotfilm-s3-001").mkdir()
    assert new_run_directory(tmp_path, config, "quick").name == "quick-slotfilm-s3-002"


@pytest.mark.parametrize("name", ["a/b", "../x", ".hidden", "", " ", "a b", "x" * 101, "-x", "a\n"])
def test_name_that_is_no_file_name_is_refused(tmp_path: Path, name: str) -> None:
    if not name:
        assert new_run_directory(tmp_path, CONFIG, "quick", name).name.startswith("quick")
        return
    with pytest.raises(ValueError, match="--name"):
        new_run_directory(tmp_path, CONFIG, "quick", name)
    assert list(tmp_path.iterdir()) == []


def test_existing_run_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    with pytest.raises(ValueError, match=r"mine exists; choose another --name, or go on with --resume"):
        new_run_directory(tmp_path, CONFIG, "quick", "mine")


def test_entered_run_holds_config_versions_and_owner(tmp_path: Path) -> None:
    with RunDirectory(tmp_path / "run", CONFIG) as run:
        assert load_config(run.path / "config.json") == CONFIG
        versions = json.loads((run.path / "versions.json").read_text())
        assert {"torch", "python", "cpu", "command"} <= versions.keys()
        assert run.read_status() == {}
        run.write_status(phase="train", env_steps=7)
        assert run.read_status()["env_steps"] == 7


def test_run_that_is_made_but_not_entered_leaves_nothing_behind(tmp_path: Path) -> None:
    RunDirectory(tmp_path / "run", CONFIG)
    assert list(tmp_path.iterdir()) == []


def test_second_driver_is_refused_and_changes_nothing(tmp_path: Path) -> None:
    with RunDirectory(tmp_path / "run", CONFIG) as run:
        before = {path.name: path.read_bytes() for path in run.path.iterdir()}
        changed = replace(CONFIG, schedule=replace(CONFIG.schedule, total_steps=2_000_000))
        with pytest.raises(ValueError, match=r"is in use by process \d+ on"), RunDirectory(run.path, changed):
            pass
        assert {path.name: path.read_bytes() for path in run.path.iterdir()} == before
    with RunDirectory(tmp_path / "run", resumed_config(tmp_path / "run", CONFIG, changed)):
        assert load_config(tmp_path / "run" / "config.json") == changed


def test_resuming_may_change_budgets_but_not_what_was_learned_from(tmp_path: Path) -> None:
    budget = replace(CONFIG, schedule=replace(CONFIG.schedule, total_steps=2_000_000))
    assert resumed_config(tmp_path, CONFIG, budget) == budget
    other = replace(CONFIG, seed=4, sac=replace(CONFIG.sac, gamma=0.9))
    with pytest.raises(ValueError, match=r"seed, sac\.gamma cannot change in a run that has begun"):
        resumed_config(tmp_path, CONFIG, other)
    for changed in (
        replace(CONFIG, runtime=replace(CONFIG.runtime, block_steps=64)),
        replace(CONFIG, schedule=replace(CONFIG.schedule, updates_per_step=0.25)),
        replace(CONFIG, schedule=replace(CONFIG.schedule, random_steps=240)),
    ):
        with pytest.raises(ValueError, match="cannot change in a run that has begun"):
            resumed_config(tmp_path, CONFIG, changed)


def test_damaged_status_counts_as_none(tmp_path: Path) -> None:
    with RunDirectory(tmp_path / "run", CONFIG) as run:
        (run.path / "status.json").write_text("[1")
        assert run.read_status() == {}


def test_episodes_are_appended_as_lines(tmp_path: Path) -> None:
    episode = EpisodeSummary(
        seed=5,
        length=400,
        episode_return=1.5,
        success_once=True,
        success_at_end=False,
        placed_at_end=False,
        grasped_once=True,
        reward_terms=(1.0, 0.5),
    )
    with RunDirectory(tmp_path / "run", CONFIG) as run:
        run.log_episodes([TrainingEpisode(summary=episode, policy_version=3, env_steps=400)])
        run.log_episodes([TrainingEpisode(summary=episode, policy_version=4, env_steps=800)] * 2)
        lines = [json.loads(line) for line in (run.path / "episodes.jsonl").read_text().splitlines()]
    assert [line["env_steps"] for line in lines] == [400, 800, 800]
    assert lines[0]["seed"] == 5
    assert lines[2]["policy_version"] == 4


def test_room_of_a_run_counts_the_processes_that_it_started(tmp_path: Path) -> None:
    with RunDirectory(new_run_directory(tmp_path, CONFIG, "smoke"), CONFIG) as run:
        check_room(run)


def check_room(run: RunDirectory) -> None:
    alone = run.room()["run_memory_bytes"]
    code = "import sys; held = bytearray(b'x') * 256_000_000; print(flush=True); sys.stdin.read()"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        with_child = run.room()["run_memory_bytes"]
        child.communicate()
    assert with_child - alone > 64_000_000


def test_episodes_that_a_full_disk_refuses_are_written_with_the_next(tmp_path: Path) -> None:
    with RunDirectory(tmp_path / "run", CONFIG) as run:
        log = run.path / "episodes.jsonl"
        log.symlink_to("/dev/full")
        run.log_episodes([TrainingEpisode(summary=some_episode(1), policy_version=0, env_steps=100)])
        log.unlink()
        run.log_episodes([TrainingEpisode(summary=some_episode(2), policy_version=5, env_steps=200)])
        lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert [(line["seed"], line["env_steps"], line["policy_version"]) for line in lines] == [(1, 100, 0), (2, 200, 5)]


def some_episode(seed: int) -> EpisodeSummary:
    return EpisodeSummary(
        seed=seed,
        length=3,
        episode_return=1.0,
        success_once=False,
        success_at_end=False,
        placed_at_end=False,
        grasped_once=True,
        reward_terms=(1.0,),
    )


def test_recorded_command_can_be_pasted(monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["slotfilm", "train", "quick", "--runs", "/home/o'brien/my runs"]
    monkeypatch.setattr(sys, "argv", words)
    assert shlex.split(describe_machine()["command"]) == words
