"""The study as a Ray job, from its submission over a stop to its end: commands of `ops/runbook.md`, on this machine."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
LIMIT_S = 240.0
"""Longest wait for anything that a job does, on a loaded machine."""
GRACE_S = 120
"""What `ray job stop` gives the trials for their checkpoints; 3 s are Ray's own choice."""
FIELDS = ["--sac.hidden", "32", "32", "--schedule.random_steps", "120", "--schedule.total_steps", "3000"]
FIELDS += ["--env.max_steps", "20", "--evaluation.episodes", "1", "--evaluation.videos", "0"]
FIELDS += ["--checkpoint.every_updates", "100", "--runtime.mode", "local", "--runtime.metrics_port", "0"]
HEAD = (
    "ray start --head --node-ip-address=127.0.0.1 --port={} --dashboard-host=127.0.0.1 --dashboard-port={} "
    "--metrics-export-port={} --dashboard-agent-listen-port={} "
    "--num-cpus=2 --object-store-memory=200000000 --disable-usage-stats --block"
)


class Jobs:
    """Ray's job commands as a user types them, in the repository, with the token from their home.

    Args:
        home: of that user, in which a head answers.
        port: of its dashboard.
    """

    def __init__(self, home: Any, port: int) -> None:
        self._home, self._page = home, f"http://127.0.0.1:{port}"

    def say(self, verb: str, *words: str, token: bool = True) -> subprocess.CompletedProcess[str]:
        """Run `ray job VERB`."""
        environment = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
        environment |= {"HOME": str(self._home.folder), "RAY_AUTH_MODE": "token" if token else "disabled"}
        command = [Path(sys.executable).with_name("ray"), "job", verb, "--address", self._page, *words]
        return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=LIMIT_S)

    def submit(self, name: str, *words: str) -> None:
        """Submit the grid with a grace for its stop."""
        grace = json.dumps({"env_vars": {"RAY_JOB_STOP_WAIT_TIME_S": str(GRACE_S)}})
        options = ["--working-dir", ".", "--no-wait", "--submission-id", name, "--runtime-env-json", grace]
        deadline = time.monotonic() + LIMIT_S
        while True:
            answer = self.say("submit", *options, "--", sys.executable, "jobs/grid.py", *words)
            # The dashboard answers before the agent that takes jobs has registered with it.
            if "No available agent" not in answer.stderr or time.monotonic() > deadline:
                break
        assert answer.returncode == 0, answer.stdout + answer.stderr

    def status(self, name: str) -> str:
        """Ray's word for how a job does."""
        return json.loads(self._home.get(f"{self._page}/api/jobs/{name}", self._home.token)[1])["status"]

    def logs(self, name: str) -> str:
        """What the job's driver has said."""
        return self.say("logs", name).stdout

    def await_status(self, name: str, *wanted: str) -> None:
        """Wait for one of these words."""
        self.wait(name, lambda: self.status(name) in wanted, f"status {' or '.join(wanted)}")

    def wait(self, name: str, condition: Callable[[], Any], what: str) -> None:
        """Wait for a condition, with the job's logs in the failure."""
        deadline = time.monotonic() + LIMIT_S
        while not condition():
            if time.monotonic() > deadline:
                pytest.fail(f"no {what} within {LIMIT_S:g} s; {name} is {self.status(name)}\n{self.logs(name)}")
            time.sleep(0.2)


@pytest.fixture
def jobs(home: Any) -> Jobs:
    gcs, dashboard, metrics, agent = home.free_ports(4)
    ray = str(Path(sys.executable).with_name("ray"))
    command = HEAD.format(gcs, dashboard, metrics, agent).replace("ray ", f"{ray} ", 1) + f" --temp-dir={home.folder}"
    home.start(command, RAY_AUTH_MODE="token", RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER="0")
    home.wait("dashboard", lambda: home.get(f"http://127.0.0.1:{dashboard}/api/version", home.token)[0] == 200)
    return Jobs(home, dashboard)


def records(grid: Path) -> dict[str, dict[str, Any]]:
    """The ledger, by variant."""
    found = [json.loads(path.read_text()) for path in grid.glob("ledger/*.json")]
    return {record["variant"]: record for record in found if record["kind"] == "trial"}


def steps_of(run: Path) -> list[int]:
    """Environment steps of every line that a run has logged."""
    lines = (run / "metrics.jsonl").read_text().splitlines()
    return [json.loads(line)["env_steps"] for line in lines]


@pytest.mark.sim
@pytest.mark.slow
def test_stopped_grid_writes_its_checkpoint_and_goes_on_when_submitted_again(jobs: Jobs, tmp_path: Path) -> None:
    refused = jobs.say("list", token=False)
    assert refused.returncode != 0
    assert "authentication is enabled" in refused.stderr

    grid = tmp_path / "runs" / "smoke"
    words = ["smoke", "--only", "state_only,oracle_state", "--seeds", "1", "--max-concurrent", "1", "--name", "smoke"]
    words += ["--runs", str(grid.parent), "--artifacts", str(tmp_path / "artifacts"), *FIELDS]
    jobs.submit("first", *words)

    def second_has_checkpoint() -> Path | None:
        done = [record["key"] for record in records(grid).values() if record["state"] == "done"]
        runs = [path.parents[1] for path in grid.glob("*/checkpoints/updates-*") if path.parents[1].name not in done]
        return runs[0] if done and runs else None

    jobs.wait("first", second_has_checkpoint, "checkpoint of the second trial")
    run = second_has_checkpoint()
    assert run is not None
    assert jobs.say("stop", "first").returncode == 0
    jobs.await_status("first", "STOPPED")
    before = records(grid)
    assert sorted(record["state"] for record in before.values()) == ["done", "stopped"]
    assert (run / "checkpoints" / "replay" / "manifest.json").exists()
    assert "go on with the same command" in jobs.logs("first")
    known = steps_of(run)

    jobs.submit("second", *words)
    jobs.await_status("second", "SUCCEEDED", "FAILED")
    assert jobs.status("second") == "SUCCEEDED", jobs.logs("second")
    after = records(grid)
    assert {record["state"] for record in after.values()} == {"done"}
    (finished,) = [variant for variant, record in before.items() if record["state"] == "done"]
    assert after[finished] == before[finished]
    (resumed,) = after.keys() - {finished}
    assert after[resumed]["num_starts"] == 2
    further = steps_of(run)[len(known) :]
    assert min(further) >= known[-1] > 120, "it began from nothing again"
    assert max(further) >= 3000
