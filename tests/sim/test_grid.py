"""A small real grid on the simulator: one trial is killed, the others finish, and only that one is done again."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

pytestmark = [pytest.mark.sim, pytest.mark.render, pytest.mark.timeout(1500)]

WORDS = ["grid", "smoke", "--only", "slotfilm,no_state,state_only", "--seeds", "1", "--retries", "0", "--json"]
WORDS += ["--runtime.mode", "local", "--runtime.metrics_port", "0", "--evaluation.videos", "0"]
LIMIT_S = 500.0


def start(folder: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "slotfilm_dist", *WORDS], cwd=folder, stdout=subprocess.PIPE, text=True
    )


def outcome(driver: subprocess.Popen[str]) -> tuple[int, dict[str, dict[str, Any]]]:
    stdout, _ = driver.communicate(timeout=LIMIT_S)
    return driver.returncode, {trial["variant"]: trial for trial in json.loads(stdout)["trials"]}


def process_of_running_trial(folder: Path, variant: str) -> int:
    """The trial's process, once it trains."""
    deadline = time.monotonic() + LIMIT_S
    while time.monotonic() < deadline:
        for path in folder.glob(f"runs/*/ledger/{variant}-*.json"):
            record = json.loads(path.read_text())
            if record["state"] == "running":
                return int(record["process"].split()[-1])
        time.sleep(0.05)
    raise AssertionError(f"{variant} never ran")


def test_killed_trial_fails_alone_and_only_it_is_done_again(tmp_path: Path) -> None:
    driver = start(tmp_path)
    try:
        os.kill(process_of_running_trial(tmp_path, "no_state"), signal.SIGKILL)
        code, trials = outcome(driver)
    finally:
        driver.kill()
    assert code == 1
    assert {name: trial["state"] for name, trial in trials.items()} == {
        "slotfilm": "done",
        "no_state": "failed",
        "state_only": "done",
    }
    assert trials["no_state"]["error"].startswith("its process died")
    assert len(list(tmp_path.glob("artifacts/encoder-*"))) == 1
    assert len(list(tmp_path.glob("artifacts/random-*"))) == 2

    again = start(tmp_path)
    try:
        code, after = outcome(again)
    finally:
        again.kill()
    assert code == 0
    assert after["no_state"]["state"] == "done"
    assert after["no_state"]["num_starts"] == 2
    for variant in ("slotfilm", "state_only"):
        assert after[variant] == trials[variant]
        assert after[variant]["num_starts"] == 1
    for path in tmp_path.glob("runs/*/*/evaluation/final.json"):
        assert json.loads(path.read_text())["mean_return"] >= 0
